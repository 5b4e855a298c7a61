"""Range images of z-depth and disparity: the same rig as of ranges along the beam, with the right derivatives."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from tests.fixtures.calib.simulated_views import (
    BOARD,
    TOF,
    World,
    errors_of,
    ranges_of,
    views_of,
    world,
    write_corner_files,
)

from cairn_calib.cli.main import main
from cairn_calib.rig.rig import Spectrum, load_rig
from cairn_calib.solve.board_views import BoardViews, RangeCoding, RangeView
from cairn_calib.solve.normal_equations import Loss
from cairn_calib.solve.range_residuals import RangeData, range_block
from cairn_calib.solve.rig_state import step_state
from cairn_calib.solve.solution import Solution
from cairn_calib.solve.solve import solve_rig
from cairn_calib.solve.solve_plan import usual_plan
from cairn_map.errors import BadInputError

SIGMA_M = 0.006
SPECTRA = {"tof": Spectrum.RANGE, "left": Spectrum.COLOUR}


def scene() -> tuple[World, BoardViews, tuple[RangeView, ...]]:
    truth = world(8, seed=6, names=tuple(SPECTRA), bias=(0.02, 0.0, 0.0, 0.0))
    return truth, views_of(truth, seed=6), ranges_of(truth, "tof", seed=6, sigma_m=SIGMA_M)


def along_axis(ranges: tuple[RangeView, ...]) -> tuple[RangeView, ...]:
    """The images as z-depth, by the true lens."""
    return tuple(replace(each, range_m=each.range_m * TOF.rays()[..., 2], is_z_depth=True) for each in ranges)


@pytest.fixture(scope="module")
def solved() -> dict[str, Solution]:
    _, views, radial = scene()
    kinds = {"radial": radial, "z": along_axis(radial)}
    return {name: solve_rig(replace(views, ranges=ranges), usual_plan(SPECTRA)) for name, ranges in kinds.items()}


def test_z_depth_gives_the_rig_and_the_bias_that_ranges_along_the_beam_give(solved: dict[str, Solution]) -> None:
    radial, z = solved["radial"], solved["z"]
    sigmas = radial.sigmas()
    assert z.sigmas().keys() == sigmas.keys()
    truth, _, _ = scene()
    for key, error in errors_of(z, truth).items():
        assert abs(error) < 4 * z.sigmas()[key], key
        assert abs(z.values()[key] - radial.values()[key]) < 3 * sigmas[key], key
    assert z.values()["tof", "offset_m"] == pytest.approx(0.02, abs=4 * z.sigmas()["tof", "offset_m"])
    # The lens matters less where it turns the ray and the range together: certainty is another, not absent.
    assert 0.3 < z.sigmas()["tof", "fx"] / sigmas["tof", "fx"] < 3


def test_z_depth_that_is_taken_for_range_shows_as_a_bias_that_grows_to_the_image_corners() -> None:
    _, views, radial = scene()
    wrong = tuple(replace(each, is_z_depth=False) for each in along_axis(radial))
    solution = solve_rig(replace(views, ranges=wrong), usual_plan(SPECTRA))
    assert abs(solution.values()["tof", "radial_m"]) > 10 * solution.sigmas()["tof", "radial_m"]


def test_derivatives_agree_with_differences(solved: dict[str, Solution]) -> None:
    done = solved["z"].adjustment
    data, layout = done.problem.sensors[-1].data, done.problem.layout
    assert isinstance(data, RangeData) and data.along_axis is not None
    start = done.state
    loss = Loss(1.0, data.measured, np.inf)
    block = range_block(data, start, layout, BOARD, loss)
    boards = np.zeros((len(start.T_rig_board), 6))
    for position, name in enumerate(layout.names):
        if name not in (("tof", "fx"), ("tof", "cx"), ("tof", "k1"), ("tof", "offset_m")):
            continue
        step = 1e-5 if name[1] in ("fx", "cx") else 1e-7
        shared = np.zeros(layout.size)
        shared[position] = step
        up, down = (
            range_block(data, step_state(start, layout, sign * shared, boards), layout, BOARD, loss).cost
            for sign in (1, -1)
        )
        at = np.flatnonzero(block.at == position)[0]
        # pull = -J^T r, and the cost is r^T r.
        assert -2 * block.pull[:, at].sum() == pytest.approx((up - down) / (2 * step), rel=1e-3, abs=1.0), name


def test_counts_of_disparity_become_z_depth() -> None:
    coding = RangeCoding(units=256.0, disparity=(1050.0, 0.12))
    counts = np.array([[0.0, 256.0 * 63, 128.0]])
    np.testing.assert_allclose(coding.metres(counts), [[np.nan, 2.0, 252.0]])
    assert coding.is_along_axis and RangeCoding(is_z_depth=True).is_along_axis and not RangeCoding().is_along_axis
    with pytest.raises(BadInputError, match="above 0"):
        RangeCoding(units=256.0, disparity=(1050.0, 0.0))


@pytest.mark.parametrize("kind", ["z-depth", "disparity"])
def test_the_command_takes_depth_and_disparity_images(kind: str, tmp_path: Path) -> None:
    _, views, radial = scene()
    folders = [str(folder) for folder in write_corner_files(views, tmp_path).values()]
    (tmp_path / "depth").mkdir()
    for each in along_axis(radial):
        metres = np.nan_to_num(each.range_m)
        counts = (
            10_000 * metres if kind == "z-depth" else np.where(metres > 0, 256 * 900 * 0.2 / np.maximum(metres, 0.1), 0)
        )
        cv2.imwrite(str(tmp_path / "depth" / f"tof{each.frame}.png"), counts.round().astype(np.uint16))
    how = ["--z-depth", "--range-units-per-m", "10000"] if kind == "z-depth" else ["--disparity", "900,0.2,256"]
    options = ["--spectrum", "tof=range,left=colour", "--output", str(tmp_path / "rig.json")]
    main(["solve", *folders, *options, "--range", str(tmp_path / "depth"), *how])
    bias = load_rig(tmp_path / "rig.json")["tof"].range_bias
    assert bias is not None
    assert bias.offset_m == pytest.approx(0.02, abs=4 * np.sqrt(bias.covariance[0, 0]))
    for wrong, named in (
        (["--z-depth", "--disparity", "1,1,1"], "give --z-depth or --disparity"),
        (["--disparity", "900,0.2"], "--disparity is the focal length"),
        (["--z-depth", "--fisheye", "tof"], "tof is a fisheye, which has no z-depth"),
    ):
        with pytest.raises(BadInputError, match=named):
            main(["solve", *folders, *options, "--range", str(tmp_path / "depth"), *wrong])
    with pytest.raises(BadInputError, match="--z-depth: of range images; add --range"):
        main(["solve", *folders, *options, "--z-depth"])
