"""The calibration's report: one HTML file with everything in it, to be read without a network and to be printed."""

import time
from collections.abc import Mapping, Sequence

import numpy as np

from cairn_calib.diagnosis.examination import Examination
from cairn_calib.diagnosis.probe_points import RANGES_M
from cairn_calib.diagnosis.verdict import merged
from cairn_calib.diagnosis.view_statistics import ViewResiduals, view_residuals
from cairn_calib.diagnosis.world_uncertainty import sigma_map, transfer_map
from cairn_calib.report.image_overlays import coverage_picture, heat_legend, heat_map, quiver
from cairn_calib.report.page import Figure, Table, page
from cairn_calib.report.range_report import range_facts
from cairn_calib.report.report_images import ReportImage, image_figures
from cairn_calib.report.report_radiometry import radiometry_facts
from cairn_calib.report.solve_tables import (
    board_table,
    image_table,
    lens_table,
    place_table,
    plus_minus,
    statistics_table,
)
from cairn_calib.report.straight_lines import straight_figure
from cairn_calib.report.validity import validity, validity_figure, validity_rows
from cairn_calib.rig.projection_uncertainty import mounted_lens
from cairn_map.arrays import Floats

VALIDITY_HEAD = ("distance", "boards", "median sigma inside, px", "largest sigma outside, px")
INFLUENCES = 8
"""Frames of greatest influence that the report lists."""


def report_page(seen: Examination, images: Mapping[str, Sequence[ReportImage]] | None = None) -> str:
    """The whole page of an examined solution; `images` by camera, to be looked at."""
    residuals = view_residuals(seen.solution)
    cameras = list(seen.solution.plan.cameras)
    return page(
        "solve.html",
        rig=seen.rig.name,
        head=_head(seen),
        verdict=str(seen.verdict),
        warnings=merged(seen.warnings),
        known=_known(seen),
        next_images=seen.next_images,
        lenses=lens_table(seen),
        places=place_table(seen),
        board=board_table(seen),
        ranges=range_facts(seen),
        heat=heat_legend(),
        cameras=[
            _camera(seen, name, [each for each in residuals if each.camera == name], (images or {}).get(name, ()))
            for name in cameras
        ],
        halves=_halves(seen),
        images=image_table(residuals, cameras, seen.solution.views.frames),
        influences=_influences(seen),
        radiometry=radiometry_facts(seen.rig),
        shots=image_figures(images or {}, residuals),
    )


def _head(seen: Examination) -> dict[str, object] | None:
    """Facts of the page's head; None for a rig without a calibration record."""
    calibration = seen.rig.calibration
    if calibration is None or calibration.statistics is None:
        return None
    fit, solution = calibration.statistics, seen.solution
    cards = [(str(len(solution.views.frames)), "places of the board"), (str(len(solution.views.views)), "images")]
    ratio = fit.chi2 / max(fit.degrees_of_freedom, 1)
    cards.append((f"{ratio:.3f}", f"chi2 over {fit.degrees_of_freedom} degrees of freedom, by the estimated noise"))
    gauge = solution.plan.gauge
    for each in seen.probes:
        sigma = float(np.median(each.sigmas_px(solution.covariance)))
        target = "a direction of its frame" if each.camera == gauge else f"a pixel of {gauge}"
        cards.append((f"{sigma:.2g} px", f"{each.camera}: {target}, median sigma"))
    board = solution.views.board
    return {
        "made": time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime(calibration.made_s)),
        "software": calibration.software,
        "board": f"{board.count} named points"
        if board.named is not None
        else f"{board.columns} x {board.rows} {board.pattern}, pitch {1000 * board.pitch_m:g} mm",
        "gauge": calibration.gauge,
        "cards": cards,
        "statistics": statistics_table(fit),
    }


def _camera(
    seen: Examination, name: str, residuals: Sequence[ViewResiduals], images: Sequence[ReportImage]
) -> dict[str, object]:
    """Pictures of one camera: residuals, coverage, and maps of its uncertainty at several ranges."""
    solution, gauge = seen.solution, seen.solution.plan.gauge
    size = solution.views.sizes_px[name]
    corners = np.concatenate([each.pixels for each in residuals])
    misses = np.concatenate([each.misses_px for each in residuals])
    kept = np.concatenate([each.kept for each in residuals])
    sigma = float(np.sqrt(np.mean(misses[kept] ** 2))) if kept.any() else 1.0
    covered = next(each for each in seen.coverage if each.camera == name)
    maps = [_map_figure(size, sigma_map(solution, seen.rig, name, far), f"The world at {far:g} m") for far in RANGES_M]
    if name != gauge:
        maps += [
            _map_figure(size, transfer_map(seen.rig, gauge, name, far), f"What {gauge} sees at {far:g} m")
            for far in RANGES_M
        ]
    known = validity(seen, name, residuals)
    return {
        "name": name,
        "valid": validity_figure(size, known),
        "by_range": Table(VALIDITY_HEAD, validity_rows(known)),
        "straight": straight_figure(mounted_lens(seen.rig, name), images),
        "arrows": Figure(
            quiver(size, corners, misses, kept, sigma),
            f"Residuals, enlarged so that {2 * sigma:.2g} px are as long as 4 % of the image is wide; red: left out",
        ),
        "coverage": Figure(
            coverage_picture(size, covered, corners, seen.next_images),
            f"Corners of {covered.images} images; {covered.cell_share:.0%} of the parts covered, tilted by up to "
            f"{covered.lean_deg:.0f} degrees, {covered.nearest_m:.2f} to {covered.farthest_m:.2f} m away",
        ),
        "maps": maps,
    }


def _map_figure(size_px: tuple[int, int], sigmas: Floats, title: str) -> Figure:
    known = sigmas[np.isfinite(sigmas)]
    span = f"{known.min():.2g} to {known.max():.2g} px, median {np.median(known):.2g}" if known.size else "not seen"
    return Figure(heat_map(size_px, sigmas, title), f"{title}: {span}")


def _halves(seen: Examination) -> dict[str, object] | None:
    if seen.halves is None:
        return None
    rows = [
        [each.camera, f"{each.difference_px:.3f}", f"{each.predicted_px:.3f}", f"{each.ratio:.2f}"]
        for each in seen.halves.cameras
    ]
    table = Table(["camera", "difference, px", "expected, px", "ratio"], rows)
    return {"parameters": seen.halves.parameters, "chi2": seen.halves.chi2, "table": table}


def _known(seen: Examination) -> Table | None:
    rows = [
        [
            f"{fit.known.camera}: {fit.known.source}",
            name,
            plus_minus(float(fit.known.values[n]), float(np.sqrt(fit.known.covariance[n, n]))),
            f"{fit.values[n]:.6g}",
            f"{fit.sigmas_off[n]:.1f}",
            f"{fit.scale:.1f}" if fit.scale > 1 else "",
        ]
        for fit in seen.solution.known
        for n, name in enumerate(fit.known.names)
    ]
    return Table(["known before", "", "stated", "solved", "sigmas off", "its sigma enlarged"], rows) if rows else None


def _influences(seen: Examination) -> Table:
    rows = [
        [each.frame, f"{each.moves_px:.3f}", each.camera, f"{each.sigmas:.2f}"] for each in seen.influences[:INFLUENCES]
    ]
    return Table(["frame", "moves by, px", "in", "sigmas"], rows)
