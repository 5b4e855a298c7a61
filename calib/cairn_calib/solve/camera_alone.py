"""Each camera by itself: homographies, Zhang's guess, then its lens and its boards with distortion (paper, III).

What comes out is where the joint solve starts; and what a camera's own images cannot tell is refused here, in words.
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
TILT_MIN_DEG = 3.0
"""Between the boards of a camera's views: under this they are as good as parallel."""
FIRST = NoisePlan(huber_sigmas=1.5, cull_sigmas=4.0, rounds=1)


@dataclass(frozen=True, slots=True)
class CameraAlone:
    """A camera by its own images."""

    lens: Lens
    T_camera_board: Mapping[str, Transform]
    """By frame."""
    scale: float
    """Of the noise of its corners, to the stated."""


def camera_alone(name: str, views: BoardViews, plan: SolvePlan) -> CameraAlone:
    """The camera by itself.

    Raises:
        BadInputError: its views do not determine it.
    """
    seen = views.alone(name)
    _refuse_too_few(name, len(seen.views))
    lens, poses = _guess(seen, plan.cameras[name])
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
    priors = usual_priors(own, {name: lens}, {name: len(seen.views)}, seen.board, ranges=None)
    data = corner_data(0, seen.of_camera(name), frames)
    layout = parameter_layout(own, {name: lens}, [])
    problem = AdjustmentProblem(seen.board, layout, (Sensor(data, 1.0, data.seen),), priors)
    try:
        done = adjust(problem, state, FIRST)
    except np.linalg.LinAlgError as exc:
        raise BadInputError("not_observable", f"the images of {name} do not determine its lens: {_ADVICE}") from exc
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
    usable = [(view, H) for view in seen.views if (H := homography_of(view.corners)) is not None]
    _refuse_too_few(name, len(usable))
    K = first_camera_matrix([view.corners for view, _ in usable], [H for _, H in usable], size)
    poses = {view.frame: pose_from_homography(H, K) for view, H in usable}
    parts = {
        "width": size[0],
        "height": size[1],
        "focal_px": (float(K[0, 0]), float(K[1, 1])),
        "centre_px": (float(K[0, 2]), float(K[1, 2])),
    }
    if plan.model == "kb4":
        return FisheyeCamera.model_validate(parts), poses
    rational = any(each in plan.coefficients for each in ("k4", "k5", "k6"))
    return Camera.model_validate({**parts, "distortion": (0.0,) * (8 if rational else 5)}), poses
