"""Rigs and corners in other programs' files: Kalibr, OpenCV, ROS, mrcal and MATLAB.

cairn's own `rig.json` is `rig.rig`'s, its corner documents are `board.corner_file`'s. Start with
`rig_exchange` and `corner_list`.
"""
