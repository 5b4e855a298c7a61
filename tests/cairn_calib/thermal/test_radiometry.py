"""Counts and kelvin: laws of the responses, what is found from references, uncertainty against Monte Carlo."""

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from pydantic import ValidationError

from cairn_calib.rig.camera import camera_from_field_of_view
from cairn_calib.rig.radiometry import PlanckResponse, PolynomialResponse, Radiometry, Response, radiometry_from_json
from cairn_calib.rig.rig import Spectrum, mount_camera
from cairn_calib.thermal.object_temperature import (
    NotRadiometric,
    Temperatures,
    Viewing,
    air_transmission,
    seen_counts,
    temperatures,
)
from cairn_calib.thermal.response_fit import Law, Reference, fit_response
from cairn_map.errors import BadInputError

Floats = npt.NDArray[np.float64]
PLANCK = PlanckResponse(r=300_000.0, b_k=1428.0, f=1.0, o=120.0)
CURVED = PolynomialResponse(c0=310.0, c1=55.0, c2=-4.0, at_counts=7000.0, per_counts=1400.0)
COVARIANCE = ((9e6,), (4e3, 9.0), (-1e2, 1.0, 40.0))
KELVIN = np.linspace(260.0, 360.0, 41)
VIEWING = Viewing(
    emissivity=0.9,
    emissivity_sigma=0.02,
    reflected_k=295.0,
    reflected_sigma_k=2.0,
    transmission=0.95,
    transmission_sigma=0.01,
    air_k=290.0,
    air_sigma_k=3.0,
)


def radiometry(response: Response, **changes: Any) -> Radiometry:
    return Radiometry(response=response, range_k=(255.0, 365.0), source="made up", **changes)


@pytest.mark.parametrize("response", [PLANCK, PLANCK.model_copy(update={"f": 0.7}), CURVED])
def test_responses_rise_and_come_back_and_their_derivatives_are_differences(response: Response) -> None:
    counts = response.counts_of(KELVIN)
    assert (np.diff(counts) > 0).all()
    np.testing.assert_allclose(response.kelvin_of(counts), KELVIN, atol=1e-9)
    step = (response.counts_of(KELVIN + 1e-3) - response.counts_of(KELVIN - 1e-3)) / 2e-3
    np.testing.assert_allclose(response.slope(KELVIN), step, rtol=1e-6)
    for n, name in enumerate(response.names):
        value = getattr(response, name)
        h = 1e-6 * max(abs(value), 1.0)
        up, down = (response.model_copy(update={name: value + s * h}).counts_of(KELVIN) for s in (1, -1))
        np.testing.assert_allclose(response.by_parameters(KELVIN)[:, n], (up - down) / (2 * h), rtol=2e-5)


def test_what_no_temperature_gives_is_nan() -> None:
    assert np.isnan(PLANCK.kelvin_of([120.0, 0.0, -5.0])).all()
    assert np.isnan(PLANCK.counts_of([0.0, -1.0, np.nan])).all()
    assert np.isnan(CURVED.kelvin_of(30_000.0)) and np.isnan(CURVED.counts_of(900.0))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"range_k": (365.0, 255.0)}, "range_k must rise"),
        ({"response": CURVED.model_copy(update={"c2": -60.0})}, "does not rise"),
        ({"covariance_lower": ((1.0,), (2.0, 1.0), (0.0, 0.0, 1.0))}, "negative eigenvalue"),
        ({"covariance_lower": ((1.0,),)}, "rows of 1, 2 and 3"),
        ({"version": 2}, "version"),
    ],
)
def test_a_radiometry_that_cannot_be_is_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        Radiometry.model_validate({"response": PLANCK, "range_k": (255.0, 365.0), "source": "x"} | changes)


def test_a_radiometry_comes_back_from_its_file_and_only_thermal_cameras_have_one() -> None:
    whole = radiometry(PLANCK, covariance_lower=COVARIANCE, noise_counts=2.0)
    assert radiometry_from_json(whole.to_json()) == whole
    with pytest.raises(BadInputError, match="radiometry: "):
        radiometry_from_json(b'{"format": "cairn-radiometry", "version": 1}')
    camera = camera_from_field_of_view(64, 51, horizontal_deg=69)
    rows = mount_camera(Spectrum.THERMAL, camera, np.eye(4)).model_dump() | {"radiometry": whole}
    assert type(mount_camera(Spectrum.THERMAL, camera, np.eye(4))).model_validate(rows).radiometry == whole
    with pytest.raises(ValidationError, match="radiometry is of thermal cameras"):
        type(mount_camera(Spectrum.THERMAL, camera, np.eye(4))).model_validate(rows | {"spectrum": "colour"})


