"""A door of your own in one page: range images of any driver, with poses, become a map as they come.

The driver writes one scan after the other to standard output, each as numpy.savez makes it: time_s (UTC seconds),
T_map_rig (4 x 4) and range_m (rows x columns, float32 metres along the beams, NaN where nothing came back).

$ ./my_driver | python docs/examples/own_door.py rig.json tof http://127.0.0.1:8750/maps/lab
"""

import io
import struct
import sys
from typing import BinaryIO

import numpy as np

from cairn import BadInputError, Robot, Scan, geometry_for, load_rig

SCANS, SCAN_BYTES_MAX = 30, 64 << 20


def scans_of(stream: BinaryIO, camera: str):
    """Scans of a stream in which each has its length in front, 4 bytes."""
    while len(head := stream.read(4)) == 4:
        (size,) = struct.unpack("<I", head)
        if size > SCAN_BYTES_MAX:
            raise SystemExit(f"a scan of {size} bytes: is this the driver's output?")
        with np.load(io.BytesIO(stream.read(size)), allow_pickle=False) as found:
            yield Scan(
                time_s=float(found["time_s"]),
                T_map_rig=found["T_map_rig"],
                range_camera=camera,
                range_m=found["range_m"].astype(np.float32),
            )


def map_all(stream: BinaryIO, rig_file: str, camera: str, map_url: str, folder: str = "robot-state") -> int:
    """Map a stream to its end; the number of scans."""
    count = 0
    grid = geometry_for(voxel_edge_m=0.05)  # used only if the server cannot be asked
    with Robot(load_rig(rig_file), map_url, directory=folder, name="walle", geometry=grid) as robot:
        robot.start_sync()  # in the background; without a link commits wait in the folder
        for scan in scans_of(stream, camera):
            try:
                robot.observe(scan)
            except BadInputError as error:  # not this rig's: nothing was added
                sys.stderr.write(f"left out: {error}\n")
                continue
            count += 1
            if count % SCANS == 0:
                robot.commit()  # durable from here on
    return count  # what was open at the end is committed, too


if __name__ == "__main__":
    sys.stdout.write(f"{map_all(sys.stdin.buffer, *sys.argv[1:])} scans\n")
