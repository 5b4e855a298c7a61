"""Routes: one module for each part of PROTOCOL.md.

Start with `sync`, the busiest; `callers` finds out who asks, `problems` turns errors into answers, and `documentation`
says in OpenAPI what types cannot.
"""
