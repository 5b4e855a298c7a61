"""ROS 1 and ROS 2 bags as recordings: topics, messages, transforms, images, point clouds.

Folders of images are `recording`'s. Start with `bag_recording`; `topic_mapping` says which topic is which camera.
"""
