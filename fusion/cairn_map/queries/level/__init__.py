"""Level: the votes of a layer of flat voxels read as a surface, and what a vehicle can make of it.

Votes are made in `cairn_fusion.mapping.level`. Start with `elevation.py`; docs/decisions/041 says why it is read so.
"""
