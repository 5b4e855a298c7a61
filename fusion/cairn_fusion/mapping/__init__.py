"""Scans as evidence: hits, certainly free space, colour and temperature per voxel.

The sums live in `cairn_map.evidence`. Start with `integrate`, the pipeline, then `free_space` and `samples`.
"""
