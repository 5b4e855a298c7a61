"""Layers of one map asked together: points, rays, distances and images by the finest layer that knows the place.

Queries of one layer are the room above. Start with `layered_snapshot.py`; docs/decisions/033 says what a layer is.
"""
