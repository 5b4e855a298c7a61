"""Report of a comparison of two calibrations: one sentence, a table, maps over the images, and the same as JSON."""

import json
from collections.abc import Sequence

import numpy as np

from cairn_calib.report.image_overlays import heat_legend, heat_map, quiver
from cairn_calib.report.page import Figure, Table, page
from cairn_calib.rig.rig import Rig
from cairn_calib.verify.rig_comparison import PixelComparison

FORMAT = "cairn-calibration-comparison"


def verdict(names: tuple[str, str], found: Sequence[PixelComparison]) -> str:
    """One sentence: do two calibrations, named as their files are, agree within their stated uncertainty."""
    one, other = names
    judged = [each for each in found if each.agrees is not None]
    largest = max(found, key=lambda each: each.rms_px)
    if len(judged) < len(found):
        return (
            f"whether {one} and {other} agree cannot be said, for they do not both state how certain they are: they "
            f"differ by up to {largest.rms_px:.2g} px rms ({what_of(largest)})"
        )
    if all(each.agrees for each in judged):
        return f"{one} and {other} agree within their stated uncertainty: they are up to {_sizes(largest)}"
    worst = max(judged, key=lambda each: (each.score or 0.0) / (each.limit or 1.0))
    length, (x, y) = _largest(worst)
    return (
        f"{one} and {other} do not agree within their stated uncertainty: {_sizes(worst)}, most at pixel "
        f"({x:.0f}, {y:.0f}), by {length:.2g} px"
    )


def _sizes(each: PixelComparison) -> str:
    return f"{each.rms_px:.2g} px rms apart where {each.expected_px:.2g} px is expected ({what_of(each)})"


def what_of(each: PixelComparison) -> str:
    """Subject of a comparison, in words."""
    far = "infinity" if np.isinf(each.range_m) else f"{each.range_m:g} m"
    return f"lens of {each.camera}, {far}" if each.source is None else f"{each.source} to {each.camera}, {far}"


def comparison_table(found: Sequence[PixelComparison]) -> Table:
    """A row for each comparison."""
    rows = []
    for each in found:
        length, (x, y) = _largest(each)
        expected = "not stated" if each.expected_px is None else f"{each.expected_px:.3f}"
        score = "" if each.score is None or each.limit is None else f"{each.score:.2f} (limit {each.limit:.2f})"
        agrees = {None: "unknown", True: "yes", False: "no"}[each.agrees]
        largest = f"{length:.3f} at ({x:.0f}, {y:.0f})"
        rows.append([what_of(each), f"{each.rms_px:.3f}", expected, largest, score, agrees])
    return Table(["compared", "rms, px", "expected, px", "largest, px", "score", "agree"], rows)


def comparison_page(names: tuple[str, str], rigs: tuple[Rig, Rig], found: Sequence[PixelComparison]) -> str:
    """The whole page."""
    return page(
        "comparison.html",
        package="cairn_calib.verify",
        names=names,
        verdict=verdict(names, found),
        table_of=comparison_table(found),
        heat=heat_legend(),
        parts=[{"what": what_of(each), "fitted": _fitted(each), "figures": _figures(rigs[0], each)} for each in found],
    )


def comparison_json(names: tuple[str, str], rigs: tuple[Rig, Rig], found: Sequence[PixelComparison]) -> bytes:
    """The same for programs, UTF-8; what is not known is null."""
    agree = [each.agrees for each in found]
    document = {
        "format": FORMAT,
        "version": 1,
        "files": list(names),
        "rig_sha256": [rig.digest() for rig in rigs],
        "agrees": None if None in agree else all(agree),
        "sentence": verdict(names, found),
        "comparisons": [_entry(each) for each in found],
    }
    return json.dumps(document, indent=1, allow_nan=False).encode() + b"\n"


def _largest(each: PixelComparison) -> tuple[float, tuple[float, float]]:
    """Length of the largest difference, of both axes together, and its place."""
    lengths = np.where(np.isfinite(each.lengths_px), each.lengths_px, -1.0)
    x, y = each.at_px[np.unravel_index(int(lengths.argmax()), lengths.shape)].tolist()
    return float(np.sqrt(2) * lengths.max()), (x, y)


def _fitted(each: PixelComparison) -> str:
    """The fitted pose in words; empty where nothing was fitted."""
    if each.source is not None:
        return ""
    turned = np.degrees(np.arccos(np.clip((np.trace(each.T_b_a[:3, :3]) - 1) / 2, -1, 1)))
    moved = 1000 * np.linalg.norm(each.T_b_a[:3, 3])
    shift = "" if np.isinf(each.range_m) else f" and moved by {moved:.2f} mm"
    return f"The second was turned by {turned:.4f} degrees{shift} to fit the first: that much is no difference."


def _figures(rig: Rig, each: PixelComparison) -> list[Figure]:
    camera = rig[each.camera].camera
    size = (camera.width, camera.height)
    known = np.isfinite(each.difference_px[..., 0]) & np.isfinite(each.at_px[..., 0])
    at, moved = each.at_px[known], each.difference_px[known]
    arrows = quiver(size, at, moved, np.ones(len(at), np.bool_), each.rms_px)
    figures = [
        Figure(
            arrows, f"From the first to the second: {2 * each.rms_px:.2g} px are as long as 4 % of the image is wide"
        )
    ]
    # Of a pair the map's rows and columns are those of the camera that is carried from.
    where = "" if each.source is None else f", over the image of {each.source}"
    shape_of = size if each.source is None else (rig[each.source].camera.width, rig[each.source].camera.height)
    figures.append(
        Figure(heat_map(shape_of, each.lengths_px, "Difference"), f"Difference{where}: {_span(each.lengths_px)}")
    )
    if each.sigma_px is not None:
        figures.append(
            Figure(heat_map(shape_of, each.sigma_px, "Expected"), f"Expected by both{where}: {_span(each.sigma_px)}")
        )
    return figures


def _span(values: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> str:
    known = values[np.isfinite(values)]
    return f"{known.min():.2g} to {known.max():.2g} px, median {np.median(known):.2g}" if known.size else "not seen"


def _entry(each: PixelComparison) -> dict[str, object]:
    length, (x, y) = _largest(each)
    return {
        "camera": each.camera,
        "source": each.source,
        "range_m": None if np.isinf(each.range_m) else each.range_m,
        "rms_px": each.rms_px,
        "expected_px": each.expected_px,
        "largest_px": length,
        "largest_at": [x, y],
        "score": each.score,
        "limit": each.limit,
        "agrees": each.agrees,
        "T_b_a": None if each.source is not None else each.T_b_a.tolist(),
        "difference_px": _rounded(each.lengths_px),
        "sigma_px": None if each.sigma_px is None else _rounded(each.sigma_px),
    }


def _rounded(values: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> list[list[float | None]]:
    return [[round(value, 4) if np.isfinite(value) else None for value in row] for row in values.tolist()]
