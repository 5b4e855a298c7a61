"""Store: the protocol that a database fulfils, its rows, and the embedded SQLite store.

What is stored is decided above. Start with `store`, the protocol; `sqlite/` implements it, and its
`writer` is the group commit.
"""
