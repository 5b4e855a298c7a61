"""Fused images: what one camera sees on another camera's pixels, labelled and with occlusions found.

Painting them is left to `view`. Start with `surface`, then `cross_view`.
"""
