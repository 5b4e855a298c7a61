"""Bias of a range camera: solved, stated in the rig, and taken off wherever its ranges are used."""

import json
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from tests.fixtures.calib.simulated_views import BOARD, SPECTRA, TOF, World, ranges_of, views_of, world
from tests.fixtures.fusion.scans import BARREL, GEOMETRY, random_scan, rig_of

from cairn_calib.diagnosis.solve_warnings import warnings_of
from cairn_calib.exchange.rig_exchange import cameras_of_rig
from cairn_calib.rig.lidar import SpinningLidar
from cairn_calib.rig.range_bias import RangeBias
from cairn_calib.rig.range_terms import off_middle_image
from cairn_calib.rig.rig import MountedCamera, Rig, Spectrum, mount_camera, rig_from_json
from cairn_calib.solve.board_views import RangeView
from cairn_calib.solve.solve import solve_rig
from cairn_calib.solve.solve_plan import usual_plan
from cairn_calib.solve.solved_rig import solved_rig
from cairn_fusion.image_fusion.surface import live_range, surface_of
from cairn_fusion.mapping.beam_returns import returns_of
from cairn_fusion.mapping.integrate import Integrator, integrate_scan
from cairn_fusion.recording.scan import Scan
from cairn_map.errors import BadInputError

Floats = npt.NDArray[np.float64]

PAIR = ("tof", "left")
BIAS = (0.04, 0.006, 0.03, -0.02)
STATED = RangeBias(
    offset_m=0.04,
    scale=0.006,
    radial_m=0.03,
    radial4_m=-0.02,
    covariance_lower=((1e-4,), (-1e-5, 4e-6), (0.0, 0.0, 9e-6), (0.0, 0.0, -4e-6, 9e-6)),
)


def stated(rig: Rig) -> Rig:
    return rig.model_copy(update={"cameras": {"tof": rig["tof"].model_copy(update={"range_bias": STATED})}})


def solved(truth: World) -> Rig:
    views = replace(views_of(truth, seed=4), ranges=ranges_of(truth, "tof", seed=4, sigma_m=0.006))
    plan = usual_plan({name: SPECTRA[name] for name in truth.names}, gauge="tof")
    return rig_from_json(solved_rig(solve_rig(views, plan), made_s=0.0).to_json())


def off_by(rig: Rig, measured: tuple[RangeView, ...], truth: tuple[RangeView, ...]) -> Floats:
    """Mapped minus true ranges of all pixels that became points, metres."""
    off = []
    for image, true in zip(measured, truth, strict=True):
        scan = Scan(time_s=0.0, T_map_rig=np.eye(4), range_camera="tof", range_m=image.range_m.astype(np.float32))
        returns = returns_of(scan, rig, min_range_m=0.1, max_range_m=10)
        off.append((returns.range_m - true.range_m).ravel()[returns.pixels])
    return np.concatenate(off)


def test_after_a_solve_mapped_ranges_are_true_again() -> None:
    truth = world(8, seed=4, names=PAIR, bias=BIAS)
    rig = solved(truth)
    # Boards that the solve has not seen.
    other = world(6, seed=9, names=PAIR, bias=BIAS)
    measured = ranges_of(other, "tof", seed=1, sigma_m=0.006)
    exact = ranges_of(replace(other, bias=(0.0, 0.0, 0.0, 0.0)), "tof", seed=1, sigma_m=0.0)
    blind = rig.model_copy(update={"cameras": {"tof": rig["tof"].model_copy(update={"range_bias": None})}})
    assert abs(float(np.mean(off_by(blind, measured, exact)))) > 0.05
    left = off_by(rig, measured, exact)
    assert len(left) > 5000
    bias = rig["tof"].range_bias
    assert bias is not None
    assert abs(float(np.mean(left))) < min(3 * float(bias.sigma_at(np.array(2.0))), 0.005)
    assert float(np.std(left)) == pytest.approx(0.006, rel=0.1)


def test_the_solve_states_value_and_covariance_at_the_range_camera() -> None:
    rig = solved(world(8, seed=4, names=PAIR, bias=BIAS))
    bias = rig["tof"].range_bias
    assert bias is not None and rig["left"].range_bias is None
    assert np.abs((bias.values - BIAS) / np.sqrt(np.diag(bias.covariance))).max() < 3
    assert bias.covariance[0, 1] < 0  # a larger offset with a smaller scale


def test_without_ranges_a_solve_states_no_bias() -> None:
    views = views_of(world(6, seed=2, names=PAIR), seed=2)
    rig = solved_rig(solve_rig(views, usual_plan({name: SPECTRA[name] for name in PAIR}, gauge="tof")), made_s=0.0)
    assert b"range_bias" not in rig.to_json()


def test_a_rig_without_bias_leaves_every_range_as_it_is() -> None:
    scan, rig = random_scan(BARREL, 3), rig_of(BARREL)
    assert rig["tof"].true_ranges(scan.range_m) is scan.range_m
    assert b"range_bias" not in rig.to_json()


