"""Report of the calibration study: our Table 2 next to the paper's, the best configuration and its bars."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from cairn_calib.report.page import page
from cairn_calib.verify.disc_images import Method
from cairn_calib.verify.verification_report import camera_table, difference_plots
from cairn_calib.verify.verification_table import CameraRow
from cairn_sim.study.run import METHODS, StudyOutcome

PAPER: Mapping[str, tuple[float, float, float, float]] = {
    "c4": (5.8, 6.2, 2.3, 3.0),
    "c5": (3.4, 3.6, 1.5, 1.3),
    "c6": (3.0, 3.2, 1.5, 1.1),
    "c7": (3.8, 3.6, 1.3, 1.3),
    "c8": (2.7, 2.8, 1.4, 1.1),
    "c9": (3.6, 4.0, 1.3, 1.2),
    "c10": (2.8, 3.2, 1.1, 1.2),
}
"""Table 2 as printed: sigma of colour left and right, thermal left and right, of the configurations 4 to 10."""
CAMERAS = ("colour_left", "colour_right", "thermal_left", "thermal_right")
BARS: Mapping[Method, tuple[float, float]] = {"paper": (2.8, 1.1), "grey": (1.5, 0.6)}
"""Pixels of colour and thermal cameras that the best configuration's sigma must not exceed."""
EXPECTED_WITHIN = 0.10
"""Relative difference allowed between the best configuration's root mean square and its expected total."""
NOT_THE_SAME = (
    "The paper's Table 1, which said what its configurations were, is lost: equal numbers name different sets of "
    "images. Its configurations 1 to 3 were far from real."
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Study:
    """Study that was run: its parameters and the outcome of each configuration."""

    outcomes: Sequence[StudyOutcome]
    images: int
    """Images of the circle targets."""
    seed: int
    scale: float
    """Size of colour and thermal images, as a share of the sensor's."""

    @property
    def best(self) -> StudyOutcome | None:
        """The configuration with the least error by grey centroids, None if all are refused."""
        solved = [outcome for outcome in self.outcomes if outcome.rig is not None]
        return min(solved, key=lambda outcome: outcome.score("grey"), default=None)


def study_text(study: Study) -> str:
    """The tables as lines of text."""
    lines: list[str] = []
    for method in METHODS:
        lines.append(f"sigma, px, centroids by method {method}; in brackets the paper's, of other images")
        lines.append(f"{'':4} " + " ".join(f"{camera:>18}" for camera in CAMERAS))
        lines += [_text_line(outcome, method) for outcome in study.outcomes]
        lines.append("")
    best = study.best
    if best is None:
        return "\n".join([*lines, "every configuration is refused: there is no best"])
    lines.append(f"best: {best.name} ({best.configuration.about})")
    for method in METHODS:
        lines += [f"  {line}" for line in judged(best.tables[method], method, scale=study.scale)]
    return "\n".join(lines)


def judged(rows: Sequence[CameraRow], method: Method, *, scale: float = 1.0) -> list[str]:
    """Bars of the best configuration and whether it meets them, a line for each camera; `scale` of the images' size."""
    lines = []
    for row in rows:
        bar = scale * BARS[method][0 if row.camera.startswith("colour") else 1]
        told = "met" if row.sigma_px <= bar else "MISSED"
        line = f"{method:<5} {row.camera:<13} sigma {row.sigma_px:.2f} px, at most {bar:g}: {told}"
        if row.total_px:
            off = row.rms_px / row.total_px - 1
            within = "met" if abs(off) <= EXPECTED_WITHIN else "MISSED"
            line += f"; rms {row.rms_px:.2f} px, expected {row.total_px:.2f} ({off:+.0%}): {within}"
        lines.append(line)
    return lines


def study_page(study: Study) -> str:
    """The whole page."""
    best = study.best
    return page(
        "study.html",
        package="cairn_sim.study",
        study=study,
        best=best,
        cameras=CAMERAS,
        tables=[(method, [_page_row(outcome, method) for outcome in study.outcomes]) for method in METHODS],
        not_the_same=NOT_THE_SAME,
        judgements=[
            line for method in METHODS if best for line in judged(best.tables[method], method, scale=study.scale)
        ],
        table=camera_table(best.tables["grey"]) if best else None,
        figures=difference_plots(best.sightings["grey"]) if best else None,
    )


def study_json(study: Study) -> str:
    """Everything as JSON."""
    document = {
        "format": "cairn-study",
        "version": 1,
        "images": study.images,
        "seed": study.seed,
        "scale": study.scale,
        "best": study.best.name if study.best else None,
        "paper_sigma_px": {name: dict(zip(CAMERAS, row, strict=True)) for name, row in PAPER.items()},
        "configurations": [
            {
                "name": outcome.name,
                "about": outcome.configuration.about,
                "images": len(outcome.configuration.places),
                "refusal": outcome.refusal or None,
                "tables": {method: [row.to_json() for row in rows] for method, rows in outcome.tables.items()},
            }
            for outcome in study.outcomes
        ],
    }
    return json.dumps(document, indent=1) + "\n"


def _text_line(outcome: StudyOutcome, method: Method) -> str:
    if outcome.rig is None:
        return f"{outcome.name:4} refused: {outcome.refusal}"
    rows = {row.camera: row for row in outcome.tables[method]}
    cells = []
    for camera, printed in zip(CAMERAS, PAPER.get(outcome.name, (None,) * 4), strict=True):
        own = f"{rows[camera].sigma_px:.2f}" if camera in rows else "-"
        cells.append(f"{own:>10} {'(' + f'{printed:.1f}' + ')' if printed is not None else '':>7}")
    return f"{outcome.name:4} " + " ".join(cells)


def _page_row(outcome: StudyOutcome, method: Method) -> dict[str, object]:
    """A configuration's line of Table 2: of each camera our sigma, the expected total, and the paper's sigma."""
    rows = {row.camera: row for row in outcome.tables[method]} if outcome.rig is not None else {}
    printed = PAPER.get(outcome.name, (None,) * 4)
    return {
        "name": outcome.name,
        "about": outcome.configuration.about,
        "refusal": "" if outcome.rig is not None else outcome.refusal,
        "outcome": outcome,
        "cells": [(*_cell(rows.get(camera)), paper) for camera, paper in zip(CAMERAS, printed, strict=True)],
    }


def _cell(row: CameraRow | None) -> tuple[str, str]:
    """Sigma, and the total that calibration, centroids and range let expect; as text."""
    if row is None:
        return "-", ""
    return f"{row.sigma_px:.2f}", " / ?" if row.total_px is None else f" / {row.total_px:.2f}"
