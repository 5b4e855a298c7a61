"""How fast a calibration is: the joint solve with its covariance, the whole of it, and OpenCV beside it."""

from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np
from tests.bench.timing import cpu_s, wall_s
from tests.cairn_calib.simulated_views import SPECTRA, views_of, world

from cairn_calib.examination import examined
from cairn_calib.solve import solve_from, solve_rig
from cairn_calib.solve_plan import usual_plan
from cairn_calib.solved_rig import solved_rig

Row = tuple[str, str, str]

FRAMES = 40


def calibration_rows(smoke: bool) -> Iterator[Row]:
    """Five cameras of three spectra before 40 places of a board; then the two colour cameras, with OpenCV."""
    repeats = 3 if smoke else 9
    views, plan = views_of(world(FRAMES, seed=5), seed=5), usual_plan(SPECTRA)
    solution = solve_rig(views, plan)
    # About where the single cameras leave off: a pixel away.
    rng = np.random.default_rng(5)
    state = solution.state
    T = state.T_rig_board.copy()
    T[:, :3, 3] += 2e-3 * rng.normal(size=(len(T), 3))
    state = replace(state, T_rig_board=T, warp_m=np.zeros(2), scale=1.0)
    scales = dict.fromkeys(plan.cameras, 1.5)

    def joint() -> object:
        return solve_from(views, plan, state, scales)

    cpu, wall = cpu_s(joint, repeats), wall_s(joint, repeats)
    yield "joint solve, 5 cameras x 40 frames, with covariance", f"{cpu:.2f}", f"s of processor time, {wall:.2f} s wall"
    whole = cpu_s(lambda: solve_rig(views, plan), repeats)
    yield "the same from the corners alone", f"{whole:.2f}", "s of processor time"
    rig = solved_rig(solution, made_s=0.0)
    asked = cpu_s(lambda: examined(solution, rig), 1 if smoke else 3)
    yield "its examination", f"{asked:.2f}", "s of processor time"
    yield from _beside_opencv(repeats)


def _beside_opencv(repeats: int) -> Iterator[Row]:
    truth = world(20, seed=5, names=("left", "right"))
    views = views_of(truth, seed=5)
    partly = {view.frame for view in views.views if not view.corners.seen.all()}
    whole = [frame for frame in views.frames if frame not in partly]
    views = views.of_frames(whole)
    plan = usual_plan({name: SPECTRA[name] for name in truth.names})
    left, right = ([view.corners.pixels.astype(np.float32) for view in views.of_camera(name)] for name in truth.names)
    points = [views.board.points().astype(np.float32)] * len(left)

    def theirs() -> object:
        alone = [cv2.calibrateCamera(points, each, (1280, 960), np.eye(3), np.zeros(5))[1:3] for each in (left, right)]
        return cv2.stereoCalibrate(
            points, left, right, *alone[0], *alone[1], (1280, 960), flags=cv2.CALIB_USE_INTRINSIC_GUESS
        )

    ours_s, theirs_s = cpu_s(lambda: solve_rig(views, plan), repeats), cpu_s(theirs, repeats)
    name = f"two cameras x {len(whole)} frames, from corners, with covariance"
    yield name, f"{1000 * ours_s:.0f}", f"ms of processor time; OpenCV without: {1000 * theirs_s:.0f} ms"
