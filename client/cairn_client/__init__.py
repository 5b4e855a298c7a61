"""The robot's side: local map, outbox, sync and the command line.

Evidence comes from `cairn_fusion`; the server is another package that is never imported here. Start with
`robot.robot`, the class that a program holds.
"""