def test_mapping_with_a_bias_is_mapping_the_ranges_without_it() -> None:
    scan, rig = random_scan(BARREL, 3), rig_of(BARREL)
    limits = Integrator(min_range_m=0.3, max_range_m=3.0)
    certain = RangeBias(offset_m=0.04, scale=0.006, radial_m=0.03, radial4_m=-0.02)
    biased = rig.model_copy(update={"cameras": {"tof": rig["tof"].model_copy(update={"range_bias": certain})}})
    y, x = np.mgrid[: BARREL.height, : BARREL.width]
    pixels = np.stack([x, y], axis=-1).astype(np.float64)
    plain = replace(scan, range_m=certain.true_at(BARREL, pixels, scan.range_m.astype(np.float64)).astype(np.float32))
    one, other = (integrate_scan(each, by, GEOMETRY, integrator=limits) for each, by in ((scan, biased), (plain, rig)))
    assert one.keys() == other.keys() and len(one) > 0
    for key in one:
        np.testing.assert_array_equal(one[key].voxels, other[key].voxels)
        np.testing.assert_array_equal(one[key].counts, other[key].counts)
    np.testing.assert_array_equal(surface_of(scan, biased).range_m, surface_of(plain, rig).range_m)
    np.testing.assert_array_equal(live_range(scan, biased, camera="tof"), live_range(plain, rig, camera="tof"))


def test_taking_off_undoes_adding() -> None:
    rng = np.random.default_rng(0)
    true_m = rng.uniform(0.3, 8, (TOF.height, TOF.width))
    true_m[3, 4] = np.nan
    shapes = STATED.terms.shapes(true_m, off_middle_image(TOF.width, TOF.height), np.zeros_like(true_m))
    np.testing.assert_allclose(STATED.true_image(TOF, true_m + shapes @ STATED.values), true_m, rtol=1e-12)
    with pytest.raises(BadInputError, match="range image must be 176 x 144"):
        STATED.true_image(TOF, true_m[1:])


def test_what_is_not_known_of_the_bias_is_in_the_range_s_sigma() -> None:
    rig = rig_of(BARREL)
    range_m = np.array([1.0, 4.0, np.nan])
    s = np.array([1.0, 4.0, 1 / 3, 1 / 9])
    expected = np.sqrt(rig["tof"].range_sigma_m(range_m)[1] ** 2 + s @ STATED.covariance @ s)
    sigma_m = stated(rig)["tof"].range_sigma_m(range_m)
    assert sigma_m[1] == pytest.approx(expected) and np.isnan(sigma_m[2])


def test_what_is_stated_comes_back_and_other_formats_want_it_dropped() -> None:
    rig = stated(rig_of(BARREL))
    assert rig_from_json(rig.to_json()) == rig
    with pytest.raises(BadInputError, match=r"cameras\.tof\.range_bias; .* --drop range_bias"):
        cameras_of_rig(rig, format_name="opencv")
    assert cameras_of_rig(rig, format_name="opencv", drop=["range_bias"]).left_out[0] == "cameras.tof.range_bias"


@pytest.mark.parametrize(
    "wrong",
    [
        {"version": 2},
        {"scale": -1.0},
        {"offset_m": 1e999},
        {"covariance_lower": [[-1e-6], [0.0, 1e-6], [0.0, 0.0, 1e-6], [0.0, 0.0, 0.0, 1e-6]]},
        {"covariance_lower": [[1e-6], [2e-6, 1e-6], [0.0, 0.0, 1e-6], [0.0, 0.0, 0.0, 1e-6]]},
        {"covariance_lower": [[1e-6], [0.0, 1e-6]]},
        {"wiggle": 1},
    ],
)
def test_a_bias_that_makes_no_sense_is_refused(wrong: dict[str, object]) -> None:
    document = json.loads(stated(rig_of(BARREL)).to_json())
    document["cameras"]["tof"]["range_bias"].update(wrong)
    with pytest.raises(BadInputError, match="range_bias"):
        rig_from_json(json.dumps(document).encode())


def test_only_range_cameras_with_a_lens_have_a_bias() -> None:
    lidar = mount_camera(Spectrum.RANGE, SpinningLidar(width=8, height=1, elevations_deg=(0.0,)), np.eye(4))
    for each, told in ((lidar, "lidars"), (mount_camera(Spectrum.COLOUR, BARREL, np.eye(4)), "colour")):
        document = each.model_dump() | {"range_bias": STATED.model_dump()}
        with pytest.raises(ValueError, match=f"not of {told}"):
            MountedCamera.model_validate(document)


def test_the_fourth_power_is_found_at_the_image_s_corners_and_else_told_to_be_assumed() -> None:
    plan = usual_plan({"tof": Spectrum.RANGE})
    solutions = []
    for frames, reach in ((8, 1.0), (16, 1.7)):
        truth = world(frames, seed=4, names=("tof",), bias=BIAS)
        boards = truth.boards.copy()
        boards[:, :2, 3] += (reach - 1) * (boards @ np.append(BOARD.points().mean(axis=0), 1.0))[:, :2]
        truth = replace(truth, boards=boards)
        views = replace(views_of(truth, seed=4), ranges=ranges_of(truth, "tof", seed=4, sigma_m=0.006))
        solutions.append(solve_rig(views, plan))
    near, far = ([each.text for each in warnings_of(found, [], [], None, [], [], [])] for found in solutions)
    assert any("radial4_m" in text and "what was assumed before" in text for text in near)
    assert not any("radial4_m" in text for text in far)
    value, sigma = solutions[1].values()["tof", "radial4_m"], solutions[1].sigmas()["tof", "radial4_m"]
    assert abs(value - BIAS[3]) < 3 * sigma < 0.03
