"""A whole robot in one page: a simulated head looks around at two stops and shares its measurements.

$ cairn serve &                                                    # in another terminal
$ cairn map create http://127.0.0.1:8750/maps/lab
$ cairn sim record small-room room --path west --stops 0:2 --scale 0.25    # its images, a recording
$ python docs/examples/simulated_robot.py http://127.0.0.1:8750/maps/lab room
"""

import sys

from cairn import Robot, open_recording

map_url, folder = sys.argv[1:]
recording = open_recording(folder)
with Robot(recording.rig, map_url, directory="robot-state", name="walle") as robot:
    for stop in recording.measurements():
        for index in stop:
            robot.observe(recording.scan(index))
        sys.stdout.write(f"{robot.commit()}\n")  # durable from here on, link or no link
        robot.sync()
    sys.stdout.write(f"{len(robot.map)} cells, {robot.waiting} commits wait\n")
