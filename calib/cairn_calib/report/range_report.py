"""Ranges of a calibration, for people: a line, a table, a curve of the bias and maps of the pixels' offsets."""

import numpy as np

from cairn_calib.diagnosis.examination import Examination
from cairn_calib.report.charts import bias_curve
from cairn_calib.report.image_overlays import offset_map, sigma_map_mm
from cairn_calib.report.page import Figure, Table
from cairn_calib.report.solve_tables import plus_minus
from cairn_calib.rig.pixel_offsets import PixelOffsets
from cairn_calib.rig.range_bias import RangeBias
from cairn_calib.rig.range_terms import wave_period_m
from cairn_calib.solve.range_choice import RangeSpans
from cairn_calib.solve.solution import Solution

WORDS = {
    "offset_m": "offset, mm",
    "scale": "scale, mm/m",
    "radial_m": "more at the image's corner, mm",
    "radial4_m": "and with the fourth power, mm",
    "faint_m": "more at half the usual amplitude, mm",
}


def told_ranges(solution: Solution) -> str:
    """A line of the range camera's ranges; empty where there are none."""
    used = solution.ranges
    if used is None:
        return ""
    sensor, values = solution.adjustment.problem.sensors[-1], solution.values()
    name = solution.views.cameras[used.camera]
    more = [f", wave {k}" for k in used.terms.harmonics]
    more += [", amplitude"] if used.terms.amplitude_at is not None else []
    return (
        f"{name} ranges: {len(used.frames)} images  {int(used.measured.sum())} pixels  "
        f"{int((sensor.there & ~sensor.kept).sum())} outliers  noise {1000 * sensor.scale * used.sigma_m:.1f} mm  "
        f"offset {1000 * values[name, 'offset_m']:.1f} mm{''.join(more)}; {_pixels_text(solution)}\n"
    )


def ranges_json(solution: Solution) -> dict[str, object] | None:
    """The same for programs: metres, counts, hertz; None where there are none."""
    used, spans, found = solution.ranges, solution.spans, solution.pattern
    if used is None or spans is None:
        return None
    sensor = solution.adjustment.problem.sensors[-1]
    return {
        "camera": solution.views.cameras[used.camera],
        "parameters": list(used.terms.document_names),
        "noise_m": sensor.scale * used.sigma_m,
        "nearest_m": spans.nearest_m,
        "farthest_m": spans.farthest_m,
        "amplitudes": spans.amplitudes,
        "modulation_hz": solution.plan.modulation_hz,
        "harmonics": list(used.terms.harmonics),
        "pixels": None
        if found is None
        else {
            "pairs": found.pairs,
            "seen_share": found.seen_share,
            "pattern_sigma_m": None if found.offsets is None else found.offsets.pattern_sigma_m,
            "pattern_at_most_m": found.at_most_m,
        },
    }


def range_facts(seen: Examination) -> dict[str, object] | None:
    """Facts of the report's part about ranges; None where the calibration used no range images."""
    solution, spans = seen.solution, seen.solution.spans
    used = solution.ranges
    if used is None or spans is None:
        return None
    name = solution.views.cameras[used.camera]
    bias = seen.rig[name].range_bias
    values, sigmas = solution.values(), solution.sigmas()
    rows = [
        [_words(each, solution), plus_minus(values[name, each], sigmas[name, each], factor=1000)]
        for each in used.terms.document_names
    ]
    return {
        "camera": name,
        "spans": _spans_text(spans, solution),
        "table": Table(["what it adds to a range", "estimate"], rows),
        "curve": None if bias is None else _curve(bias, (spans.nearest_m, spans.farthest_m)),
        "pixels": _pixels_text(solution),
        "maps": [] if bias is None or bias.pixel_offsets is None else _maps(bias.pixel_offsets),
    }


def _curve(bias: RangeBias, seen_m: tuple[float, float]) -> Figure:
    """Bias of the middle of the image by range, with its standard deviation from the covariance of its terms."""
    range_m = np.linspace(0, float(np.ceil(1.25 * seen_m[1])), 160)
    nothing = np.zeros_like(range_m)
    shapes = bias.terms.shapes(range_m, nothing, nothing)
    variance = np.einsum("ni,ij,nj->n", shapes, bias.covariance, shapes)
    return Figure(
        bias_curve(range_m, 1000 * shapes @ bias.values, 1000 * np.sqrt(np.maximum(variance, 0)), seen_m),
        "What the middle of the image adds to a range, at the usual amplitude, with its standard deviation; "
        "tinted: where boards were, beyond them it is extrapolated",
    )


def _maps(offsets: PixelOffsets) -> list[Figure]:
    counts = offsets.counts
    many = int(np.median(counts[counts > 0])) if counts.any() else 0
    limit_mm, unseen_mm = 3000 * offsets.pattern_sigma_m, 1000 * offsets.unseen_sigma_m
    low, high = 1000 * float(offsets.sigma_m.min()), 1000 * float(offsets.sigma_m.max())
    return [
        Figure(
            offset_map(1000 * np.where(counts > 0, offsets.offset_m, np.nan), limit_mm),
            f"What each pixel adds on top of all pixels' share: blue {-limit_mm:.1f} mm and below, red "
            f"{limit_mm:.1f} mm and above, grey: no board was there, 0 +- {unseen_mm:.1f} mm; {many} boards a pixel "
            "(median)",
        ),
        Figure(
            sigma_map_mm(1000 * offsets.sigma_m, low, high),
            f"Its standard deviation: dark {low:.1f} mm, yellow {high:.1f} mm",
        ),
    ]


def _words(name: str, solution: Solution) -> str:
    if name in WORDS:
        return WORDS[name]
    wave, part, _ = name.split("_")
    k = int(wave.removeprefix("wiggle"))
    used = solution.ranges
    modulation_hz = None if used is None else used.terms.modulation_hz
    period = "" if modulation_hz is None else f" (period {wave_period_m(modulation_hz, k):.2f} m)"
    return f"wave {k}{period}, {'cosine' if part == 'cos' else 'sine'}, mm"


def _spans_text(spans: RangeSpans, solution: Solution) -> str:
    used = solution.ranges
    text = f"Board pixels from {spans.nearest_m:.2f} to {spans.farthest_m:.2f} m"
    if spans.amplitudes is not None:
        low, middle, high = spans.amplitudes
        text += f", of amplitudes {low:.0f} to {high:.0f}, usually {middle:.0f}"
    left_out = []
    if used is not None and not used.terms.harmonics:
        left_out.append("circular error")
    if used is not None and used.terms.amplitude_at is None:
        left_out.append("dependence on the amplitude")
    return text + (f". Left out, for the images do not determine it: {' and '.join(left_out)}." if left_out else ".")


def _pixels_text(solution: Solution) -> str:
    found = solution.pattern
    if found is None or found.pairs < 2:
        return "no pixel saw the board twice, so that nothing is known of single pixels"
    share = f"{found.seen_share:.0%} of them saw a board"
    if found.offsets is None:
        return f"pixels differ by no more than noise makes ({1000 * found.at_most_m:.1f} mm would show), {share}"
    return f"pixels differ by {1000 * found.offsets.pattern_sigma_m:.1f} mm (standard deviation), {share}"
