"""The calibration's report: one HTML file with everything in it, to be read without a network and to be printed."""

import time
from collections.abc import Mapping, Sequence
from html import escape

import numpy as np

from cairn_calib.diagnosis.examination import Examination
from cairn_calib.diagnosis.probe_points import RANGES_M
from cairn_calib.diagnosis.view_residuals import ViewResiduals, view_residuals
from cairn_calib.diagnosis.world_uncertainty import sigma_map, transfer_map
from cairn_calib.report.range_report import range_section
from cairn_calib.report.report_images import ReportImage, images_section
from cairn_calib.report.report_radiometry import radiometry_section
from cairn_calib.report.solve_plots import coverage_picture, heat_legend, heat_map, quiver
from cairn_calib.report.solve_tables import board_table, image_table, lens_table, place_table, statistics_table, table

STYLE = """
:root { color-scheme: light; }
body { font: 15px/1.5 system-ui, "DejaVu Sans", sans-serif; color: #1c2430; background: #fff; max-width: 1100px;
  margin: 2.2rem auto; padding: 0 1.5rem; }
h1 { font-size: 1.75rem; margin: 0 0 .3rem; } h3 { margin: 1.4rem 0 .3rem; font-size: 1.05rem; }
h2 { font-size: 1.2rem; margin: 2.2rem 0 .5rem; padding-top: .8rem; border-top: 1px solid #d5dae1; }
p, li { max-width: 85ch; } .lead, figcaption, .legend, .held { color: #46505e; }
.cards { display: flex; flex-wrap: wrap; gap: .8rem; margin: 1.2rem 0; }
.card { flex: 1 1 150px; border: 1px solid #d5dae1; border-radius: 6px; padding: .7rem .9rem; }
.card b { display: block; font-size: 1.4rem; font-weight: 600; } .card span { color: #46505e; font-size: .85rem; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; margin: .6rem 0; font-variant-numeric: tabular-nums; font-size: .88rem; }
th, td { padding: .22rem .6rem; text-align: right; border-bottom: 1px solid #e6e9ee; white-space: nowrap; }
thead th { border-bottom: 1px solid #98a2b0; } tbody th { text-align: left; font-weight: 500; }
.out { color: #b3261e; font-weight: 500; }
.warning { background: #fdf3e3; border-left: 3px solid #d08a1d; padding: .4rem .9rem; margin: .5rem 0; }
.warning small { color: #6b4d12; } .fine { background: #eaf5ec; border-left: 3px solid #3b7d4f; padding: .4rem .9rem; }
.row { display: grid; grid-template-columns: 1fr 1fr; gap: .6rem 1.4rem; }
.three { display: grid; grid-template-columns: 1fr 1fr 1fr; gap: .5rem 1rem; }
figure { margin: .4rem 0; break-inside: avoid; } figcaption { font-size: .85rem; }
.shots { display: grid; grid-template-columns: repeat(auto-fill, minmax(200px, 1fr)); gap: .5rem .9rem; }
.shots svg { width: 100%; height: auto; display: block; } .shots figcaption { font-size: .78rem; }
svg.image { width: 100%; height: auto; border: 1px solid #c5ccd6; background: #fbfcfd; overflow: hidden; }
svg rect { shape-rendering: crispEdges; }
svg path { fill: none; stroke-width: var(--line); }
.miss { stroke: #2563a8; } path.out { stroke: #b3261e; }
.dots { stroke: #1c2430; stroke-width: calc(2 * var(--line)); stroke-linecap: round; opacity: .55; }
circle.next { fill: #fff; stroke: #c2570c; stroke-width: calc(2 * var(--line)); }
text.next { fill: #c2570c; text-anchor: middle; font-weight: 700; font-family: system-ui, sans-serif; }
.ramp { display: inline-block; width: 12em; height: .8em; vertical-align: middle; margin: 0 .4em; }
.legend { font-size: .85rem; }
@media print { html { font-size: 10px; } body { margin: 0; padding: 0; max-width: none; font-size: 11px;
    print-color-adjust: exact; -webkit-print-color-adjust: exact; }
  h2, h3, .legend { break-after: avoid; } tr, .card, .warning { break-inside: avoid; } th, td { padding: .2rem .4rem; }
  .wide { overflow: visible; } .shots { grid-template-columns: repeat(5, 1fr); } }
"""


def report_page(seen: Examination, images: Mapping[str, Sequence[ReportImage]] | None = None) -> str:
    """The whole page of an examined solution; `images` by camera, to be looked at."""
    residuals = view_residuals(seen.solution)
    cameras = list(seen.solution.plan.cameras)
    parts = [
        _head(seen),
        _warnings(seen),
        "<h2>What to shoot next</h2>",
        _next(seen),
        "<h2>Cameras</h2>",
        lens_table(seen),
        "<p>A value and its standard deviation, of everything estimated together.</p>",
        place_table(seen),
        board_table(seen),
        range_section(seen),
        "<h2>Residuals, coverage and certainty</h2>",
        heat_legend(),
        *(_camera(seen, name, [each for each in residuals if each.camera == name]) for name in cameras),
        "<h2>Two halves</h2>",
        _halves(seen),
        "<h2>Images</h2>",
        "<p>Root mean square of an image's residuals, pixels of one axis.</p>",
        image_table(residuals, cameras, seen.solution.views.frames),
        _influences(seen),
        radiometry_section(seen.rig),
        images_section(images or {}, residuals),
    ]
    title = f"cairn: calibration of {escape(seen.rig.name)}"
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{title}</title><style>{STYLE}</style></head>\n<body>{''.join(parts)}</body></html>\n"
    )


