"""How fast a calibration is: the joint solve with its covariance, the whole of it, and OpenCV beside it."""

import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from tests.bench.timing import cpu_s, wall_s
from tests.fixtures.calib.board_images import BOARD, COLOUR, DISCS, THERMAL, TOF, picture, pose
from tests.fixtures.calib.mrcal_reference import mrcal_solved, reference_problem
from tests.fixtures.calib.simulated_views import SPECTRA, ranges_of, views_of, world

from cairn_calib.board.corner_detection import find_chessboard
from cairn_calib.board.discs.disc_grid import disc_candidates
from cairn_calib.diagnosis.examination import examine
from cairn_calib.solve.pixel_pattern import pixel_pattern
from cairn_calib.solve.solve import solve_from, solve_rig
from cairn_calib.solve.solve_plan import usual_plan
from cairn_calib.solve.solved_rig import solved_rig

Row = tuple[str, str, str]

FRAMES = 40
MRCAL_MS = 10
"""Of mrcal 2.2 for its joint solve of the same 13 pairs, on two shared cores: where it is not installed."""
PATTERN_M = 0.006 * np.random.default_rng(5).normal(size=(144, 176))


def calibration_rows(smoke: bool) -> Iterator[Row]:
    """Five cameras of three spectra before 40 places of a board; then the two colour cameras, with OpenCV."""
    repeats = 1 if smoke else 9
    truth = world(FRAMES, seed=5)
    views, plan = views_of(truth, seed=5), usual_plan(SPECTRA)
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
    ranges = ranges_of(replace(truth, pattern_m=PATTERN_M, has_amplitude=True), "tof", seed=5, sigma_m=0.006)
    ranged = replace(views, ranges=ranges)
    cpu = cpu_s(lambda: solve_from(ranged, plan, state, scales), repeats)
    yield "the same with 40 range images", f"{cpu:.2f}", "s of processor time"
    done = solve_from(ranged, plan, state, scales)
    cpu = cpu_s(lambda: pixel_pattern(ranged, done.adjustment, done.covariance), repeats)
    yield "offsets of its 176 x 144 pixels, by all on boards", f"{cpu:.2f}", "s of processor time"
    whole = cpu_s(lambda: solve_rig(views, plan), repeats)
    yield "all stages, 5 cameras x 40 frames, from corners alone", f"{whole:.2f}", "s of processor time"
    rig = solved_rig(solution, made_s=0.0)
    asked = cpu_s(lambda: examine(solution, rig), 1 if smoke else 3)
    yield "its examination", f"{asked:.2f}", "s of processor time"
    yield from _beside_opencv(repeats)
    views, plan = reference_problem()
    ours = cpu_s(lambda: solve_rig(views, plan), repeats)
    name = "OpenCV's 13 stereo pairs, from corners, with covariance"
    solved = mrcal_solved()
    theirs = f"{1000 * solved['joint_cpu_s']:.0f} ms, in this run" if solved else f"{MRCAL_MS} ms, measured before"
    yield name, f"{1000 * ours:.0f}", f"ms of processor time; mrcal's joint solve alone: {theirs}"
    yield from _corner_rows(repeats)


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


def _corner_rows(repeats: int) -> Iterator[Row]:
    """One place of a board before two colour, two thermal cameras and a time-of-flight camera, found one by one."""
    rng = np.random.default_rng(5)
    seen = (COLOUR, COLOUR, THERMAL, THERMAL, TOF)
    images = [(picture(each, pose(rng, each), rng), BOARD) for each in seen]

    def find() -> object:
        return [find_chessboard(*image) for image in images]

    yield (
        "corners: five images of one pose",
        f"{wall_s(find, repeats):.2f}",
        f"s wall, {cpu_s(find, repeats):.2f} s of CPU",
    )
    heated = picture(THERMAL, pose(rng, THERMAL, board=DISCS), rng, board=DISCS)
    counts = heated.astype(np.float32)

    def find_discs() -> object:
        return disc_candidates(counts, DISCS, polarity="vote", upright=False, pointed=None)

    cpu, wall = cpu_s(find_discs, repeats), wall_s(find_discs, repeats)
    yield "discs: one thermal image, polarity unknown", f"{cpu:.2f}", f"s of processor time, {wall:.2f} s wall"
    with tempfile.TemporaryDirectory() as name:
        paths = [Path(name) / f"{n}.png" for n in range(len(images))]
        for path, (image, _) in zip(paths, images, strict=True):
            cv2.imwrite(str(path), image)
        options = ["--board", "9x6", "--square", "0.05", "--output", str(Path(name) / "out")]
        line = [sys.executable, "-m", "cairn_calib.cli.corners", *map(str, paths), *options]

        def command() -> object:
            return subprocess.run(line, check=True, capture_output=True)

        yield "the same as cairn calib corners, pictures and start too", f"{wall_s(command, repeats):.2f}", "s wall"
    yield from _many_corner_rows(4 if repeats == 1 else 48)


def _many_corner_rows(count: int) -> Iterator[Row]:
    """A camera of 1280 x 1024 pixels before many places of a board, every sixth image without one."""
    rng = np.random.default_rng(5)
    spectrum = replace(COLOUR, camera=COLOUR.camera.model_copy(update={"height": 1024}))
    with tempfile.TemporaryDirectory() as name:
        paths = [Path(name) / f"{n}.png" for n in range(count)]
        for n, path in enumerate(paths):
            texture = 128 + 400 * cv2.GaussianBlur(rng.normal(size=(1024, 1280)), (0, 0), 4)
            image = texture if n % 6 == 5 else picture(spectrum, pose(rng, spectrum), rng)
            cv2.imwrite(str(path), np.clip(image, 0, 255).astype(np.uint8))
        options = ["--board", "9x6", "--square", "0.05", "--jobs", "2", "--output", str(Path(name) / "out")]
        line = [sys.executable, "-m", "cairn_calib.cli.corners", *map(str, paths), *options]
        took = wall_s(lambda: subprocess.run(line, check=True, capture_output=True), 1)
        yield f"cairn calib corners, {count} images of 1280 x 1024, 2 processes", f"{took:.1f}", "s wall, at most 15"
