"""Pictures of a map from any pose: camera rays through its octree, colours, legend, PNG.

What lies at one point or along one ray is left to `queries`. Start with `map_render` and `render_request`.
"""
