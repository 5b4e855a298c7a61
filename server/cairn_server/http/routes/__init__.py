"""Routes: one module for each part of PROTOCOL.md.

Start with `sync`, the shortest; `callers` says who asks, `problems` how errors are answered.
"""
