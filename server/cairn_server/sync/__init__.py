"""Sync protocol of the server (SYNC.md): push, fetch missing, retract, uploads, commits from relays.

HTTP is left to `http`, adding up to `folding`. Start with `pushes` and `missing`.
"""
