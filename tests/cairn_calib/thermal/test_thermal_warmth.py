"""The camera's own warmth, images near a flat-field correction, and the uncertainty of the maps of the pixels."""

from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest
from tests.fixtures.calib.thermal_images import RESPONSE, SIZE, images, scene

from cairn_calib.cli.main import main
from cairn_calib.rig.radiometry import PlanckResponse, PolynomialResponse, Radiometry, Response, radiometry_from_json
from cairn_calib.thermal.flat_field import FlatField, fit_flat_field, read_flat_field, write_flat_field
from cairn_calib.thermal.object_temperature import NotRadiometric, Temperatures, temperatures
from cairn_calib.thermal.response_fit import Law, Reference, ResponseFit, fit_response
from cairn_map.errors import BadInputError

Floats = npt.NDArray[np.float64]
PLANCK = PlanckResponse(r=300_000.0, b_k=1428.0, o=120.0)
CURVED = PolynomialResponse(c0=310.0, c1=55.0, c2=-4.0, at_counts=7000.0, per_counts=1400.0)
PER_K = 12.5
"""Counts that a housing adds, a kelvin."""
HOUSING_K = 305.0


def fitted(response: Response, law: Law, rng: np.random.Generator) -> ResponseFit:
    """Five black bodies, each seen by a cold and by a warm camera; the warm one's counts are higher."""
    rows = []
    for kelvin in np.linspace(280.0, 350.0, 5):
        for housing_k in (295.0, 315.0):
            seen = float(response.counts_of(kelvin + 0.1 * rng.standard_normal())) + PER_K * (housing_k - HOUSING_K)
            rows.append(Reference(float(kelvin), 0.1, seen + 0.5 * float(rng.standard_normal()), 0.5, housing_k))
    return fit_response(rows, law=law, source="test")


@pytest.mark.parametrize(("response", "law"), [(PLANCK, "planck"), (CURVED, "polynomial")])
def test_what_a_warm_housing_adds_is_found_and_its_uncertainty_is_true(response: Response, law: Law) -> None:
    rng = np.random.default_rng(4)
    kelvin, warm_k = np.array([290.0, 315.0, 345.0]), 313.0
    errors, sigmas, pulls = [], [], []
    for _ in range(200):
        found = fitted(response, law, rng).radiometry
        assert found.housing is not None and found.housing.at_k == pytest.approx(HOUSING_K)
        pulls.append((found.housing.counts_per_k - PER_K) / np.sqrt(found.housing.covariance_row[3]))
        counts = response.counts_of(kelvin) + PER_K * (warm_k - HOUSING_K)
        read = temperatures(counts[None], found, housing_k=warm_k)
        assert isinstance(read, Temperatures)
        errors.append(read.kelvin[0] - kelvin)
        sigmas.append(read.common_sigma_k[0])
    assert 0.85 < np.std(pulls) < 1.15
    ratio = np.sqrt(np.mean(np.square(errors), axis=0) / np.mean(np.square(sigmas), axis=0))
    assert (ratio > 0.8).all() and (ratio < 1.15).all()


def test_a_housing_of_which_nobody_tells_makes_temperatures_less_certain_and_a_strange_one_takes_them_away() -> None:
    known = fitted(PLANCK, "planck", np.random.default_rng(1)).radiometry
    assert radiometry_from_json(known.to_json()) == known
    counts = PLANCK.counts_of(np.array([[300.0]]))
    told, untold = temperatures(counts, known, housing_k=HOUSING_K), temperatures(counts, known)
    assert isinstance(told, Temperatures) and isinstance(untold, Temperatures)
    assert untold.kelvin == pytest.approx(told.kelvin, abs=1e-6)
    open_k = 10.0 * PER_K / float(PLANCK.slope(300.0))
    assert np.sqrt(untold.sigma_k**2 - told.sigma_k**2) == pytest.approx(open_k, rel=0.05)
    strange = temperatures(counts, known, housing_k=335.0)
    assert isinstance(strange, NotRadiometric) and "housing was at 61.9 C" in strange.reason


@pytest.mark.parametrize("step_k", [0.0, 0.2])
def test_a_housing_that_stays_or_goes_with_the_black_bodies_has_no_term(step_k: float) -> None:
    rows = [
        Reference(k, 0.1, float(PLANCK.counts_of(k)), 0.5, 300 + step_k * (k - 280)) for k in (280.0, 300, 320, 340)
    ]
    assert fit_response(rows, law="planck", source="test").radiometry.housing is None


def error_over_sigma(field: FlatField, true: FlatField, level: float, rng: np.random.Generator) -> float:
    """Root mean square over pixels: the maps' error in even images without noise, over what is stated."""
    levelled = field.level_counts(images(true, level, 1, rng, noise=0.0)[0])
    off = levelled - np.nanmean(levelled)
    return float(np.sqrt(np.nanmean((off / field.level_sigma(levelled)) ** 2)))


def test_maps_say_how_far_they_are_off_between_their_temperatures_and_beyond() -> None:
    rng = np.random.default_rng(7)
    true = scene(rng, bad=0)
    for levels in ((4000.0, 6500.0), (4000.0, 5000.0, 6500.0)):
        field = fit_flat_field([images(true, level, 16, rng) for level in levels]).flat_field
        for level in (3000.0, 5200.0, 9000.0):
            assert error_over_sigma(field, true, level, rng) == pytest.approx(1, abs=0.07)
    one = fit_flat_field([images(true, 5000.0, 16, rng)]).flat_field
    assert error_over_sigma(one, true, 5000.0, rng) == pytest.approx(1, abs=0.07)
    assert error_over_sigma(one, true, 7000.0, rng) == pytest.approx(1, abs=0.1)


