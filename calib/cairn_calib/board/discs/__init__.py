"""Grids of discs in images: blobs, the lattice that they make through any lens, and their outlines.

Chessboards, and what all boards share, are in the room around this one; `solve` predicts the centroids that are
measured here. Start with `disc_grid`; `disc_outline` is the sub-pixel step.
"""
