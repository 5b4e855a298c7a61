"""Pictures of a map from any pose: camera rays through its octree, colours, legend, PNG.

Values at one point or along one ray are left to `queries`. Start with `map_render` and `render_request`.
"""
