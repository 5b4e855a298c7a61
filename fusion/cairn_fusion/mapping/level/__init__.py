"""Level: the votes of scans for the heights of surfaces, evidence of flat voxels (docs/decisions/041).

How the votes are read is in `cairn_map.queries.level`. Start with `votes.py`.
"""
