"""Files out of a database, and back: a map as the rows of an archive.

The archive itself is a store of SQLite (`store.sqlite.files`). Begin with `map_file`.
"""
