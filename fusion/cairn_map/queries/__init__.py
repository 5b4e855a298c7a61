"""Questions to a map: occupancy at points, rays, nearest obstacles, bodies, paths, layers, single voxels.

Pictures are left to `render`. Start with `map_snapshot`, which offers them all on one immutable state.
"""
