"""Folders of robots and of map copies, looked at from outside while a robot may be at work.

Changing them is the robot's alone. Start with `state_folder`.
"""
