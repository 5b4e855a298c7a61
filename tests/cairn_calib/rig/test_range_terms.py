"""The further shapes of a range bias: found where the images show them, left out and said where they do not."""

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from tests.fixtures.calib.simulated_views import BOARD, SPECTRA, TOF, World, ranges_of, views_of, world

from cairn_calib.diagnosis.range_warnings import range_warnings
from cairn_calib.diagnosis.solve_warnings import SolveWarning
from cairn_calib.rig.range_bias import ByAmplitude, RangeBias, Wave, Wiggle
from cairn_calib.rig.range_terms import BIAS_NAMES, RangeTerms, off_middle_image, wave_period_m
from cairn_calib.rig.rig import Spectrum
from cairn_calib.solve.range_choice import AMPLITUDE_RATIO, PERIOD_SHARE, RangeSpans, choose_terms
from cairn_calib.solve.solution import Solution
from cairn_calib.solve.solve import solve_rig
from cairn_calib.solve.solve_plan import usual_plan
from cairn_calib.solve.solved_rig import solved_rig

Floats = npt.NDArray[np.float64]

PAIR = ("tof", "left")
MODULATION_HZ = 15e6
WAVY = RangeTerms(MODULATION_HZ, (4,), 1500.0)
BIAS = (0.03, 0.004, 0.01, 0.0, 0.006, -0.008, 0.005)


def ladder(frames: int, **more: object) -> World:
    """Boards at ranges from near to far, one after the other."""
    truth = world(frames, seed=3, names=PAIR, **more)
    middle = np.append(BOARD.points().mean(axis=0), 1.0)
    boards = truth.boards.copy()
    for T, far in zip(boards, np.linspace(0.75, 3.6, frames), strict=True):
        at = (T @ middle)[:3]
        T[:3, 3] += at * (far / at[2] - 1)
    return replace(truth, boards=boards)


def solved(truth: World, *, modulation_hz: float | None) -> Solution:
    views = replace(views_of(truth, seed=3), ranges=ranges_of(truth, "tof", seed=3, sigma_m=0.005))
    plan = usual_plan({name: SPECTRA[name] for name in truth.names})
    return solve_rig(views, replace(plan, modulation_hz=modulation_hz))


def told(solution: Solution) -> dict[str, SolveWarning]:
    return {each.kind: each for each in range_warnings(solution)}


def test_circular_error_and_dependence_on_amplitude_are_found_within_their_sigmas() -> None:
    solution = solved(ladder(14, bias=BIAS, terms=WAVY, has_amplitude=True), modulation_hz=MODULATION_HZ)
    used = solution.ranges
    assert used is not None and used.terms.harmonics == (4,) and used.terms.amplitude_at is not None
    values, sigmas = solution.values(), solution.sigmas()
    # The usual amplitude is that of the images: the same dependence about another one.
    right = dict(zip(WAVY.names, BIAS, strict=True))
    faint_m = right["faint_m"] * 1500.0 / used.terms.amplitude_at
    right |= {"faint_m": faint_m, "offset_m": right["offset_m"] - right["faint_m"] + faint_m}
    pulls = [(values["tof", name] - right[name]) / sigmas["tof", name] for name in WAVY.names]
    assert np.abs(pulls).max() < 3.5
    assert max(sigmas["tof", name] for name in WAVY.names[4:]) < 0.001
    lost = told(solution)["range_wiggle"]  # of the longer waves a half was seen at most
    assert "wave 1" in lost.text and "wave 4" not in lost.text and lost.measured < lost.threshold == PERIOD_SHARE
    assert not {"range_amplitude", "range_bias"} & set(told(solution))
    both = {name: replace(each, spectrum=Spectrum.RANGE) for name, each in solution.plan.cameras.items()}
    other = told(replace(solution, plan=replace(solution.plan, cameras=both)))["range_bias"]
    assert other.camera == "left" and "--range is of tof" in other.text
    bias = solved_rig(solution, made_s=0.0)["tof"].range_bias
    assert bias is not None and bias.parameters == WAVY.names
    assert bias.values == pytest.approx([values["tof", name] for name in WAVY.names])
    assert bias.wiggle is not None and bias.wiggle.modulation_hz == MODULATION_HZ


def test_a_wave_that_is_not_looked_for_spoils_the_rest() -> None:
    solution = solved(ladder(14, bias=BIAS, terms=WAVY), modulation_hz=None)
    assert 0.01 * solution.adjustment.problem.sensors[-1].scale > 1.3 * 0.005


def test_shapes_that_the_images_do_not_determine_are_left_out_and_said() -> None:
    truth = world(6, seed=3, names=PAIR, has_amplitude=True)
    solution = solved(truth, modulation_hz=MODULATION_HZ)
    used, spans = solution.ranges, solution.spans
    assert used is not None and spans is not None and used.terms.harmonics == ()
    lost = told(solution)["range_wiggle"]
    assert lost.measured == pytest.approx(spans.period_share(MODULATION_HZ, 4)) and lost.measured < PERIOD_SHARE
    assert f"{spans.nearest_m:.2f} to {spans.farthest_m:.2f} m" in lost.text
    assert (
        "modulation frequency"
        in told(solved(replace(truth, has_amplitude=False), modulation_hz=None))["range_wiggle"].text
    )


