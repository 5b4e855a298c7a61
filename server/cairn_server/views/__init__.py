"""Views: coarse cells, single voxels, pictures and exports, made on demand or ahead.

Cells come from `folding`. Start with `cell_views`.
"""
