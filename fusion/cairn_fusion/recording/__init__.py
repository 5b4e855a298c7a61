"""Scans and recordings: images with poses in memory and in folders.

ROS bags are left to `ros`. Start with `scan`, then `recording`.
"""
