"""Targets carried by Eq. 1 to 6, what was to be expected of the differences, and Table 2."""

import json
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

from cairn_calib.rig.calibration import Calibration, covariance_from_matrix
from cairn_calib.rig.camera import Camera
from cairn_calib.rig.pose_vectors import transform_from_vector
from cairn_calib.rig.poses import inverse
from cairn_calib.rig.range_bias import RangeBias
from cairn_calib.rig.rig import Rig, Spectrum, mount_camera
from cairn_calib.verify.disc_images import Disc
from cairn_calib.verify.verification import (
    PoseTargets,
    Sightings,
    TargetSighting,
    add_sights,
    range_camera_of,
    transfer_pixels,
)
from cairn_calib.verify.verification_report import verification_json, verification_page
from cairn_calib.verify.verification_table import table_of, table_text
from cairn_map.errors import BadInputError

Floats = npt.NDArray[np.float64]
TOF = Camera(width=176, height=144, focal_px=(128.0, 128.0), centre_px=(88.0, 71.0))
COLOUR = Camera(width=1280, height=960, focal_px=(1340.0, 1340.0), centre_px=(640.0, 480.0))
T_RIG_LEFT = transform_from_vector([0.01, -0.03, 0.005, -0.11, -0.05, 0.01])
RIG = Rig(
    name="head",
    cameras={
        "tof": mount_camera(Spectrum.RANGE, TOF, np.eye(4)),
        "left": mount_camera(Spectrum.COLOUR, COLOUR, T_RIG_LEFT),
    },
)
SIGMA_PX = {Spectrum.RANGE: 0.1, Spectrum.COLOUR: 0.2, Spectrum.THERMAL: 0.1}
NAMES = [("tof", "fx"), ("tof", "cx"), ("left", "fx"), ("left", "ry"), ("left", "tx")]


def certain(rig: Rig, sigmas: tuple[float, ...]) -> Rig:
    """The rig with a covariance of a few of its numbers."""
    covariance = covariance_from_matrix(NAMES, np.diag(np.square(sigmas)))
    calibration = Calibration(software="test", made_s=0, gauge="tof", covariance=covariance)
    return rig.model_copy(update={"calibration": calibration})


def test_carried_pixels_are_those_of_the_papers_equations() -> None:
    rng = np.random.default_rng(1)
    pixels, d = rng.uniform([60, 50], [110, 90], (50, 2)), rng.uniform(1.1, 5.7, 50)
    f, (x, y) = TOF.focal_px[0], (pixels - TOF.centre_px).T
    # Eq. 2 as printed, then 1, 5 and 6.
    Z = d * np.cos(np.arctan(y / np.sqrt(f**2 + x**2))) * np.cos(np.arctan(x / f))
    np.testing.assert_allclose(Z, d * f / np.sqrt(x**2 + y**2 + f**2), rtol=1e-12)
    there = inverse(T_RIG_LEFT) @ np.stack([Z * x / f, Z * y / f, Z, np.ones(50)])
    expected = np.array(COLOUR.centre_px)[:, None] + COLOUR.focal_px[0] * there[:2] / there[2]
    np.testing.assert_allclose(transfer_pixels(RIG, "tof", "left", pixels, d), expected.T, atol=1e-8)


def seen(rig: Rig, pixel: Floats, range_m: float, *, off_px: tuple[float, float] = (0, 0)) -> PoseTargets:
    """A target of 30 cm that faces the range camera, and where another camera sees it."""
    radius_px = 0.15 / range_m * TOF.focal_px[0]
    y, x = np.mgrid[: TOF.height, : TOF.width]
    inside = np.argwhere(np.hypot(x - pixel[0], y - pixel[1]) < max(radius_px - 1, 1.6))[:, ::-1]
    at = transfer_pixels(rig, "tof", "left", pixel, np.array(range_m)) + off_px
    other = Disc(at, radius_px * COLOUR.focal_px[0] / TOF.focal_px[0], np.zeros((0, 2), np.int64))
    axis = TOF.unproject(pixel)
    return PoseTargets("000", range_m / (TOF.rays() @ axis), {"tof": [Disc(pixel, radius_px, inside)], "left": [other]})


