"""Scores of maps, fused images and overlays against a scene's exact truth.

Whole experiments are left to `experiment`. Start with `truth_grid` and `scores`.
"""
