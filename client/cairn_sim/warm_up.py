"""Every kernel of this package, run once on a small view, so that Numba compiles it ahead and keeps it."""

from cairn_sim.drive import head_poses, stops
from cairn_sim.heads import RANGE_CAMERA, tof_head
from cairn_sim.render import render_scan
from cairn_sim.room import small_room


def warm_up() -> None:
    """Look once around the corner of the room."""
    pose = head_poses(stops("west")[0], n_yaw=1, n_pitch=1)[0]
    render_scan(small_room(), tof_head(), T_map_rig=pose, range_camera=RANGE_CAMERA, time_s=0.0, rng=None)
