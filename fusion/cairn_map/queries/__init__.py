"""Queries of a map: occupancy at points, rays, nearest obstacles, collisions of bodies on paths, layers, voxels.

Pictures are left to `render`. Start with `map_snapshot`, which has them all as methods, on one immutable state.
"""
