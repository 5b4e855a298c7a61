"""What a calibration found of its ranges, for people: a line, a table, a curve and maps of the pixels."""

from html import escape

import numpy as np

from cairn_calib.diagnosis.examination import Examination
from cairn_calib.report.range_plots import bias_curve, offset_map, sigma_map_mm
from cairn_calib.report.solve_tables import plus_minus, table
from cairn_calib.rig.pixel_offsets import PixelOffsets
from cairn_calib.rig.range_terms import wave_period_m
from cairn_calib.solve.range_choice import RangeSpans
from cairn_calib.solve.solve import Solution

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
    sensor, values = solution.adjusted.problem.sensors[-1], solution.values()
    name = solution.views.cameras[used.camera]
    more = [f", wave {k}" for k in used.terms.harmonics]
    more += [", amplitude"] if used.terms.amplitude_at is not None else []
    return (
        f"{name} ranges: {len(used.frames)} images  {int(used.measured.sum())} pixels  "
        f"{int((sensor.there & ~sensor.kept).sum())} outliers  noise {1000 * sensor.scale * used.sigma_m:.1f} mm  "
        f"offset {1000 * values[name, 'offset_m']:.1f} mm{''.join(more)}; {_pixels_told(solution)}\n"
    )


def ranges_json(solution: Solution) -> dict[str, object] | None:
    """The same for programs: metres, counts, hertz; None where there are none."""
    used, spans, found = solution.ranges, solution.spans, solution.pattern
    if used is None or spans is None:
        return None
    sensor = solution.adjusted.problem.sensors[-1]
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


def range_section(seen: Examination) -> str:
    """The report's part about ranges, HTML; empty where there are none."""
    solution, spans = seen.solution, seen.solution.spans
    used = solution.ranges
    if used is None or spans is None:
        return ""
    name = solution.views.cameras[used.camera]
    bias = seen.rig[name].range_bias
    values, sigmas = solution.values(), solution.sigmas()
    rows = [
        [_words(each, solution), plus_minus(values[name, each], sigmas[name, each], factor=1000)]
        for each in used.terms.document_names
    ]
    curve = (
        ""
        if bias is None
        else _figure(
            bias_curve(bias, (spans.nearest_m, spans.farthest_m)),
            "What the middle of the image adds to a range, at the usual amplitude, with its standard deviation; "
            "tinted: where boards were, beyond them it is extrapolated",
        )
    )
    offsets = None if bias is None else bias.pixel_offsets
    return (
        f"<h2>Ranges of {escape(name)}</h2><p>{escape(_spans_told(spans, solution))}</p>"
        f'<div class="row"><div>{table(["what it adds to a range", "estimate"], rows)}</div>{curve}</div>'
        f"<p>Pixel by pixel: {escape(_pixels_told(solution))}.</p>{'' if offsets is None else _maps(offsets)}"
    )


def _maps(offsets: PixelOffsets) -> str:
    counts = offsets.counts
    many = int(np.median(counts[counts > 0])) if counts.any() else 0
    limit_mm, unseen_mm = 3000 * offsets.pattern_sigma_m, 1000 * offsets.unseen_sigma_m
    first = _figure(
        offset_map(1000 * np.where(counts > 0, offsets.offset_m, np.nan), limit_mm),
        f"What each pixel adds beside what all do: blue {-limit_mm:.1f} mm and below, red {limit_mm:.1f} mm and above, "
        f"grey: no board was there, 0 +- {unseen_mm:.1f} mm; {many} boards a pixel (median)",
    )
    low, high = 1000 * float(offsets.sigma_m.min()), 1000 * float(offsets.sigma_m.max())
    second = _figure(
        sigma_map_mm(1000 * offsets.sigma_m, low, high),
        f"Its standard deviation: dark {low:.1f} mm, yellow {high:.1f} mm",
    )
    return f'<div class="row">{first}{second}</div>'


def _words(name: str, solution: Solution) -> str:
    if name in WORDS:
        return WORDS[name]
    wave, part, _ = name.split("_")
    k = int(wave.removeprefix("wiggle"))
    used = solution.ranges
    modulation_hz = None if used is None else used.terms.modulation_hz
    period = "" if modulation_hz is None else f" (period {wave_period_m(modulation_hz, k):.2f} m)"
    return f"wave {k}{period}, {'cosine' if part == 'cos' else 'sine'}, mm"


def _spans_told(spans: RangeSpans, solution: Solution) -> str:
    used = solution.ranges
    told = f"Board pixels from {spans.nearest_m:.2f} to {spans.farthest_m:.2f} m"
    if spans.amplitudes is not None:
        low, middle, high = spans.amplitudes
        told += f", of amplitudes {low:.0f} to {high:.0f}, usually {middle:.0f}"
    left_out = []
    if used is not None and not used.terms.harmonics:
        left_out.append("circular error")
    if used is not None and used.terms.amplitude_at is None:
        left_out.append("dependence on the amplitude")
    return told + (f". Left out, for the images do not determine it: {' and '.join(left_out)}." if left_out else ".")


def _pixels_told(solution: Solution) -> str:
    found = solution.pattern
    if found is None or found.pairs < 2:
        return "no pixel saw the board twice, so that nothing is known of single pixels"
    share = f"{found.seen_share:.0%} of them saw a board"
    if found.offsets is None:
        return f"pixels differ by no more than noise makes ({1000 * found.at_most_m:.1f} mm would show), {share}"
    return f"pixels differ by {1000 * found.offsets.pattern_sigma_m:.1f} mm (standard deviation), {share}"


def _figure(svg: str, caption: str) -> str:
    return f"<figure>{svg}<figcaption>{escape(caption)}</figcaption></figure>"