def test_amplitudes_that_are_missing_or_all_alike_are_said() -> None:
    truth = world(6, seed=3, names=PAIR, has_amplitude=True)
    views = replace(views_of(truth, seed=3), ranges=ranges_of(truth, "tof", seed=3, sigma_m=0.005))
    plan = usual_plan({name: SPECTRA[name] for name in truth.names})
    dull = tuple(replace(each, amplitude=np.full((144, 176), 900, np.uint16)) for each in views.ranges)
    one = told(solve_rig(replace(views, ranges=dull), plan))["range_amplitude"]
    assert one.measured == 1.0 and one.threshold == AMPLITUDE_RATIO and "900 to 900" in one.text
    partly = (replace(views.ranges[0], amplitude=None), *views.ranges[1:])
    other = told(solve_rig(replace(views, ranges=partly), plan))["range_amplitude"]
    assert (other.measured, other.threshold) == (0, 1) and "not all have an amplitude image" in other.text


def test_spans_choose_the_shapes() -> None:
    period_m = wave_period_m(MODULATION_HZ, 4)
    assert period_m == pytest.approx(2.498, abs=1e-3)
    for span, ratio, harmonics, is_known in (
        (0.74 * period_m, 1.9, (), False),
        (0.76 * period_m, 2.1, (4,), True),
        (1.6 * period_m, 2.1, (2, 4), True),
        (4.0 * period_m, 2.1, (1, 2, 4), True),
    ):
        terms = choose_terms(RangeSpans(1.0, 1.0 + span, (100.0, 150.0, 100.0 * ratio)), MODULATION_HZ)
        assert terms.harmonics == harmonics and (terms.amplitude_at == 150.0) is is_known
    assert choose_terms(RangeSpans(1.0, 9.0, None), None).names == BIAS_NAMES


STATED = RangeBias(
    offset_m=0.04,
    scale=0.006,
    radial_m=0.03,
    radial4_m=-0.02,
    wiggle=Wiggle(
        modulation_hz=MODULATION_HZ,
        waves=(Wave(harmonic=1, cos_m=0.02, sin_m=0.01), Wave(harmonic=4, cos_m=-0.01, sin_m=0.02)),
    ),
    by_amplitude=ByAmplitude(faint_m=0.01, at=1000.0, low=200.0, high=4000.0),
)


def test_taking_off_undoes_adding_with_all_shapes() -> None:
    rng = np.random.default_rng(0)
    true_m, amplitude = rng.uniform(0.3, 9, (144, 176)), rng.uniform(200, 4000, (144, 176)).round()
    true_m[3, 4] = np.nan
    off = off_middle_image(176, 144)
    measured = true_m + STATED.terms.shapes(true_m, off, STATED.terms.faintness(amplitude)) @ STATED.values
    np.testing.assert_allclose(STATED.true_image(TOF, measured, amplitude), true_m, rtol=0, atol=1e-11)
    usual = true_m + STATED.terms.shapes(true_m, off, np.zeros_like(off)) @ STATED.values
    np.testing.assert_allclose(STATED.true_image(TOF, usual), true_m, rtol=0, atol=1e-11)
    pixels = np.stack(np.meshgrid(np.arange(176.0), np.arange(144.0)), axis=-1)[10]
    np.testing.assert_allclose(STATED.true_at(TOF, pixels, usual[10]), true_m[10], rtol=0, atol=1e-11)


def test_amplitudes_beyond_those_seen_count_as_the_last_seen() -> None:
    range_m = np.full((144, 176), 2.0)
    dark, darker = (STATED.true_image(TOF, range_m, np.full((144, 176), a)) for a in (200.0, 3.0))
    np.testing.assert_array_equal(dark, darker)
    assert (dark < STATED.true_image(TOF, range_m)).all()


def test_the_slopes_are_those_of_the_shapes() -> None:
    d, off = np.linspace(0.5, 9, 50), np.full(50, 0.3)
    h = 1e-6
    up, down = (STATED.terms.shapes(d + step, off, off) for step in (h, -h))
    np.testing.assert_allclose(STATED.terms.slopes(d), (up - down) / (2 * h), atol=1e-8)


def test_waves_so_steep_that_ranges_repeat_are_refused() -> None:
    steep = Wiggle(modulation_hz=MODULATION_HZ, waves=(Wave(harmonic=8, cos_m=0.11, sin_m=0.0),))
    with pytest.raises(ValueError, match="one measured range for several"):
        RangeBias(offset_m=0, scale=0, radial_m=0, wiggle=steep)
    twice = (Wave(harmonic=4, cos_m=0.0, sin_m=0.0),) * 2
    with pytest.raises(ValueError, match="listed twice"):
        RangeBias(offset_m=0, scale=0, radial_m=0, wiggle=Wiggle(modulation_hz=MODULATION_HZ, waves=twice))
    with pytest.raises(ValueError, match=r"parameters must be offset_m, scale, radial_m, radial4_m"):
        RangeBias(offset_m=0, scale=0, radial_m=0, parameters=("offset_m",))
