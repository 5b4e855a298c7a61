"""Warnings about range images: shapes of the range bias that they do not determine, and the reason."""

from collections.abc import Iterator

from cairn_calib.diagnosis.verdict import Rank, SolveWarning
from cairn_calib.rig.range_terms import wave_period_m
from cairn_calib.rig.rig import Spectrum
from cairn_calib.solve.range_choice import AMPLITUDE_RATIO, HARMONICS, PERIOD_SHARE
from cairn_calib.solve.solution import Solution

UNSEEN_SHARE = 0.1
"""Share of an image's pixels without any board that is worth a warning."""
PAIRS_MIN = 1000
"""Pairs of residuals of one pixel, with fewer of which even a pattern as large as the noise may be chance."""

NOISE_M = 0.05
"""Noise of ranges within some metres that is worth a warning: time-of-flight cameras have a fifth of it."""
USUAL_TIMES = 4.0
"""Value of a number of the bias that is worth a warning, in standard deviations of its prior."""


def range_warnings(solution: Solution) -> Iterator[SolveWarning]:
    """Warnings about all range images, and about range cameras without any."""
    used, given = solution.ranges, solution.views.ranges
    count = 0 if used is None else len(used.frames)
    if count < len(given):
        text = (
            f"{len(given) - count} of {len(given)} range images show no board whose corners were found: look at the "
            "numbers in their names"
        )
        yield SolveWarning("range_images", given[0].camera, count, len(given), "range images with a board", text)
    if used is not None:
        name = solution.views.cameras[used.camera]
        yield from _of_other_ranges(name, solution)
        yield from _of_waves(name, solution)
        yield from _of_amplitude(name, solution)
        yield from _of_pixels(name, solution)
    yield from _of_none(solution)


def _of_none(solution: Solution) -> Iterator[SolveWarning]:
    """Warnings about range cameras whose bias is unknown."""
    names = list(solution.plan.cameras)
    shown = None if solution.ranges is None else names[solution.ranges.camera]
    for name in names:
        if solution.plan.cameras[name].spectrum is Spectrum.RANGE and name != shown:
            text = "no range image shows what it adds to its ranges: give those of the same boards (--range)"
            if shown is not None:
                text = f"what it adds to its ranges is not known: --range is of {shown}; solve this camera alone for it"
            yield SolveWarning("range_bias", name, 0, 1, "range images", text, Rank.NOTE)


def _of_other_ranges(name: str, solution: Solution) -> Iterator[SolveWarning]:
    used, values = solution.ranges, solution.values()
    if used is None:
        return
    noise_m = solution.adjustment.problem.sensors[-1].scale * used.sigma_m
    if noise_m > NOISE_M:
        text = "ranges miss the boards by far more than noise: are their images of other places of the board?"
        yield SolveWarning("range_noise", name, noise_m, NOISE_M, "m", text, Rank.DECISIVE)
        return  # and its bias means nothing
    known = zip(used.terms.document_names, used.terms.sigmas, strict=False)  # nodes come last
    sigmas, worst = max((abs(values[name, each]) / sigma, each) for each, sigma in known)
    if sigmas > USUAL_TIMES:
        text = (
            f"{worst} = {values[name, worst]:.3g} is more than range cameras add: are the images depth along the axis, "
            "not range along the beam, or of other units (--range-units-per-m)?"
        )
        yield SolveWarning("range_kind", name, sigmas, USUAL_TIMES, "of what is usual", text)


def _of_waves(name: str, solution: Solution) -> Iterator[SolveWarning]:
    used, spans, modulation_hz = solution.ranges, solution.spans, solution.plan.modulation_hz
    if used is None or spans is None:
        return
    if modulation_hz is None:
        text = (
            "the circular error of its ranges is left out, for its modulation frequency was not stated "
            "(--modulation-mhz)"
        )
        yield SolveWarning("range_wiggle", name, 0, 1, "modulation frequencies", text, Rank.NOTE)
        return
    lost = [k for k in HARMONICS if k not in used.terms.harmonics]
    if lost:
        told = ", ".join(
            f"{spans.period_share(modulation_hz, k):.2f} of the {wave_period_m(modulation_hz, k):.2f} m of wave {k}"
            for k in lost
        )
        text = (
            f"board pixels from {spans.nearest_m:.2f} to {spans.farthest_m:.2f} m cover {told} of its circular error, "
            "left out: take boards from nearer to farther"
        )
        best = max(spans.period_share(modulation_hz, k) for k in lost)
        yield SolveWarning("range_wiggle", name, best, PERIOD_SHARE, "of a wave's period", text, Rank.NOTE)


def _of_amplitude(name: str, solution: Solution) -> Iterator[SolveWarning]:
    used, spans = solution.ranges, solution.spans
    if used is None or spans is None or used.terms.amplitude_at is not None:
        return
    if spans.amplitudes is None:
        text = "how its ranges depend on the amplitude is left out, for not all have an amplitude image (--amplitude)"
        yield SolveWarning("range_amplitude", name, 0, 1, "amplitude images a range image", text, Rank.NOTE)
        return
    low, _, high = spans.amplitudes
    text = f"board pixels have amplitudes of {low:.0f} to {high:.0f} only: how ranges depend on them is left out"
    yield SolveWarning(
        "range_amplitude", name, spans.amplitude_ratio, AMPLITUDE_RATIO, "highest over lowest", text, Rank.NOTE
    )


def _of_pixels(name: str, solution: Solution) -> Iterator[SolveWarning]:
    found = solution.pattern
    if found is None:
        return
    if found.pairs < PAIRS_MIN:
        text = "hardly a pixel saw the board in two images: what each adds to its ranges of its own is not known"
        yield SolveWarning(
            "range_pixels", name, found.pairs, PAIRS_MIN, "pairs of ranges of one pixel", text, Rank.NOTE
        )
    if found.offsets is not None and 1 - found.seen_share > UNSEEN_SHARE:
        text = (
            "the pixels differ in what they add to their ranges, and on many there never was a board: theirs is 0 +- "
            f"{1000 * found.offsets.unseen_sigma_m:.1f} mm; take boards all over its image"
        )
        yield SolveWarning(
            "range_pixels", name, 1 - found.seen_share, UNSEEN_SHARE, "of the pixels without board", text, Rank.NOTE
        )