def test_differences_are_predicted_minus_found_and_far_or_small_discs_are_not_taken() -> None:
    found = seen(RIG, np.array([90.0, 70.0]), 3.0, off_px=(4.0, -7.0))
    sightings = Sightings(RIG, "tof", "grey")
    add_sights(sightings, found)
    (sight,) = sightings.sights
    np.testing.assert_allclose(sight.difference_px, [-4, 7], atol=1e-3)
    assert sight.range_m == pytest.approx(3.0, abs=1e-6) and sight.radius_px == pytest.approx(np.hypot(2, 1))
    small = replace(found.discs["left"][0], radius_px=20.0)
    far = seen(RIG, np.array([90.0, 70.0]), 3.0, off_px=(120.0, 0.0)).discs["left"][0]
    for wrong in (small, far):
        again = Sightings(RIG, "tof", "grey")
        add_sights(again, PoseTargets("000", found.range_m, {"tof": found.discs["tof"], "left": [wrong]}))
        assert again.sights == [] and again.left_out == {"left: not found where predicted": 1}
    none = Sightings(RIG, "tof", "grey")
    add_sights(none, PoseTargets("000", np.full((144, 176), np.nan), found.discs))
    assert none.sights == [] and none.left_out == {"tof: no range on its middle": 1}
    side = Sightings(RIG, "tof", "grey")
    add_sights(side, seen(RIG, np.array([20.0, 70.0]), 3.0))
    assert side.left_out == {"left: not wholly in its view": 1}


def test_what_the_range_camera_adds_is_taken_off_before_targets_are_carried() -> None:
    found = seen(RIG, np.array([90.0, 70.0]), 3.0)
    biased = replace(found, range_m=np.asarray(found.range_m, np.float64) * 1.01 + 0.2)
    bias = RangeBias(offset_m=0.2, scale=0.01, radial_m=0.0)
    stated = {**RIG.cameras, "tof": RIG["tof"].model_copy(update={"range_bias": bias})}
    for rig, off_m in ((RIG.model_copy(update={"cameras": stated}), 0.0), (RIG, 0.23)):
        sightings = Sightings(rig, "tof", "grey")
        add_sights(sightings, biased)
        assert sightings.sights[0].range_m == pytest.approx(3.0 + off_m, abs=1e-3)


def test_shares_are_what_centroid_range_and_calibration_scatter_by() -> None:
    rng = np.random.default_rng(2)
    sigmas = (0.4, 0.2, 2.0, 1e-3, 2e-3)
    rig, pixel, range_m = certain(RIG, sigmas), np.array([100.0, 60.0]), 2.0
    sightings = Sightings(rig, "tof", "grey")
    add_sights(sightings, seen(rig, pixel, range_m), centroid_sigma_px=SIGMA_PX)
    shares = sightings.sights[0].shares_px
    N = 4000
    centroid = transfer_pixels(rig, "tof", "left", pixel + 0.1 * rng.standard_normal((N, 2)), np.array(range_m))
    np.testing.assert_allclose(shares["centroid"], np.hypot(centroid.std(axis=0), 0.2), rtol=0.05)
    range_sigma_m = 1e-3
    near = transfer_pixels(rig, "tof", "left", pixel, range_m + range_sigma_m * rng.standard_normal(N))
    ratio = shares["range"] / near.std(axis=0)
    assert ratio[0] == pytest.approx(ratio[1], rel=0.1) and 0.1 < ratio[0] < 10
    moved = []
    for fx, cx, left_fx, ry, tx in rng.standard_normal((600, 5)) * sigmas:
        tof = TOF.with_intrinsics(TOF.intrinsics + np.array([fx, 0, cx, *[0] * 6]))
        left = COLOUR.with_intrinsics(COLOUR.intrinsics + np.array([left_fx, *[0] * 8]))
        T = T_RIG_LEFT.copy()
        T[:3, :3] = transform_from_vector([0, ry, 0, 0, 0, 0])[:3, :3] @ T[:3, :3]
        T[0, 3] += tx
        drawn = Rig(
            name="x",
            cameras={
                "tof": mount_camera(Spectrum.RANGE, tof, np.eye(4)),
                "left": mount_camera(Spectrum.COLOUR, left, T),
            },
        )
        moved.append(transfer_pixels(drawn, "tof", "left", pixel, np.array(range_m)))
    np.testing.assert_allclose(shares["calibration"], np.std(moved, axis=0), rtol=0.1)


