"""Files of an embedded store that no server writes meanwhile: a map as a file of its own, a store written again.

Backups are next door (`store.sqlite.backup`). Begin with `map_archive`.
"""
