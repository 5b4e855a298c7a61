"""Two cameras solved by mrcal itself, for Debian's own Python, which alone has it: corners in, cameras out, as JSON.

$ /usr/bin/python3 tests/cairn_calib/mrcal_peer.py < tests/cairn_calib/mrcal_reference.json
"""

# mypy: ignore-errors
# pyright: basic, reportMissingImports=false

import json
import sys
import time

import mrcal
import numpy as np

COLUMNS, ROWS, PITCH_M = 9, 6, 0.025
SIZE = (640, 480)
MODEL = "LENSMODEL_OPENCV5"
START = (500.0, 500.0, 319.5, 239.5)
NAMES = ("left", "right")
FREED = ((True, False, False), (True, True, False), (True, True, True))
"""What is freed, stage by stage: focal lengths and places, then distortion, then the board's warp."""


def main():
    """Solve and print."""
    corners = np.array(json.load(sys.stdin)["corners_px"]).reshape(-1, ROWS, COLUMNS, 2)
    observations = np.concatenate((corners, np.ones((*corners.shape[:-1], 1))), axis=-1)
    indices = np.array([(i // 2, i % 2, i % 2 - 1) for i in range(len(observations))], dtype=np.int32)
    pinhole = ("LENSMODEL_PINHOLE", np.array(START))
    Rt_camera_board = mrcal.estimate_monocular_calobject_poses_Rt_tocam(
        indices[:, :2], observations.copy(), PITCH_M, [pinhole, pinhole]
    )
    rt_right_left = mrcal.rt_from_Rt(mrcal.compose_Rt(Rt_camera_board[1], mrcal.invert_Rt(Rt_camera_board[0])))
    problem = {
        "intrinsics": np.array([START + (0.0,) * 5] * 2),
        "extrinsics_rt_fromref": rt_right_left[None].copy(),
        "frames_rt_toref": mrcal.rt_from_Rt(Rt_camera_board[0::2]),
        "points": None,
        "observations_board": observations,
        "indices_frame_camintrinsics_camextrinsics": indices,
        "observations_point": None,
        "indices_point_camintrinsics_camextrinsics": None,
        "lensmodel": MODEL,
        "calobject_warp": np.zeros(2),
        "imagersizes": np.array([SIZE] * 2, dtype=np.int32),
        "calibration_object_spacing": PITCH_M,
        "do_apply_regularization": False,
        "do_apply_outlier_rejection": False,
    }
    for core, distortions, warp in FREED:
        start_s = time.process_time()
        stats = mrcal.optimize(
            **problem,
            do_optimize_intrinsics_core=core,
            do_optimize_intrinsics_distortions=distortions,
            do_optimize_extrinsics=True,
            do_optimize_frames=True,
            do_optimize_calobject_warp=warp,
        )
        joint_cpu_s = time.process_time() - start_s
    json.dump(
        {
            "intrinsics": dict(zip(NAMES, problem["intrinsics"].tolist(), strict=True)),
            "rt_right_left": problem["extrinsics_rt_fromref"][0].tolist(),
            "warp_m": problem["calobject_warp"].tolist(),
            "rms_px": stats["rms_reproj_error__pixels"],
            "joint_cpu_s": joint_cpu_s,
        },
        sys.stdout,
    )


if __name__ == "__main__":
    main()
