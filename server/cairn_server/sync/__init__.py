"""Sync protocol of the server (server/SYNC.md): push, fetch missing, retract, uploads, commits from relays.

HTTP is left to `http`, adding up to `folding`. Start with `pushes` (commits on their way in) and
`missing` (the branch difference: what a robot lacks of main).
"""
