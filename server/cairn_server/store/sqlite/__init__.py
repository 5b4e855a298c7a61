"""Store in one SQLite file: one writer thread with group commit, many readers.

The protocol is `store.store`'s. Start with `store`; `writer` is the group commit, `schema` the tables.
"""
