"""Programs of an administrator: serve, backup, restore, check, health probe.

Start with `serve`.
"""