def read(counts: Floats, known: Radiometry | None, viewing: Viewing | None = None) -> Temperatures:
    found = temperatures(counts[None], known, viewing=viewing)
    assert isinstance(found, Temperatures)
    return found


@pytest.mark.parametrize("response", [PLANCK, CURVED])
def test_the_object_model_comes_back(response: Response) -> None:
    known = radiometry(response)
    counts = seen_counts(KELVIN, known, VIEWING)
    assert (np.diff(counts) > 0).all()
    np.testing.assert_allclose(read(counts, known, VIEWING).kelvin[0], KELVIN, rtol=3e-7)
    # A black body through clear air is as it looks.
    np.testing.assert_allclose(seen_counts(KELVIN, known, Viewing()), response.counts_of(KELVIN), rtol=1e-12)


def test_what_an_emissivity_of_less_than_one_hides_is_added() -> None:
    known = radiometry(PLANCK)
    counts = PLANCK.counts_of(np.array([280.0, 293.15, 320.0]))
    apparent, true = read(counts, known).kelvin[0], read(counts, known, Viewing(emissivity=0.8)).kelvin[0]
    assert true[0] < apparent[0] and true[1] == pytest.approx(apparent[1], abs=1e-4) and true[2] > apparent[2] + 5


@pytest.mark.parametrize("response", [PLANCK, CURVED])
def test_stated_sigma_is_that_of_monte_carlo(response: Response) -> None:
    rng = np.random.default_rng(5)
    lower = COVARIANCE if response is PLANCK else ((0.04,), (0.01, 0.02), (0.0, -0.002, 0.01))
    known = radiometry(response, covariance_lower=lower, noise_counts=3.0, pattern_counts=2.0)
    true_k = np.array([285.0, 310.0, 340.0])
    stated = read(seen_counts(true_k, known, VIEWING), known, VIEWING)
    scattered = []
    for numbers in rng.multivariate_normal([getattr(response, n) for n in response.names], known.covariance, 4000):
        drawn = known.model_copy(
            update={"response": response.model_copy(update=dict(zip(response.names, map(float, numbers), strict=True)))}
        )
        counts = seen_counts(true_k, drawn, drawn_viewing(rng)) + np.hypot(3.0, 2.0) * rng.standard_normal(3)
        scattered.append(read(counts, known, VIEWING).kelvin[0])
    np.testing.assert_allclose(stated.sigma_k[0], np.std(scattered, axis=0), rtol=0.05)
    each = np.hypot(3.0, 2.0) / (0.9 * 0.95 * response.slope(true_k))
    np.testing.assert_allclose(stated.sigma_k**2 - stated.common_sigma_k**2, each[None] ** 2, rtol=1e-3)


@pytest.mark.parametrize(
    ("name", "sigma"),
    [("emissivity", 0.02), ("reflected_k", 2.0), ("transmission", 0.01), ("air_k", 3.0)],
)
def test_each_share_of_the_sigma_is_what_the_temperature_moves_by(name: str, sigma: float) -> None:
    known, sure = radiometry(PLANCK), Viewing(emissivity=0.7, reflected_k=320.0, transmission=0.8, air_k=280.0)
    counts = seen_counts(np.array([300.0, 350.0]), known, sure)
    field = f"{name.removesuffix('_k')}_sigma{'_k' if name.endswith('_k') else ''}"
    stated = read(counts, known, replace(sure, **{field: sigma})).sigma_k[0]
    up, down = (
        read(counts, known, replace(sure, **{name: getattr(sure, name) + s * sigma})).kelvin[0] for s in (1, -1)
    )
    np.testing.assert_allclose(stated, np.abs(up - down) / 2, rtol=0.02)


def drawn_viewing(rng: np.random.Generator) -> Viewing:
    e, r, t, a = rng.standard_normal(4)
    return replace(
        VIEWING,
        emissivity=0.9 + 0.02 * e,
        reflected_k=295.0 + 2 * r,
        transmission=0.95 + 0.01 * t,
        air_k=290.0 + 3 * a,
    )


def test_without_reference_data_there_are_counts_and_no_kelvin() -> None:
    found = temperatures(np.array([[1, 2], [3, 4]], np.uint16), None)
    assert isinstance(found, NotRadiometric) and not hasattr(found, "kelvin")
    assert "no reference" in found.reason
    np.testing.assert_array_equal(found.counts, [[1, 2], [3, 4]])


