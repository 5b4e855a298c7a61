"""A verification as one HTML file, with the paper's Table 2 and Figs 9 to 16, and as JSON."""

import json
from collections.abc import Sequence
from html import escape

from cairn_calib.verify.scatter_plot import scatter_plot
from cairn_calib.verify.verification import Sight, Sightings, source_pixel_in
from cairn_calib.verify.verification_table import SOURCES, CameraRow

STYLE = """
:root { color-scheme: light; }
body { font: 15px/1.5 system-ui, "DejaVu Sans", sans-serif; color: #1c2430; background: #fff; max-width: 1040px;
  margin: 2.2rem auto; padding: 0 1.5rem; }
h1 { font-size: 1.7rem; margin: 0 0 .3rem; } p { max-width: 78ch; } .lead { color: #46505e; margin-top: 0; }
h2 { font-size: 1.2rem; margin: 2.2rem 0 .5rem; padding-top: .8rem; border-top: 1px solid #d5dae1; }
table { border-collapse: collapse; margin: .8rem 0; font-variant-numeric: tabular-nums; font-size: .9rem; }
th, td { padding: .28rem .45rem; text-align: right; border-bottom: 1px solid #e6e9ee; white-space: nowrap; }
thead th { border-bottom: 1px solid #98a2b0; } tbody th, thead th:first-child { text-align: left; font-weight: 500; }
td.main { font-weight: 700; } td.paper { color: #6b4d12; background: #fbf6ea; } tr.best > * { background: #eef7ee; }
td.words { text-align: left; white-space: normal; color: #46505e; }
.pair { display: grid; grid-template-columns: 1fr 1fr; gap: 1rem 1.6rem; } figure { margin: 0; break-inside: avoid; }
svg { width: 100%; height: auto; } .plot text { font: 12px system-ui, "DejaVu Sans", sans-serif; fill: #46505e; }
.plot .title { font-weight: 600; fill: #1c2430; } .plot .grid { stroke: #e9ecf0; } .plot .axis { stroke: #7b8794; }
@media print { html { font-size: 10px; } body { margin: 0; padding: 0; max-width: none; font-size: 11px;
    print-color-adjust: exact; -webkit-print-color-adjust: exact; }
  h2 { break-after: avoid; } table { break-inside: avoid; } th, td { padding: .25rem .35rem; } }
"""
AXES = ("x", "y")
FIRST_FIGURE = 9
"""Of the paper's plots: a camera's x, its y, the next camera's."""


def verification_page(sightings: Sightings, rows: Sequence[CameraRow]) -> str:
    """The whole page."""
    rig = sightings.rig
    parts = [
        f"<h1>How well {escape(rig.name)} carries targets between its cameras</h1>",
        f'<p class="lead">{sightings.targets} targets in {sightings.images} images of {escape(sightings.source)}, '
        f"carried by Eq. 1 to 6 to the other cameras and compared with what these see; "
        f"centroids by method <em>{sightings.method}</em>.</p>",
        "<h2>Table 2</h2>",
        camera_table(rows),
        "<p>Pixels of each camera, one axis. sigma is sqrt((sigma_x² + sigma_y²) / 2), about the mean; its 95 % "
        "interval is by bootstrap over images. rms is with the bias, and is what the expected error must be compared "
        "with: the share of the calibration as the rig states it, of both centroids, and of the range, together.</p>",
        _left_out(sightings),
        figures(sightings),
    ]
    return page("Verification", "".join(parts))


def page(title: str, body: str) -> str:
    """A self-contained HTML document."""
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title>'
        f'<meta name="viewport" content="width=device-width"><style>{STYLE}</style></head><body>{body}</body></html>\n'
    )


