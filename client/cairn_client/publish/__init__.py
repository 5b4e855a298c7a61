"""A map on its way to other programs: messages of ROS 2 into files and to viewers, kept up to date by live events.

What the messages hold is `cairn_fusion.ros.map_messages`'. Start with `map_publisher`.
"""
