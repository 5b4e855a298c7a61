"""Commits: a measurement's evidence under an id, signed; version vectors and cursors over them.

How cells become bytes is left to `codec`, how commits travel to `wire`. Start with `commit` and `version_vector`.
"""