def camera_table(rows: Sequence[CameraRow]) -> str:
    """Table 2 of one calibration, as HTML."""
    head = (
        "camera",
        "n",
        "sigma_x",
        "sigma_y",
        "sigma",
        "95 % interval",
        "bias x",
        "bias y",
        "rms",
        "expected",
        *SOURCES,
    )
    lines = []
    for row in rows:
        shares = [row.total_px, *(row.expected_px[source] for source in SOURCES)]
        cells = [
            f"<td>{row.count}</td><td>{row.sigma_x_px:.2f}</td><td>{row.sigma_y_px:.2f}</td>",
            f'<td class="main">{row.sigma_px:.2f}</td><td>{row.sigma_low_px:.2f} to {row.sigma_high_px:.2f}</td>',
            f"<td>{row.bias_x_px:.2f}</td><td>{row.bias_y_px:.2f}</td><td>{row.rms_px:.2f}</td>",
            *(f"<td>{'unknown' if share is None else f'{share:.2f}'}</td>" for share in shares),
        ]
        lines.append(f'<tr><th scope="row">{escape(row.camera)}</th>{"".join(cells)}</tr>')
    titles = "".join(f"<th>{title}</th>" for title in head)
    return f"<table><thead><tr>{titles}</tr></thead><tbody>{''.join(lines)}</tbody></table>"


def figures(sightings: Sightings) -> str:
    """Figs 9 to 16: differences against the radius in the range camera's image; and the same against the range."""
    by_radius, by_range = [], []
    number = FIRST_FIGURE
    for camera in sightings.cameras:
        sights = sightings.of_camera(camera)
        band = source_pixel_in(sightings.rig, sightings.source, camera) / 2
        for axis, name in enumerate(AXES):
            y = [float(sight.difference_px[axis]) for sight in sights]
            label = f"difference in {name}, px"
            x, where = [sight.radius_px for sight in sights], f"radius in {sightings.source}, px"
            title = f"Fig. {number}: {camera}, {name}"
            by_radius.append(scatter_plot(x, y, title=title, x_label=where, y_label=label, band=band))
            x, title = [sight.range_m for sight in sights], f"{camera}, {name}"
            by_range.append(scatter_plot(x, y, title=title, x_label="range, m", y_label=label, band=band))
            number += 1
    return (
        "<h2>Figs 9 to 16: differences against the radius in the range camera's image</h2>"
        f"<p>Predicted minus found. Orange: half a pixel of {escape(sightings.source)}. Differences that grow to "
        f"the right tell of its lens.</p>{_pairs(by_radius)}"
        "<h2>The same against the range</h2><p>Differences that grow to the left tell of baselines, of a bias of the "
        f"range, or of both.</p>{_pairs(by_range)}"
    )


def verification_json(sightings: Sightings, rows: Sequence[CameraRow]) -> str:
    """Table and every single difference, as JSON."""
    document = {
        "format": "cairn-verification",
        "version": 1,
        "rig": sightings.rig.name,
        "rig_sha256": sightings.rig.digest(),
        "range_camera": sightings.source,
        "method": sightings.method,
        "images": sightings.images,
        "targets": sightings.targets,
        "left_out": sightings.left_out,
        "cameras": [row.to_json() for row in rows],
        "sights": [_entry(sight) for sight in sightings.sights],
    }
    return json.dumps(document, indent=1) + "\n"


def _entry(sight: Sight) -> dict[str, object]:
    return {
        "image": sight.image,
        "camera": sight.camera,
        "source_px": sight.source_px.tolist(),
        "radius_px": sight.radius_px,
        "range_m": sight.range_m,
        "predicted_px": sight.predicted_px.tolist(),
        "found_px": sight.found_px.tolist(),
        "sigma_px": {name: share.tolist() for name, share in sight.shares_px.items()},
    }


def _pairs(plots: Sequence[str]) -> str:
    return f'<div class="pair">{"".join(f"<figure>{plot}</figure>" for plot in plots)}</div>'


def _left_out(sightings: Sightings) -> str:
    if not sightings.left_out:
        return ""
    reasons = "; ".join(f"{count} {escape(reason)}" for reason, count in sorted(sightings.left_out.items()))
    return f"<p>Left out: {reasons}.</p>"