def test_after_the_shutter_the_shading_is_what_is_uncertain() -> None:
    rng = np.random.default_rng(8)
    true = scene(rng, bad=0)
    field = fit_flat_field([images(true, level, 32, rng) for level in (4000.0, 6000.0)]).flat_field
    assert field.shading_sigma is not None
    off = field.shading - true.shading
    # 15 terms, so few independent errors; twice is far beyond what chance does to them.
    assert 0.5 < np.sqrt(np.mean((off / field.shading_sigma) ** 2)) < 2
    behind = FlatField(true.gain, true.offset, np.zeros_like(true.shading), true.bad)
    again = field.after_shutter(images(behind, 5000.0, 1, rng, noise=0.5)[0], sigma_counts=0.5)
    assert 0.6 < error_over_sigma(again, true, 5200.0, rng) < 1.8


def test_uncertain_maps_make_uncertain_pixels(tmp_path: Path) -> None:
    rng = np.random.default_rng(7)
    true = scene(rng, bad=0)
    field = fit_flat_field([images(true, level, 4, rng) for level in (4000.0, 4400.0)]).flat_field
    named = write_flat_field(tmp_path / "m.npz", field)
    with np.load(tmp_path / "m.npz") as kept:
        assert "counts" in str(kept["units"])
    back = read_flat_field(tmp_path / "m.npz", named)
    known = Radiometry(response=RESPONSE, range_k=(255.0, 400.0), noise_counts=2.0, source="made up")
    near, far = (temperatures(images(true, at, 1, rng)[0], known, flat_field=back) for at in (4200.0, 8000.0))
    assert isinstance(near, Temperatures) and isinstance(far, Temperatures)
    counts = np.hypot(2.0, back.level_sigma(np.full(SIZE, 8000.0)))
    assert far.sigma_k == pytest.approx(counts / RESPONSE.slope(far.kelvin), rel=0.03)
    assert np.median(far.sigma_k * RESPONSE.slope(far.kelvin)) > 5 * np.median(
        near.sigma_k * RESPONSE.slope(near.kelvin)
    )


def test_maps_of_before_their_uncertainty_still_decode(tmp_path: Path) -> None:
    true = scene(np.random.default_rng(1))
    named = write_flat_field(tmp_path / "a.npz", true)
    with np.load(tmp_path / "a.npz") as kept:
        assert {"gain", "offset", "shading", "bad"} <= set(kept.files) and "gain_sigma" not in kept.files
    assert (read_flat_field(tmp_path / "a.npz", named).level_sigma(np.zeros(SIZE)) == 0).all()


def test_images_near_a_flat_field_correction_are_told_and_left_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rng = np.random.default_rng(3)
    true, lines = scene(rng), ["image, celsius, sigma_k, housing_celsius, since_ffc_s"]
    for celsius in (10.0, 35.0, 60.0, 90.0):
        for housing in (20.0, 40.0):
            level = float(RESPONSE.counts_of(celsius + 273.15)) + 3 * (housing - 30)
            for n, image in enumerate(images(true, level, 4, rng)):
                name = f"b{celsius:g}-{housing:g}-{n}.png"
                cv2.imwrite(str(tmp_path / name), np.rint(image).astype(np.uint16))
                lines.append(f"{name}, {celsius}, 0.1, {housing}, 60")
    for name, since in (("shut.png", 0.0), ("opening.png", 0.7)):
        cv2.imwrite(str(tmp_path / name), np.full(SIZE, 3000, np.uint16))
        lines.append(f"{name}, 35, 0.1, 20, {since}")
    (tmp_path / "frozen.png").write_bytes((tmp_path / "b60-20-3.png").read_bytes())
    lines.append("frozen.png, 60, 0.1, 20,")
    (tmp_path / "table.csv").write_text("\n".join(lines) + "\n")
    out = tmp_path / "r.json"
    assert main(["thermal", "fit", str(tmp_path / "table.csv"), str(out)]) == 0
    told = capsys.readouterr().out
    assert "left out: shut.png: during a flat-field correction" in told
    assert "left out: opening.png: 0.7 s after a flat-field correction" in told
    assert "left out: frozen.png: the same counts as b60-20-3.png" in told
    assert "housing: 3" in told and "counts a kelvin of it" in told
    known = radiometry_from_json(out.read_bytes())
    assert "3 images left out" in known.source
    assert known.housing is not None and known.housing.counts_per_k == pytest.approx(3.0, abs=0.1)
    assert main(["thermal", "read", str(tmp_path / "b35-40-0.png"), "--radiometry", str(out), "--housing", "40"]) == 0
    assert "median 35.0 C" in capsys.readouterr().out
    assert main(["thermal", "read", str(tmp_path / "b35-40-0.png"), "--radiometry", str(out), "--housing", "70"]) == 0
    assert "not radiometric: the camera's housing was at 70.0 C" in capsys.readouterr().out


def test_images_of_several_sizes_are_refused_by_name(tmp_path: Path) -> None:
    for n, size in enumerate(((8, 8), (8, 9))):
        cv2.imwrite(str(tmp_path / f"{n}.png"), np.full(size, 100 + n, np.uint16))
    (tmp_path / "t.csv").write_text("image, celsius, sigma_k\n0.png, 10, 0.1\n1.png, 10, 0.1\n")
    with pytest.raises(BadInputError, match="at 10 C are of several sizes"):
        main(["thermal", "fit", str(tmp_path / "t.csv"), str(tmp_path / "o.json")])
