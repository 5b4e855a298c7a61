"""Octree code of a cell: canonical bytes of its evidence, in two profiles, and coarser views of it (FORMAT.md).

Commits and frames, which carry cells, are left to `commits` and `wire`. Start with `cell_code`; `octree/` holds the
streams and the tree, `entropy/` the adaptive coder of the small profile.
"""
