"""Rig: cameras with lenses and poses, range bias, radiometry, and the uncertainty of all of them.

How they are estimated is left to `solve`. Start with `rig`, then `camera` and `poses`.
"""
