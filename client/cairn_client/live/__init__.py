"""Live sources: the messages of a robot with ROS as they come, and a robot of cairn that maps them.

A door (`foxglove_source`) brings messages; what they mean, and which become scans, is decided as for bags
(`cairn_fusion.ros`). Start reading at `live_mapping`.
"""
