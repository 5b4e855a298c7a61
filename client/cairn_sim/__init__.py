"""Simulated robots in scenes that are known exactly, and the experiments on them.

Mapping and sync are the real packages'. Start with `scene.scene`, `render.render` and `robots.record`.
"""
