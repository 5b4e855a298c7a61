"""Scenes: solids with colours and temperatures, still or moving, as files and as a tree for rays.

What a camera sees of them is left to `render`. Start with `scene_file`, which shows the format.
"""
