"""Live depth for a camera that has none of its own: that of the rig's range camera, as the other camera would see it.

Each range pixel covers as many of the camera's as lie between it and its neighbours; where several do, the nearest
counts. It is for the eye, and for telling what hides what; it never becomes evidence.
"""

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from cairn_calib.poses import inverse, transform_points
from cairn_calib.rig import Rig
from cairn_fusion.range_labels import range_labels
from cairn_fusion.scan import Scan
from cairn_fusion.transfer import Label, points_from_range

Values = npt.NDArray[np.float32]
COVER = 1.5
"""Width of what a range pixel covers, over the distance to the next one: slanted surfaces are sampled more widely."""


def live_range(scan: Scan, rig: Rig, *, camera: str, beyond: npt.NDArray[np.bool_] | None = None) -> Values:
    """(H, W) float32, metres along the rays of a camera; NaN where the range camera says nothing.

    Nor does it where too much light came back or two surfaces are mixed (`range_labels`), or where it shows what is in
    a mirror: `beyond`, (H, W) of the range camera, from `beyond_pixels`.

    Raises:
        BadInputError: kind `unknown_camera`, or images of another size.
    """
    seen_by, source = rig[camera], rig[scan.range_camera]
    untrusted = np.isin(range_labels(scan, rig), (Label.SATURATED, Label.FLYING))
    if beyond is not None:
        untrusted |= beyond
    scan = replace(scan, range_m=np.where(untrusted, np.float32(np.nan), scan.range_m))
    true_m = source.true_ranges(scan.range_m, scan.amplitude)
    if camera == scan.range_camera:
        return np.asarray(true_m, np.float32)
    points = points_from_range(true_m, source.camera).reshape(-1, 3)
    points = transform_points(inverse(seen_by.transform) @ source.transform, points[~np.isnan(points[:, 0])])
    pixels = seen_by.camera.project(points)
    inside = seen_by.camera.contains(pixels)
    x, y = np.rint(pixels[inside]).astype(np.int64).T
    range_m = np.linalg.norm(points[inside], axis=1).astype(np.float32)
    gap_px = _pixel_rad(source.camera.rays()) / _pixel_rad(seen_by.camera.rays())
    reach = int(COVER * max(gap_px, 1.0) / 2)
    H, W = seen_by.camera.height, seen_by.camera.width
    nearest = np.full((H + 2 * reach, W + 2 * reach), np.inf, np.float32)
    sparse = np.full(nearest.shape, np.inf, np.float32)
    np.minimum.at(sparse, (y + reach, x + reach), range_m)
    nearest = _nearest_around(_nearest_around(sparse, reach, axis=0), reach, axis=1)[
        reach : reach + H, reach : reach + W
    ]
    return np.where(np.isinf(nearest), np.float32(np.nan), nearest)


def _nearest_around(values: Values, reach: int, *, axis: int) -> Values:
    """The least within so many pixels along an axis; the image has as wide a margin."""
    least = values.copy()
    for shift in range(1, reach + 1):
        for step in (-shift, shift):
            np.minimum(least, np.roll(values, step, axis=axis), out=least)
    return least


def _pixel_rad(rays: npt.NDArray[np.float64]) -> float:
    """Angle between neighbouring pixels in the middle of an image."""
    row = rays[rays.shape[0] // 2]
    middle = len(row) // 2
    return float(np.linalg.norm(row[middle] - row[middle - 1]))