def _head(seen: Examination) -> str:
    calibration = seen.rig.calibration
    if calibration is None or calibration.statistics is None:
        return ""
    fit, solution = calibration.statistics, seen.solution
    made = time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime(calibration.made_s))
    cards = [(str(len(solution.views.frames)), "places of the board"), (str(len(solution.views.views)), "images")]
    ratio = fit.chi2 / max(fit.degrees_of_freedom, 1)
    cards.append((f"{ratio:.3f}", f"chi2 over {fit.degrees_of_freedom} degrees of freedom, by the estimated noise"))
    for each in seen.probes:
        sigma = float(np.median(each.sigmas_px(solution.covariance)))
        gauge = solution.plan.gauge
        what = (
            f"{each.camera}: a direction of its frame" if each.camera == gauge else f"{each.camera}: a pixel of {gauge}"
        )
        cards.append((f"{sigma:.2g} px", f"{what}, median sigma"))
    shown = "".join(f'<div class="card"><b>{value}</b><span>{escape(what)}</span></div>' for value, what in cards)
    board = solution.views.board
    return (
        f"<h1>Calibration of {escape(seen.rig.name)}</h1><p class='lead'>{made}, {escape(calibration.software)}; "
        f"{board.columns} x {board.rows} {board.pattern}, pitch {1000 * board.pitch_m:g} mm; the rig's frame is "
        f"{escape(calibration.gauge)}.</p><div class='cards'>{shown}</div>{statistics_table(fit)}"
    )


def _warnings(seen: Examination) -> str:
    if not seen.warnings:
        return '<h2>Warnings</h2><p class="fine">None: the images determine all that was estimated.</p>'
    items = "".join(
        f'<p class="warning">{escape(f"{each.camera}: " if each.camera else "")}{escape(each.text)}. <small>'
        f"{escape(each.kind)}: {each.measured:.3g}, threshold {each.threshold:.3g} {escape(each.unit)}</small></p>"
        for each in seen.warnings
    )
    return f"<h2>Warnings</h2>{items}"


def _next(seen: Examination) -> str:
    if not seen.next_images:
        return "<p>No further image of the board would tell much.</p>"
    items = "".join(
        f"<li>{escape(str(each))}: the variance of where things appear falls by {each.gain:.0%}.</li>"
        for each in seen.next_images
    )
    return f"<p>Each for itself; the numbers stand in the pictures of coverage, too.</p><ol>{items}</ol>"


def _camera(seen: Examination, name: str, residuals: Sequence[ViewResiduals]) -> str:
    solution, gauge = seen.solution, seen.solution.plan.gauge
    size = solution.views.sizes_px[name]
    corners = np.concatenate([each.pixels for each in residuals])
    misses = np.concatenate([each.misses_px for each in residuals])
    kept = np.concatenate([each.kept for each in residuals])
    sigma = float(np.sqrt(np.mean(misses[kept] ** 2))) if kept.any() else 1.0
    covered = next(each for each in seen.coverage if each.camera == name)
    arrows = _figure(
        quiver(size, corners, misses, kept, sigma),
        f"Residuals, enlarged so that {2 * sigma:.2g} px are as long as 4 % of the image is wide; red: left out",
    )
    parts = _figure(
        coverage_picture(size, covered, corners, seen.next_images),
        f"Corners of {covered.images} images; {covered.cell_share:.0%} of the parts covered, tilted by up to "
        f"{covered.tilt_deg:.0f} degrees, {covered.nearest_m:.2f} to {covered.farthest_m:.2f} m away",
    )
    own = "".join(
        _map_figure(size, sigma_map(solution, seen.rig, name, far), f"The world at {far:g} m") for far in RANGES_M
    )
    carried = (
        ""
        if name == gauge
        else "".join(
            _map_figure(size, transfer_map(seen.rig, gauge, name, far), f"What {gauge} sees at {far:g} m")
            for far in RANGES_M
        )
    )
    maps = f'<div class="three">{own}{carried}</div>'
    return f'<h3>{escape(name)}</h3><div class="row">{arrows}{parts}</div>{maps}'


def _map_figure(size_px: tuple[int, int], sigmas: np.ndarray[tuple[int, ...], np.dtype[np.float64]], what: str) -> str:
    seen = sigmas[np.isfinite(sigmas)]
    told = f"{seen.min():.2g} to {seen.max():.2g} px, median {np.median(seen):.2g}" if seen.size else "not seen"
    return _figure(heat_map(size_px, sigmas, what), f"{what}: {told}")


def _figure(svg: str, caption: str) -> str:
    return f"<figure>{svg}<figcaption>{escape(caption)}</figcaption></figure>"


def _halves(seen: Examination) -> str:
    if seen.halves is None:
        return "<p>There are too few images for two halves.</p>"
    rows = [
        [escape(each.camera), f"{each.difference_px:.3f}", f"{each.predicted_px:.3f}", f"{each.ratio:.2f}"]
        for each in seen.halves.cameras
    ]
    return (
        "<p>Every second frame against the others, both solved for themselves: how far points moved, and how far "
        f"they may by both covariances. All {seen.halves.parameters} parameters: chi2 {seen.halves.chi2:.0f}.</p>"
        + table(["camera", "difference, px", "expected, px", "ratio"], rows)
    )


def _influences(seen: Examination) -> str:
    rows = [
        [escape(each.frame), f"{each.moves_px:.3f}", escape(each.camera), f"{each.sigmas:.2f}"]
        for each in seen.influences[:8]
    ]
    return (
        "<p>Frames without which most would change: how far a point would move at most, and in its own standard "
        "deviations.</p>" + table(["frame", "moves by, px", "in", "sigmas"], rows)
    )
