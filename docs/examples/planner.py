"""A planner in C on a map: how far the straight way from one point to another is free.

$ here=$(python -c 'from cairn import PointHandle; print(PointHandle.HEADER.parent)')
$ cc -shared -fPIC -O2 -I"$here" docs/examples/planner.c -o planner.so -lm
$ python docs/examples/planner.py http://127.0.0.1:8750/maps/lab ./planner.so 2 2 1.2 4 2 1.2
free for 1.36 of 2.00 m
"""

import ctypes
import math
import sys

from cairn import PointHandle, open_map

map_url, library = sys.argv[1:3]
start_m, goal_m = [[float(number) for number in sys.argv[n : n + 3]] for n in (3, 6)]

free_way_m = ctypes.CDLL(library).free_way_m
free_way_m.restype = ctypes.c_double
point = ctypes.c_double * 3

snapshot = open_map(map_url)
with PointHandle(snapshot) as handle:  # the map's states stay in memory until the end of the block
    step_m = ctypes.c_double(snapshot.geometry.voxel_edge_m / 2)
    state, number = ctypes.c_void_p(handle.state_address), ctypes.c_uint64(handle.map)
    free_m = free_way_m(state, number, point(*start_m), point(*goal_m), step_m)
sys.stdout.write(f"free for {free_m:.2f} of {math.dist(start_m, goal_m):.2f} m\n")
