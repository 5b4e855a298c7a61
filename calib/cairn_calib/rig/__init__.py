"""Rig: cameras with lenses and poses, range bias, radiometry, and the uncertainty of all of them.

Estimating them is left to `solve`. Start with `rig`, then `camera` and `poses`; `image_files` reads images.
"""
