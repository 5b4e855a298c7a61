"""Telepresence for an operator: thermal over colour, colour over thermal, the map over a live image.

The fused values are `image_fusion`'s, pictures of the map alone `cairn_map.render`'s. Start with `telepresence` and
`overlay`.
"""
