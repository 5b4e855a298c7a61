"""Every kernel of this package, run once on a small view, so that Numba compiles it ahead and keeps it."""

import numpy as np

from cairn_sim.evaluation.truth_grid import VoxelBox, truths_of
from cairn_sim.render.render import render_scan
from cairn_sim.render.sensors import Noise
from cairn_sim.robots.heads import RANGE_CAMERA, full_head
from cairn_sim.robots.trajectories import stops
from cairn_sim.scene.scene_file import load_scene


def warm_up() -> None:
    """Look once around the corner of the room."""
    scene, rig = load_scene("small-room"), full_head(scale=0.05)
    T_map_rig = stops(scene, "west")[0]
    T_map_rig[2, 3] += 1
    render_scan(scene, rig, T_map_rig=T_map_rig, range_camera=RANGE_CAMERA, time_s=0.0, noise=Noise(1))
    scene.temperature_k_at(np.zeros((1, 3)))
    mounted = rig[RANGE_CAMERA]
    box = VoxelBox((0, 0, 0), (8, 8, 8), 500_000)
    truths_of(scene, [box], camera=mounted.camera, T_map_cameras=[T_map_rig @ mounted.transform], fineness=1)
