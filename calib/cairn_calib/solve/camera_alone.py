"""Calibration of each camera alone: homographies, Zhang's guess, then lens and boards with distortion (paper, III).

The joint solve starts from it. Images that do not determine the camera are refused here, with advice.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from cairn_calib.rig.camera import Camera
from cairn_calib.rig.fisheye import FisheyeCamera
from cairn_calib.rig.lens import Lens
from cairn_calib.rig.poses import Transform
from cairn_calib.solve.adjustment import AdjustmentProblem, Sensor, adjust
from cairn_calib.solve.board_views import BoardViews
from cairn_calib.solve.corner_residuals import corner_data
from cairn_calib.solve.priors import usual_priors
from cairn_calib.solve.rig_state import RigState, parameter_layout
from cairn_calib.solve.solve_plan import CameraPlan, NoisePlan, SolvePlan
from cairn_calib.solve.zhang import first_camera_matrix, homography_of, pose_from_homography
from cairn_map.arrays import Floats
from cairn_map.errors import BadInputError

VIEWS_MIN = 2
"""Views of a camera: one leaves its focal length open."""
TILT_MIN_DEG = 3.0
"""Largest angle between two boards of a camera's views, degrees, below which they are as good as parallel."""
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
    _refuse_too_few(name, len(seen.views))
    lens, poses = _guess(seen, plan.cameras[name])
    # The plan of a rig of this camera alone: a flat board of the stated pitch, and no priors of others.
    own = replace(
        plan,
        cameras={name: plan.cameras[name]},
        gauge=name,
        warp=False,
        pitch_sigma=0.0,
        priors=tuple(prior for prior in plan.priors if {owner for owner, _, _ in prior.terms} == {name}),
    )
    frames = seen.frames
    state = RigState(
        (lens,), np.eye(4)[None], np.stack([poses[frame] for frame in frames]), np.zeros(2), 1.0, np.zeros(0)
    )
    # Least squares over lens and boards.
    priors = usual_priors(own, {name: lens}, {name: len(seen.views)}, seen.board, ranges=None)
    data = corner_data(0, seen.of_camera(name), frames)
    layout = parameter_layout(own, {name: lens}, [])
    problem = AdjustmentProblem(seen.board, layout, (Sensor(data, 1.0, data.seen),), priors)
    try:
        # Robust, since wrong corners are not known yet.
        done = adjust(problem, state, FIRST)
    except np.linalg.LinAlgError as exc:
        raise BadInputError("not_observable", f"the images of {name} do not determine its lens: {_ADVICE}") from exc
    # Parallel boards meet the corners at any focal length: small residuals do not show it.
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


def _refuse_too_few(name: str, count: int) -> None:
    if count < VIEWS_MIN:
        raise BadInputError(
            "not_observable",
            f"{name} saw the board in {count} image{'s' * (count != 1)}, and needs {VIEWS_MIN} at the least, "
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
    (name,) = seen.cameras
    size = seen.sizes_px[name]
    # Views whose corners lie on a line have none, and were left out (`solve.py`).
    usable = [(view, H) for view in seen.views if (H := homography_of(view.corners)) is not None]
    _refuse_too_few(name, len(usable))
    K = first_camera_matrix([view.corners for view, _ in usable], [H for _, H in usable], size)
    # Without distortion: the least squares to come bend the lens and move the boards.
    poses = {view.frame: pose_from_homography(H, K) for view, H in usable}
    parts = {
        "width": size[0],
        "height": size[1],
        "focal_px": (float(K[0, 0]), float(K[1, 1])),
        "centre_px": (float(K[0, 2]), float(K[1, 2])),
    }
    if plan.model == "kb4":
        return FisheyeCamera.model_validate(parts), poses
    # Eight coefficients only where one of the denominator's is free.
    rational = any(each in plan.coefficients for each in ("k4", "k5", "k6"))
    return Camera.model_validate({**parts, "distortion": (0.0,) * (8 if rational else 5)}), poses
