"""A whole robot in one page: a simulated head looks around at two stops and shares what it sees.

$ cairn serve &                                                    # in another terminal
$ cairn map create http://127.0.0.1:8750/maps/lab
$ python docs/examples/simulated_robot.py http://127.0.0.1:8750/maps/lab
"""

import sys

from cairn_client.robot import Robot
from cairn_sim.drive import head_poses, stops
from cairn_sim.heads import RANGE_CAMERA, full_head
from cairn_sim.render import render_scan
from cairn_sim.room import small_room

rig, room = full_head(scale=0.25), small_room()
with Robot(rig, sys.argv[1], directory="robot-state", name="walle") as robot:
    for position in stops("west")[:2]:
        for n, T_map_rig in enumerate(head_poses(position, n_yaw=8, n_pitch=3)):
            robot.observe(
                render_scan(room, rig, T_map_rig=T_map_rig, range_camera=RANGE_CAMERA, time_s=float(n), rng=None)
            )
        sys.stdout.write(f"{robot.commit()}\n")  # durable from here on, link or no link
        robot.sync()
    sys.stdout.write(f"{len(robot.map)} cells, {robot.waiting} commits wait\n")
