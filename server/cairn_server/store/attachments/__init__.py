"""Attachments of marks in a store: bytes by SHA-256 that marks name, as rows of the database that the marks are in.

Where their bytes come from and who may send them is left to `sync`. Start with `attachments`.
"""
