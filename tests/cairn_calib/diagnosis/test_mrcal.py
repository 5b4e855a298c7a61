"""mrcal 2.2, an independent solver, on the same corners: the same cameras, and the same uncertainty of every pixel.

mrcal is a Debian package for Debian's own Python, so what it gave is kept next to this file, with its corners. Where
the package is installed (`apt-get install python3-mrcal`), it solves them again.
"""

import numpy as np
import pytest
from tests.fixtures.calib.mrcal_reference import NAMES, REFERENCE, mrcal_solved, reference_problem

from cairn_calib.diagnosis.probe_points import image_grid
from cairn_calib.diagnosis.world_uncertainty import pixel_covariance, world_covariance
from cairn_calib.rig.pose_vectors import vector_from_transform
from cairn_calib.rig.poses import inverse
from cairn_calib.solve.solution import Solution
from cairn_calib.solve.solve import solve_rig
from cairn_calib.solve.solved_rig import solved_rig


@pytest.fixture(scope="module")
def solution() -> Solution:
    return solve_rig(*reference_problem())


@pytest.mark.processes
@pytest.mark.parametrize("made", ["kept", "now"])
def test_mrcal_finds_the_same_cameras(solution: Solution, made: str) -> None:
    reference = REFERENCE if made == "kept" else mrcal_solved()
    if reference is None:
        pytest.skip("mrcal is not here: apt-get install python3-mrcal")
    for name, lens in zip(NAMES, solution.state.lenses, strict=True):
        theirs = lens.with_intrinsics(reference["intrinsics"][name])
        rays = lens.unproject(image_grid(640, 480, 20, 15))
        assert np.abs(theirs.project(rays) - lens.project(rays)).max() < 1e-4
    rt_right_left = vector_from_transform(inverse(solution.state.T_rig_camera[1]))
    assert rt_right_left == pytest.approx(reference["rt_right_left"], abs=1e-7)
    assert solution.state.warp_m == pytest.approx(reference["warp_m"], abs=1e-8)
    count = 2 * sum(len(view.corners.pixels) for view in solution.views.views)
    assert np.sqrt(solution.adjustment.normal.cost / count) == pytest.approx(reference["rms_px"], rel=1e-7)


def test_mrcal_states_the_same_uncertainty_of_every_pixel(solution: Solution) -> None:
    rig, world = solved_rig(solution, made_s=0.0), world_covariance(solution)
    pixels = np.array(REFERENCE["sigma_px"]["pixels"])
    for name in NAMES:
        for range_m, theirs in REFERENCE["sigma_px"]["by_range_m"][name].items():
            covariance = pixel_covariance(solution, rig, world, name, pixels, float(range_m))
            # mrcal takes the residuals' rms for the corners' noise; here it was stated as 1 px.
            ours = REFERENCE["rms_px"] * np.sqrt(np.trace(covariance, axis1=1, axis2=2) / 2)
            assert ours == pytest.approx(theirs, rel=1e-5)
