"""Report of a verification: one HTML file with the paper's Table 2 and Figs 9 to 16, and JSON."""

import json
from collections.abc import Sequence

from cairn_calib.report.charts import scatter_plot
from cairn_calib.report.page import Table, page
from cairn_calib.verify.verification import Sightings, TargetSighting, source_pixel_in
from cairn_calib.verify.verification_table import SOURCES, CameraRow

AXES = ("x", "y")
FIRST_FIGURE = 9
"""Number of the paper's first plot: a camera's x, then its y, then the next camera's."""


HEAD = (
    *("camera", "n", "sigma_x", "sigma_y", "sigma", "95 % interval", "bias x", "bias y", "rms", "expected"),
    *SOURCES,
)


def verification_page(sightings: Sightings, rows: Sequence[CameraRow]) -> str:
    """The whole page."""
    return page(
        "verification.html",
        package="cairn_calib.verify",
        sightings=sightings,
        rig=sightings.rig.name,
        table=camera_table(rows),
        left_out=sorted(sightings.left_out.items()),
        figures=difference_plots(sightings),
    )


def camera_table(rows: Sequence[CameraRow]) -> Table:
    """Table 2 of one calibration."""
    lines = []
    for row in rows:
        shares = [row.total_px, *(row.expected_px[source] for source in SOURCES)]
        lines.append(
            [
                row.camera,
                str(row.count),
                f"{row.sigma_x_px:.2f}",
                f"{row.sigma_y_px:.2f}",
                f"{row.sigma_px:.2f}",
                f"{row.sigma_low_px:.2f} to {row.sigma_high_px:.2f}",
                f"{row.bias_x_px:.2f}",
                f"{row.bias_y_px:.2f}",
                f"{row.rms_px:.2f}",
                *("unknown" if share is None else f"{share:.2f}" for share in shares),
            ]
        )
    return Table(HEAD, lines)


def difference_plots(sightings: Sightings) -> dict[str, object]:
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
    return {"source": sightings.source, "by_radius": by_radius, "by_range": by_range}


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


def _entry(sight: TargetSighting) -> dict[str, object]:
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
