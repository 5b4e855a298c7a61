"""Live depth for a camera that has none of its own: that of the rig's range camera, as the other camera would see it.

Each range pixel covers as many of the camera's as lie between it and its neighbours; where several do, the nearest
counts. It is for the eye, and for telling what hides what; it never becomes evidence.
"""

import numpy as np
import numpy.typing as npt

from cairn_calib.rig.poses import inverse
from cairn_calib.rig.rig import Rig
from cairn_fusion.image_fusion.range_labels import range_labels
from cairn_fusion.image_fusion.surface import beams, places
from cairn_fusion.image_fusion.surface_kernels import draw_squares_into
from cairn_fusion.recording.scan import Scan
from cairn_fusion.transfer.transfer import Label

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
    labels = range_labels(scan, rig)
    trusted = (labels != Label.SATURATED) & (labels != Label.FLYING)
    if beyond is not None:
        trusted &= ~beyond
    true_m = source.true_ranges(scan.range_m, scan.amplitude)
    range_m = np.where(trusted, true_m, np.float32(np.nan)).astype(np.float32, copy=False)
    if camera == scan.range_camera:
        return range_m
    at = places(range_m, beams(source.camera), seen_by.camera, inverse(seen_by.transform) @ source.transform)
    u, v, q = (each.astype(np.float64) for each in at)
    gap_px = _pixel_rad(source.camera.rays()) / _pixel_rad(seen_by.camera.rays())
    half_px = int(COVER * max(gap_px, 1.0) / 2) + 0.5
    nearness = np.zeros((seen_by.camera.height, seen_by.camera.width), np.float32)
    draw_squares_into(nearness, trusted, u, v, q, half_px)
    with np.errstate(divide="ignore"):
        return np.where(nearness > 0, 1 / nearness, np.float32(np.nan))


def _pixel_rad(rays: npt.NDArray[np.float64]) -> float:
    """Angle between neighbouring pixels in the middle of an image."""
    row = rays[rays.shape[0] // 2]
    middle = len(row) // 2
    return float(np.linalg.norm(row[middle] - row[middle - 1]))
