"""Calibration of each camera alone: homographies, Zhang's guess, then lens and boards with distortion (paper, III).

The joint solve starts from it. Images that do not determine the camera are refused here, with advice.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from cairn_calib.board.homography import fit_homography
from cairn_calib.rig.calibration import POSE_UNITS
from cairn_calib.rig.camera import Camera
from cairn_calib.rig.fisheye import FisheyeCamera
from cairn_calib.rig.lens import Lens
from cairn_calib.rig.poses import Transform
from cairn_calib.solve.adjustment import AdjustmentProblem, Sensor, adjust
from cairn_calib.solve.board_views import BoardView, BoardViews
from cairn_calib.solve.corner_residuals import corner_data
from cairn_calib.solve.priors import usual_priors
from cairn_calib.solve.rig_state import RigState, parameter_layout
from cairn_calib.solve.solve_plan import BROWN, FISHEYE, PINHOLE, CameraPlan, NoisePlan, SolvePlan
from cairn_calib.solve.zhang import first_camera_matrix, homography_of, pose_from_homography
from cairn_map.arrays import Floats
from cairn_map.errors import BadInputError

VIEWS_MIN = 2
"""Views of a camera: one leaves its focal length open."""
TILT_MIN_DEG = 3.0
"""Largest angle between two boards of a camera's views, degrees, below which they are as good as parallel."""
AHEAD = 0.2
"""Least z of a unit ray whose corner makes a pose: 78 degrees off the axis."""
FIRST = NoisePlan(huber_sigmas=1.5, cull_sigmas=4.0, rounds=1)
"""Noise of the solve of one camera: a single round, for the joint solve estimates it again."""


@dataclass(frozen=True, slots=True)
class CameraAlone:
    """A camera by its own images: the start of the joint solve."""

    lens: Lens
    T_camera_board: Mapping[str, Transform]
    """By frame."""
    scale: float
    """Noise of its corners over the stated one."""


def camera_alone(name: str, views: BoardViews, plan: SolvePlan) -> CameraAlone:
    """The camera by its own images.

    Raises:
        BadInputError: its views do not determine it.
    """
    # Zhang's guess, without distortion.
    seen = views.alone(name)
    knows_focal = {"fx", "fy"} <= set(plan.cameras[name].known)
    _refuse_too_few(name, len(seen.views), 1 if knows_focal else VIEWS_MIN)
    lens, poses = _guess(seen, plan.cameras[name])
    # The plan of a rig of this camera alone: a flat board of the stated pitch, and no priors of others.
    own = replace(
        plan,
        cameras={name: plan.cameras[name]},
        gauge=name,
        warp=False,
        pitch_sigma=0.0,
    )
    frames = seen.frames
    state = RigState(
        (lens,), np.eye(4)[None], np.stack([poses[frame] for frame in frames]), np.zeros(2), 1.0, np.zeros(0)
    )
    # Least squares over lens and boards.
    priors = usual_priors(own, {name: lens}, {name: len(seen.views)}, seen.board, ranges=None)
    data = corner_data(0, seen.of_camera(name), frames)
    layout = parameter_layout(own, {name: lens}, [])
    known = tuple(each for each in plan.known if each.camera == name and each.names[0] not in POSE_UNITS)
    problem = AdjustmentProblem(seen.board, layout, (Sensor(data, 1.0, data.seen),), priors, known)
    try:
        # Robust, since wrong corners are not known yet.
        done = adjust(problem, state, FIRST)
    except np.linalg.LinAlgError as exc:
        raise BadInputError("not_observable", f"the images of {name} do not determine its lens: {_ADVICE}") from exc
    # Parallel boards meet the corners at any focal length: small residuals do not show it.
    if not knows_focal:
        _refuse_parallel(name, done.state.T_rig_board)
    return CameraAlone(
        done.state.lenses[0],
        dict(zip(frames, done.state.T_rig_board, strict=True)),
        done.problem.sensors[0].scale,
    )


