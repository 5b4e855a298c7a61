"""Discs calibrate without bias: the model predicts where the centroids of their images are."""

from dataclasses import replace

import numpy as np
import pytest
from tests.fixtures.calib.board_images import DISC, THERMAL, Floats, disc_centroids, pose

from cairn_calib.board.board import Board
from cairn_calib.board.corners import Corners
from cairn_calib.diagnosis.examination import examine
from cairn_calib.rig.rig import Spectrum
from cairn_calib.solve.board_views import BoardView, BoardViews
from cairn_calib.solve.corner_residuals import disc_shift
from cairn_calib.solve.solution import Solution
from cairn_calib.solve.solve import solve_rig
from cairn_calib.solve.solve_plan import STATED, usual_plan
from cairn_calib.solve.solved_rig import solved_rig

CENTRES = Board(pattern="circles", columns=4, rows=3, pitch_m=0.15)
"""Few large discs, as on heated boards; of unknown size."""
DISCS = Board(pattern="circles", columns=4, rows=3, pitch_m=0.15, disc_m=2 * DISC * 0.15)
SIGMA_PX = 0.005
FRAMES = 16


def test_the_centroid_of_a_disc_is_the_mean_of_the_pixels_that_see_it() -> None:
    lens, radius_m, fine = THERMAL.camera, 0.1, 8
    T = pose(np.random.default_rng(4), THERMAL, board=DISCS, tilt_deg=45)
    centre_px = lens.project(T[:3, 3])
    side = np.arange(-80 * fine, 80 * fine) / fine
    at = centre_px + np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    rays = lens.unproject(at)
    on_board = rays * ((T[:3, 2] @ T[:3, 3]) / (rays @ T[:3, 2]))[:, None] - T[:3, 3]
    inside = np.linalg.norm(on_board, axis=1) < radius_m
    shift = disc_shift(lens, T[None, None, :3, 3], T[None, :3, :3], radius_m)[0, 0]
    assert np.linalg.norm(shift) > 0.2
    assert at[inside].mean(axis=0) - centre_px == pytest.approx(shift, abs=0.01)


def solved(board: Board) -> Solution:
    """One thermal camera, calibrated with the centroids that it would find."""
    rng = np.random.default_rng(8)
    views = []
    for frame in range(FRAMES):
        T = pose(rng, THERMAL, board=DISCS, tilt_deg=45)
        pixels: Floats = disc_centroids(THERMAL, T, DISCS) + rng.normal(size=(DISCS.count, 2)) * SIGMA_PX
        corners = Corners(board, pixels, np.tile(SIGMA_PX**2 * np.eye(2), (DISCS.count, 1, 1)))
        views.append(BoardView("thermal", f"{frame:03d}", f"{frame}.png", corners))
    sizes = {"thermal": (THERMAL.camera.width, THERMAL.camera.height)}
    # With the stated noise, since an estimated one would cover up the bias.
    plan = replace(usual_plan({"thermal": Spectrum.THERMAL}), noise=STATED)
    return solve_rig(BoardViews(board, sizes, tuple(views)), plan)


def focal_off(solution: Solution) -> tuple[float, float]:
    """By how much the focal length is wrong, pixels, and in its own standard deviations."""
    lens = solution.state.lenses[0]
    off = float(lens.intrinsics[0] - THERMAL.camera.focal_px[0])
    return off, off / solution.sigmas()["thermal", lens.intrinsic_names[0]]


def warned(solution: Solution) -> bool:
    told = examine(solution, solved_rig(solution, made_s=0.0)).warnings
    return any(each.kind == "disc_diameter" for each in told)


def test_discs_calibrate_without_the_bias_of_unknown_diameters_which_is_warned_about() -> None:
    known, unknown = solved(DISCS), solved(CENTRES)
    off_px, off = focal_off(known)
    biased_px, biased = focal_off(unknown)
    assert abs(off) < 3
    assert abs(biased) > 5
    assert abs(biased_px) > 5 * abs(off_px)
    assert (warned(known), warned(unknown)) == (False, True)