def sightings_of(differences: Floats, *, rig: Rig = RIG) -> Sightings:
    """Sights with these differences, three to an image."""
    made = Sightings(rig, "tof", "grey", images=-(-len(differences) // 3), targets=len(differences))
    for n, difference in enumerate(differences):
        made.sights.append(
            TargetSighting(
                image=f"{n // 3:03}",
                camera="left",
                source_px=np.array([88.0, 71.0]),
                radius_px=float(n % 60),
                range_m=2.0,
                predicted_px=difference,
                found_px=np.zeros(2),
                disc_px=30.0,
                shares_px={"centroid": np.array([3.0, 3.0]), "range": np.array([0.0, 4.0])},
            )
        )
    return made


def test_the_tables_sigma_is_the_papers() -> None:
    about = np.array([[2.4, 3.2], [-2.4, -3.2], [2.4, -3.2], [-2.4, 3.2]])
    differences = about + np.array([10, -20])
    (row,) = table_of(sightings_of(differences))
    assert row.sigma_x_px == pytest.approx(2.4 * np.sqrt(4 / 3)) and row.sigma_y_px == pytest.approx(
        3.2 * np.sqrt(4 / 3)
    )
    # Configuration 10, colour left, as printed: 2.4 / 3.2 / 2.8.
    assert row.sigma_px / np.sqrt(4 / 3) == pytest.approx(2.83, abs=0.005)
    assert (row.bias_x_px, row.bias_y_px, row.count) == (10, -20, 4)
    assert row.rms_px == pytest.approx(np.sqrt(np.mean(differences**2)))
    assert row.expected_px == {"calibration": None, "centroid": 3.0, "range": pytest.approx(np.sqrt(8))}
    assert row.total_px is None
    assert row.source_pixel_px == pytest.approx(1340 / 128)


@pytest.mark.slow
def test_the_interval_holds_the_true_sigma_in_ninety_five_of_a_hundred_cases() -> None:
    rng, held = np.random.default_rng(3), 0
    for _ in range(200):
        (row,) = table_of(sightings_of(rng.standard_normal((180, 2)) * [1.0, 2.0]))
        held += row.sigma_low_px < np.sqrt(2.5) < row.sigma_high_px
    assert 0.88 < held / 200 <= 1.0


def test_the_report_holds_everything_and_json_every_difference() -> None:
    rng = np.random.default_rng(3)
    made = sightings_of(rng.standard_normal((30, 2)))
    rows = table_of(made)
    text = table_text(rows)
    assert "left" in text and "sigma_x" in text and " ? = " in text
    html = verification_page(made, rows)
    assert html.count("<svg") == 4 and "Fig. 9: left, x" in html and "Fig. 10: left, y" in html
    assert "http" not in html.replace("http://www.w3.org/", "")  # the names of SVG's namespaces
    document = json.loads(verification_json(made, rows))
    assert len(document["sights"]) == 30 and document["rig_sha256"] == RIG.digest()
    assert document["cameras"][0]["sigma_px"] == rows[0].sigma_px


def test_a_rig_without_range_camera_is_refused() -> None:
    with pytest.raises(BadInputError, match="no range camera"):
        range_camera_of(Rig(name="x", cameras={"left": RIG["left"]}))
