"""Commits: a measurement's evidence under an id, signed; version vectors and cursors over them.

The bytes of cells are left to `codec`, the exchange of commits to `wire`. Start with `commit` and `version_vector`.
"""
