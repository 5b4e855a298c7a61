"""Simulated robots: heads, drives, calibration targets, and the recordings that they make.

Images come from `render`. Start with `robots` and `record`.
"""
