"""The store in PostgreSQL, for servers that share one: pushes, folds, snapshots, and everything else of `store.Store`.

The rules that hold for every store are in the room above; which database is used says the server's setting.
Start with `schema` (the tables and who writes them), then `pushes` and `folds`.
"""
