"""Rigs in other programs' files: Kalibr, OpenCV, ROS and mrcal.

cairn's own `rig.json` is `rig.rig`'s. Start with `rig_exchange`, which finds the format.
"""
