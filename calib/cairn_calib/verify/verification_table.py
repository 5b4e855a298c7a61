"""Table 2 of Kocmanova et al.: for each camera sigma_x, sigma_y and sigma of the differences, with further columns.

    sigma = sqrt((sigma_x^2 + sigma_y^2) / 2)

that is one axis, about the mean. Besides: the mean (bias), the count, a 95 % interval of sigma by bootstrap over images
(targets of one image are not independent), and the expected sigma, by source and in total (root mean square, one
axis).
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np

from cairn_calib.verify.verification import Sightings, TargetSighting, source_pixel_in
from cairn_map.arrays import Floats

RESAMPLES = 2000
SOURCES = ("calibration", "centroid", "range")


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraRow:
    """One camera's row of the table; its own pixels."""

    camera: str
    count: int
    sigma_x_px: float
    sigma_y_px: float
    sigma_px: float
    sigma_low_px: float
    """Lower end of the 95 % interval."""
    sigma_high_px: float
    bias_x_px: float
    bias_y_px: float
    rms_px: float
    """Root mean square of the differences, bias included, one axis."""
    expected_px: dict[str, float | None]
    """By source, one axis; None where the rig does not say."""
    total_px: float | None
    """All sources together: what `rms_px` should be."""
    source_pixel_px: float
    """One pixel of the range camera."""

    def to_json(self) -> dict[str, object]:
        """As a JSON object."""
        return asdict(self)


def table_of(sightings: Sightings, *, seed: int = 0) -> list[CameraRow]:
    """A row for each camera that found two targets or more."""
    rows = []
    for camera in sightings.cameras:
        sights = sightings.of_camera(camera)
        if len(sights) >= 2:
            rows.append(_row(sightings, camera, sights, np.random.default_rng(seed)))
    return rows


def _row(sightings: Sightings, camera: str, sights: Sequence[TargetSighting], rng: np.random.Generator) -> CameraRow:
    differences = np.array([sight.difference_px for sight in sights])
    sigma_x, sigma_y = (float(v) for v in differences.std(axis=0, ddof=1))
    low, high = _interval(differences, [sight.image for sight in sights], rng)
    expected: dict[str, float | None] = {}
    for source in SOURCES:
        known = [sight.shares_px[source] for sight in sights if source in sight.shares_px]
        expected[source] = float(np.sqrt(np.mean(np.square(known)))) if len(known) == len(sights) else None
    parts = [part for part in expected.values() if part is not None]
    bias_x, bias_y = (float(v) for v in differences.mean(axis=0))
    return CameraRow(
        camera=camera,
        count=len(sights),
        sigma_x_px=sigma_x,
        sigma_y_px=sigma_y,
        sigma_px=float(np.hypot(sigma_x, sigma_y) / np.sqrt(2)),
        sigma_low_px=low,
        sigma_high_px=high,
        bias_x_px=bias_x,
        bias_y_px=bias_y,
        rms_px=float(np.sqrt(np.mean(differences**2))),
        expected_px=expected,
        total_px=float(np.linalg.norm(parts)) if len(parts) == len(SOURCES) else None,
        source_pixel_px=source_pixel_in(sightings.rig, sightings.source, camera),
    )


def _interval(differences: Floats, images: Sequence[str], rng: np.random.Generator) -> tuple[float, float]:
    """The 2.5 and 97.5 percent quantiles of sigma, images drawn with replacement."""
    names = sorted(set(images))
    number = np.array([names.index(image) for image in images])
    each = np.zeros((len(names), 5))
    np.add.at(each, number, np.column_stack([np.ones(len(number)), differences, differences**2]))
    drawn = each[rng.integers(0, len(names), (RESAMPLES, len(names)))].sum(axis=1)
    n = drawn[:, :1]
    about = drawn[:, 3:] / n - (drawn[:, 1:3] / n) ** 2
    sigma = np.sqrt(np.maximum(about, 0).mean(axis=1) * (n / np.maximum(n - 1, 1))[:, 0])
    low, high = np.quantile(sigma, [0.025, 0.975])
    return float(low), float(high)


def table_text(rows: Sequence[CameraRow]) -> str:
    """The table as lines of text."""
    head = (
        f"{'camera':<14} {'n':>4}  {'sigma_x':>7} {'sigma_y':>7} {'sigma':>7}  {'95 % interval':>13}  "
        f"{'bias x':>6} {'bias y':>6}  {'rms':>5} {'expected':>8} = {'calibr.':>7} {'centroid':>8} {'range':>6}"
    )
    return "\n".join([head, *(_line(row) for row in rows), "", "pixels of each camera, one axis"])


def _line(row: CameraRow) -> str:
    interval = f"{row.sigma_low_px:.2f} to {row.sigma_high_px:.2f}"
    shares = [row.expected_px[source] for source in SOURCES]
    calibration, centroid, range_share = (f"{v:.2f}" if v is not None else "?" for v in shares)
    total = f"{row.total_px:.2f}" if row.total_px is not None else "?"
    return (
        f"{row.camera:<14} {row.count:>4}  {row.sigma_x_px:>7.2f} {row.sigma_y_px:>7.2f} {row.sigma_px:>7.2f}  "
        f"{interval:>13}  {row.bias_x_px:>6.2f} {row.bias_y_px:>6.2f}  {row.rms_px:>5.2f} {total:>8} = "
        f"{calibration:>7} {centroid:>8} {range_share:>6}"
    )