def test_beyond_the_range_there_is_no_temperature() -> None:
    counts = PLANCK.counts_of(np.array([250.0, 254.9, 255.1, 364.9, 365.1, 500.0]))
    seen = np.isfinite(read(counts, radiometry(PLANCK)).kelvin[0])
    assert seen.tolist() == [False, False, True, True, False, False]


@pytest.mark.parametrize(
    "changes", [{"emissivity": 0.1}, {"emissivity": 1.1}, {"transmission": 0.0}, {"reflected_sigma_k": -1.0}]
)
def test_a_surface_that_no_camera_can_measure_is_refused(changes: dict[str, float]) -> None:
    with pytest.raises(BadInputError):
        replace(Viewing(), **changes)


def test_air_takes_more_the_more_there_is_and_the_wetter_it_is() -> None:
    constants = (0.006569, 0.012620, -0.002276, -0.006670, 1.9)

    def through(distance_m: float, humidity: float = 0.5) -> float:
        return air_transmission(distance_m, air_k=293.15, humidity=humidity, constants=constants)

    assert through(0) == 1
    assert 1 > through(1) > through(10) > through(100) > 0.7
    assert through(30, 0.9) < through(30, 0.1)


def references(true: Response, kelvin: Floats, rng: np.random.Generator, sigma_k: float = 0.1) -> list[Reference]:
    counts = true.counts_of(kelvin + sigma_k * rng.standard_normal(len(kelvin)))
    return [Reference(float(T), sigma_k, float(U), 0.5) for T, U in zip(kelvin, counts, strict=True)]


@pytest.mark.parametrize(
    ("law", "true", "count"), [("planck", PLANCK, 2), ("planck", PLANCK, 6), ("polynomial", CURVED, 5)]
)
def test_responses_from_references_are_as_certain_as_they_say(law: Law, true: Response, count: int) -> None:
    rng = np.random.default_rng(3)
    kelvin, between = np.linspace(280.0, 350.0, count), np.array([290.0, 315.0, 345.0])
    errors, sigmas, chi2 = [], [], []
    for _ in range(300):
        fitted = fit_response(references(true, kelvin, rng), law=law, source="test")
        found = fitted.radiometry
        errors.append(found.response.kelvin_of(true.counts_of(between)) - between)
        J = found.response.by_parameters(between)
        sigmas.append(np.sqrt(np.einsum("ni,ij,nj->n", J, found.covariance, J)) / found.response.slope(between))
        chi2.append(fitted.chi2)
        assert fitted.degrees_of_freedom == max(0, count - (2 if count == 2 else 3))
    ratio = np.sqrt(np.mean(np.square(errors), axis=0)) / np.sqrt(np.mean(np.square(sigmas), axis=0))
    # Of two references B is only assumed: that share of the sigma is not seen where the assumption is right.
    assert (ratio < 1.12).all() and (count == 2 or (ratio > 0.75).all())
    if count > 3:
        assert np.mean(chi2) == pytest.approx(count - 3, rel=0.15)


def test_references_that_disagree_make_the_response_less_certain() -> None:
    rng = np.random.default_rng(3)
    rows = references(PLANCK, np.linspace(280.0, 350.0, 8), rng, sigma_k=1.0)
    honest = fit_response(rows, law="planck", source="test")
    boasting = fit_response([replace(row, sigma_k=0.01) for row in rows], law="planck", source="test")
    assert boasting.chi2 > 100 > honest.chi2
    ratio = np.sqrt(boasting.radiometry.covariance[0, 0] / honest.radiometry.covariance[0, 0])
    assert 0.4 < ratio < 2


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([(300.0, 0.1, 5000.0)], "two temperatures"),
        ([(300.0, 0.1, 5000.0), (300.0, 0.1, 5001.0)], "two temperatures"),
        ([(300.0, 0.0, 5000.0), (310.0, 0.1, 5400.0)], "above 0 K"),
        ([(300.0, 0.1, 5000.0), (310.0, 0.1, 4600.0)], "the counts fall"),
    ],
)
def test_references_that_tell_nothing_are_refused(rows: list[tuple[float, float, float]], message: str) -> None:
    with pytest.raises(BadInputError, match=message):
        fit_response([Reference(T, s, U, 1.0) for T, s, U in rows], law="planck", source="test")
