"""Fused images: one camera's values on another camera's pixels, labelled, with occlusions found.

Painting them is left to `view`. Start with `surface`, then `cross_view`.
"""
