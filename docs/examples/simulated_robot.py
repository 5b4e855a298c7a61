"""A whole robot in one page: a simulated head looks around at two stops and shares what it sees.

$ cairn serve &                                                    # in another terminal
$ cairn map create http://127.0.0.1:8750/maps/lab
$ python docs/examples/simulated_robot.py http://127.0.0.1:8750/maps/lab
"""

import sys

from cairn_client.robot.robot import Robot
from cairn_sim.render.render import render_scan
from cairn_sim.render.sensors import Noise
from cairn_sim.robots.heads import RANGE_CAMERA
from cairn_sim.robots.robots import ROBOTS
from cairn_sim.robots.trajectories import stops
from cairn_sim.scene.scene_file import load_scene

scene, walle, noise = load_scene("small-room"), ROBOTS["orpheus"], Noise(seed=1)
rig = walle.rig_of(0.25)  # colour and thermal images a quarter as wide
with Robot(rig, sys.argv[1], directory="robot-state", name="walle") as robot:
    for stop, T_map_robot in enumerate(stops(scene, "west")[:2]):
        for scan, T_map_rig in enumerate(walle.head_poses(T_map_robot)):
            number = stop * walle.scans_per_stop + scan
            pose = {"T_map_rig": T_map_rig, "time_s": float(number)}
            robot.observe(render_scan(scene, rig, range_camera=RANGE_CAMERA, noise=noise, number=number, **pose))
        sys.stdout.write(f"{robot.commit()}\n")  # durable from here on, link or no link
        robot.sync()
    sys.stdout.write(f"{len(robot.map)} cells, {robot.waiting} commits wait\n")
