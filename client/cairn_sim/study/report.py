"""The study's results: our Table 2 beside the paper's, the best configuration and whether it does what it must."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape

from cairn_calib.verify.disc_images import Method
from cairn_calib.verify.verification_report import camera_table, figures, page
from cairn_calib.verify.verification_table import CameraRow
from cairn_sim.study.run import METHODS, Outcome

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
"""Of the expected total, for the root mean square of the best."""
NOT_THE_SAME = (
    "The paper's Table 1, which said what its configurations were, is lost: equal numbers name different sets of "
    "images. Its configurations 1 to 3 were far from real."
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Study:
    """What was done, and what came of it."""

    outcomes: Sequence[Outcome]
    images: int
    """Of targets."""
    seed: int
    scale: float
    """Of colour and thermal images."""

    @property
    def best(self) -> Outcome | None:
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
    """What the best configuration must do, and does or not, a line for each camera; `scale` of the images' size."""
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
    parts = [
        "<h1>Which board images calibrate best</h1>",
        '<p class="lead">Sets of 2 to 9 images of a heated checkerboard, each solved by itself, then verified with '
        f"circle targets in {study.images} images; simulated head of Orpheus-X4, standard noise, colour and thermal "
        f"images at {study.scale:g} of their size, seed {study.seed}.</p>",
    ]
    parts += [
        f"<h2>Table 2, centroids by method {method}</h2>{_page_table(study.outcomes, method, best)}"
        for method in METHODS
    ]
    parts.append(
        "<p>sigma = sqrt((sigma_x² + sigma_y²) / 2), pixels of each camera; after the slash what the calibration, the "
        f"centroids and the range let expect; tinted: the paper's. {escape(NOT_THE_SAME)}</p>"
    )
    if best is not None:
        lines = "".join(
            f"<li>{escape(line)}</li>"
            for method in METHODS
            for line in judged(best.tables[method], method, scale=study.scale)
        )
        parts.append(f"<h2>Best: {best.name}, {escape(best.configuration.about)}</h2><ul>{lines}</ul>")
        parts += [camera_table(best.tables["grey"]), figures(best.sightings["grey"])]
    return page("Image configurations", "".join(parts))


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


def _text_line(outcome: Outcome, method: Method) -> str:
    if outcome.rig is None:
        return f"{outcome.name:4} refused: {outcome.refusal}"
    rows = {row.camera: row for row in outcome.tables[method]}
    cells = []
    for camera, printed in zip(CAMERAS, PAPER.get(outcome.name, (None,) * 4), strict=True):
        own = f"{rows[camera].sigma_px:.2f}" if camera in rows else "-"
        cells.append(f"{own:>10} {'(' + f'{printed:.1f}' + ')' if printed is not None else '':>7}")
    return f"{outcome.name:4} " + " ".join(cells)


def _page_table(outcomes: Sequence[Outcome], method: Method, best: Outcome | None) -> str:
    head = "".join(f'<th colspan="2">{camera}</th>' for camera in CAMERAS)
    lines = []
    for outcome in outcomes:
        kind = ' class="best"' if outcome is best else ""
        start = (
            f'<tr{kind}><th scope="row">{outcome.name}</th><td class="words">{escape(outcome.configuration.about)}</td>'
        )
        if outcome.rig is None:
            lines.append(f'{start}<td class="words" colspan="8">refused: {escape(outcome.refusal)}</td></tr>')
            continue
        rows = {row.camera: row for row in outcome.tables[method]}
        cells = [
            _cell(rows.get(camera)) + f'<td class="paper">{"" if printed is None else printed}</td>'
            for camera, printed in zip(CAMERAS, PAPER.get(outcome.name, (None,) * 4), strict=True)
        ]
        lines.append(f"{start}{''.join(cells)}</tr>")
    return f"<table><thead><tr><th></th><th></th>{head}</tr></thead><tbody>{''.join(lines)}</tbody></table>"


def _cell(row: CameraRow | None) -> str:
    if row is None:
        return "<td>-</td>"
    total = "?" if row.total_px is None else f"{row.total_px:.2f}"
    return f"<td><b>{row.sigma_px:.2f}</b> / {total}</td>"
