"""Settling: bytes at rest leave the database for an object store, and objects that are out of use are deleted.

Reading them back is the store's own (`postgres.snapshot`, `postgres.reads`). Start with `settler`, then `ownership`.
"""
