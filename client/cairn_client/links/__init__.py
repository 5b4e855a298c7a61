"""Links to a robot's own network: a Foxglove bridge, a zenoh router, the ROS 2 of this machine.

Doors (`live`) receive over them, sinks (`publish`) send. Start with `bridge_link`.
"""