_ADVICE = (
    "take images with the board tilted by 20 to 40 degrees, to all sides, near and far, out to the image's corners"
)


def tilt_range_deg(T_camera_board: Floats) -> float:
    """Largest angle between the normals of (V, 4, 4) boards, degrees."""
    normals = T_camera_board[:, :3, 2]
    return float(np.degrees(np.arccos(np.clip((normals @ normals.T).min(), -1, 1))))


def _refuse_too_few(name: str, count: int, least: int) -> None:
    if count < least:
        raise BadInputError(
            "not_observable",
            f"{name} saw the board in {count} image{'s' * (count != 1)}, and needs {least} at the least, "
            f"better ten: {_ADVICE}",
        )


def _refuse_parallel(name: str, boards: Floats) -> None:
    tilt = tilt_range_deg(boards)
    if tilt < TILT_MIN_DEG:
        raise BadInputError(
            "not_observable",
            f"all boards that {name} saw are parallel (within {tilt:.1f} degrees; {TILT_MIN_DEG:g} are the least): a "
            f"larger focal length and a larger distance look the same; {_ADVICE}",
        )


def _guess(seen: BoardViews, plan: CameraPlan) -> tuple[Lens, dict[str, Transform]]:
    """A first lens, and T_camera_board by frame: from what is known of the lens, else from homographies."""
    (name,) = seen.cameras
    size = seen.sizes_px[name]
    # Views whose corners lie on a line have none, and were left out (`solve.py`).
    homographies = [homography_of(view.corners) for view in seen.views]
    usable = [(view, H) for view, H in zip(seen.views, homographies, strict=True) if H is not None]
    K = first_camera_matrix([view.corners for view, _ in usable], [H for _, H in usable], size)
    # Numbers that are known stand for guessed ones.
    known = plan.known
    K[0, 0], K[1, 1] = known.get("fx", K[0, 0]), known.get("fy", K[1, 1])
    K[0, 2], K[1, 2] = known.get("cx", K[0, 2]), known.get("cy", K[1, 2])
    lens = _lens(size, K, plan)
    # With distortion that is known, from rays; without, the least squares to come bend the lens and move the boards.
    poses = {view.frame: pose_from_homography(H, K) for view, H in usable}
    if any(lens.distortion):
        flat = {view.frame: _ray_homography(view, lens) for view, _ in usable}
        poses |= {frame: pose_from_homography(H, np.eye(3)) for frame, H in flat.items() if H is not None}
    return lens, poses


def _lens(size: tuple[int, int], K: Floats, plan: CameraPlan) -> Lens:
    """The lens of a camera matrix, with the coefficients that are known."""
    parts = {
        "width": size[0],
        "height": size[1],
        "focal_px": (float(K[0, 0]), float(K[1, 1])),
        "centre_px": (float(K[0, 2]), float(K[1, 2])),
    }
    if plan.model == "kb4":
        return FisheyeCamera.model_validate({**parts, "distortion": [plan.known.get(each, 0.0) for each in FISHEYE]})
    # Eight coefficients only where one of the denominator's is free, or known.
    named = {*plan.coefficients, *(each for each, value in plan.known.items() if value)}
    names = BROWN if {"k4", "k5", "k6"} & named else PINHOLE
    return Camera.model_validate({**parts, "distortion": [plan.known.get(each, 0.0) for each in names]})


def _ray_homography(view: BoardView, lens: Lens) -> Floats | None:
    """(3, 3) from metres on the board to the plane of unit focal length, by corners well before the camera."""
    seen = view.corners.seen
    rays = lens.unproject(view.corners.pixels[seen])
    # Corners to the side of a wide lens go to infinity on that plane.
    ahead = rays[:, 2] > AHEAD
    return fit_homography(view.corners.board.points()[seen][ahead, :2], rays[ahead, :2] / rays[ahead, 2:])
