"""Cross view: one camera's values on another camera's pixels, thermal on colour or colour on thermal, through range.

    pixel of the one --its depth--> point --Eq. 5-6--> pixel of the other --occlusion--> value, or the reason for none

This is for viewing, on every pixel of an image. The map's samples go the other way, from the range camera's own pixels
(`transfer`, `samples`). Several cameras may see the same spectrum: the second may see points hidden from the first.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from cairn_calib.rig.poses import inverse
from cairn_calib.rig.rig import MountedCamera, Rig
from cairn_fusion.image_fusion.cross_view_kernels import fill_into, label_into, sample_into
from cairn_fusion.image_fusion.dense_depth import DenseDepth, Origin
from cairn_fusion.image_fusion.dense_depth_kernels import STEP_SHARE
from cairn_fusion.image_fusion.row_bands import run_in_bands
from cairn_fusion.image_fusion.surface import JOIN_SIGMAS, Drawn, beams, places
from cairn_fusion.transfer.covariance_grid import CovarianceGrid
from cairn_fusion.transfer.transfer import Label
from cairn_map.arrays import Labels, Singles

HIDDEN_BEHIND = 0.03
"""Relative depth behind a surface beyond which it hides a point, besides slant and `JOIN_SIGMAS` of noise."""


@dataclass(frozen=True, slots=True, eq=False)
class CrossView:
    """Values of other cameras on the pixels of one camera."""

    camera: str
    """Camera with the pixels."""
    sources: tuple[str, ...]
    """Cameras with the values, in order of priority."""
    values: Singles
    """(H, W, C); NaN where the label is not OK."""
    labels: Labels
    """(H, W) `Label`; where no source has a value, the reason of the first one."""
    source: Labels
    """(H, W) number of the source of the value, in `sources`."""
    depth: DenseDepth
    """Depth through which the values were found."""

    @property
    def ok(self) -> npt.NDArray[np.bool_]:
        """(H, W) true for pixels with a value."""
        return np.asarray(self.labels == Label.OK)


def cross_view(
    depth: DenseDepth,
    rig: Rig,
    images: Mapping[str, npt.NDArray[np.generic]],
    *,
    drawn: Mapping[str, Drawn],
    range_camera: str,
) -> CrossView:
    """Values of other cameras at the pixels of one camera, through their depth.

    Args:
        depth: of the pixels of the camera.
        rig: with all cameras.
        images: by camera, in order of priority: (H, W) or (H, W, C); NaN for no value. Without images no pixel has one.
        drawn: the surface as each of these cameras sees it; a camera without one sees all points.
        range_camera: camera that measured the depth.
    """
    seen = _Seen(rig, depth.camera, range_camera, drawn)
    names, known, rays = tuple(images), _known(depth), beams(rig[depth.camera].camera)
    if not names:
        labels = np.where(known == Label.OK, np.uint8(Label.NO_READING), known)
        return CrossView(
            depth.camera, (), np.full((*known.shape, 1), np.nan, np.float32), labels, np.zeros_like(known), depth
        )
    values, labels = seen.by(names[0], images[names[0]], depth.shown_m, rays, known)
    source = np.zeros(labels.shape, np.uint8)
    for number, name in enumerate(names[1:], 1):
        # The next camera only fills what is missing: few pixels, so that it is quicker to pick them out.
        left = np.flatnonzero((labels.ravel() != Label.OK) & (known.ravel() == Label.OK))
        range_m, picked = depth.shown_m.ravel()[left][None], rays.reshape(3, -1)[:, left][:, None]
        others, other_labels = seen.by(name, images[name], range_m, picked, known.ravel()[left][None])
        fill_into(values, labels, source, left, others[0], other_labels[0], number)
    return CrossView(depth.camera, names, values, labels, source, depth)


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """The rig, and the camera whose pixels are looked up in others."""

    rig: Rig
    camera: str
    range_camera: str
    drawn: Mapping[str, Drawn]

    def by(
        self, name: str, image: npt.NDArray[np.generic], range_m: Singles, rays: Singles, known: Labels
    ) -> tuple[Singles, Labels]:
        """Values (H, W, C) and labels (H, W) of one source, at points `range_m` (H, W) along (3, H, W) rays."""
        # Eq. 1-6, and the source's image averaged over the area of a pixel.
        src, dst = self.rig[self.camera], self.rig[name]
        u, v, q = places(range_m, rays, dst.camera, inverse(dst.transform) @ src.transform)
        smooth = _smoothed(image, dst.camera.focal_px[0] / src.camera.focal_px[0])
        labels, values = known.copy(), np.full((*known.shape, smooth.shape[2]), np.nan, np.float32)
        # Without parallax nothing can hide anything.
        apart = float(np.linalg.norm(src.transform[:3, 3] - dst.transform[:3, 3])) > 1e-9
        # One bin of nearness 0 that covers the image: nothing is behind it.
        least, step = np.zeros((1, 1), np.float32), 1 << 20
        if (drawn := self.drawn.get(name)) is not None and apart:
            least, step = _least_nearness(drawn, self.rig[self.range_camera]), drawn.step_px
        width, height = dst.camera.width, dst.camera.height

        def look(first: int, last: int) -> None:
            rows = slice(first, last)
            label_into(labels[rows], u[rows], v[rows], q[rows], least, step, width, height)
            sample_into(values[rows], labels[rows], u[rows], v[rows], smooth)

        run_in_bands(look, len(known))
        return values, labels


def _known(depth: DenseDepth) -> Labels:
    """(H, W) OK where there is a depth, else the reason for none."""
    height, width = depth.origins.shape
    marks = np.asarray(
        cv2.resize(
            depth.drawn.marks, (0, 0), fx=depth.drawn.step_px, fy=depth.drawn.step_px, interpolation=cv2.INTER_NEAREST
        )
    )[:height, :width]
    return np.where(depth.origins == Origin.NOTHING, marks, np.uint8(Label.OK)).astype(np.uint8)


def _smoothed(image: npt.NDArray[np.generic], ratio: float) -> Singles:
    """(H, W, C) float32, blurred where several of its pixels fall on one of the other camera."""
    side = round(ratio)
    values = np.asarray(image) if side <= 1 else np.asarray(cv2.blur(np.asarray(image, np.float32), (side, side)))
    return np.ascontiguousarray(np.atleast_3d(values), dtype=np.float32)


def _least_nearness(drawn: Drawn, range_camera: MountedCamera) -> Singles:
    """(h, w) 1 / metres: a point with less is behind the surface drawn there; 0 where none is.

    Both ranges have noise, the usual one at the nearer. Without it, a surface would hide itself, the more so the
    farther it is.
    """
    hides = drawn.hiding > 0
    range_m = 1 / np.where(hides, drawn.hiding, np.float32(1.0))
    tolerance = HIDDEN_BEHIND + JOIN_SIGMAS * range_camera.range_sigma_m(range_m) / range_m
    return np.where(hides, drawn.hiding / (1 + tolerance) - drawn.slack, 0.0).astype(np.float32)


def fused_covariance(fused: CrossView, rig: Rig, *, range_camera: str) -> Singles:
    """(H, W, 3) float32 covariance xx, xy, yy, px^2, of the place in its source of each pixel's value; NaN without one.

    Range noise is the range camera's; for filled-in depth it is the largest difference on one surface.

    Args:
        fused: result of `cross_view`.
        rig: its rig; with a calibration's covariance if it has one.
        range_camera: camera that measured the depth.

    Raises:
        BadInputError: a camera is a lidar.
    """
    out = np.full((*fused.labels.shape, 3), np.nan, np.float32)
    range_m = fused.depth.shown_m
    sigma_m = rig[range_camera].range_sigma_m(range_m).astype(np.float32)
    sigma_m = np.where(fused.depth.origins == Origin.FILLED, STEP_SHARE * range_m, sigma_m)
    for number, name in enumerate(fused.sources):
        y, x = np.nonzero(fused.ok & (fused.source == number))
        certainty = CovarianceGrid.of(rig, src=fused.camera, dst=name)
        out[y, x] = certainty.at(np.stack([x, y], axis=1), range_m[y, x], sigma_m[y, x])
    return out
