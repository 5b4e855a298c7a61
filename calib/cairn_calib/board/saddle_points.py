"""Saddle points: places where an image looks like the corner of a chessboard, with four even quarters.

    -det(Hessian) of the smoothed image -> its maxima -> a ring of samples about each -> saddles with two directions

On the ring a corner is bright, dark, bright, dark, and the same after half a turn: of its Fourier terms the second is
strong and the odd ones are weak. Ends of lines, corners of windows and texture are not like that.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from cairn_map.arrays import Floats

Image = npt.NDArray[np.float32]

SMOOTH_PX = 1.5
"""Standard deviation of the Gaussian before the Hessian, pixels."""
RING_PX = 3.5
"""Radius of the ring of samples, pixels: less than half a cell of 8; smaller cells need an enlarged image."""
RING = 16
"""Samples on the ring."""
APART_PX = 2
"""Distance, pixels, within which only the highest of several maxima counts."""
MAXIMA_MAX, SADDLES_MAX = 2500, 400
"""Maxima that are checked, and saddles that are kept, the strongest first."""
STRENGTH_SHARE_MIN = 0.06
"""Strength of a saddle over the strongest one's, at least: weaker ones are noise, or hidden in it."""
SECOND_SHARE_MIN = 0.45
"""Share of the second Fourier term in the ring's variance: 0.81 at right angles, 0.5 at 40 degrees."""
ODD_SHARE_MAX = 0.25
"""Share of the odd Fourier terms in the ring's variance, at most: 0 for a pattern that half a turn maps to itself."""


@dataclass(frozen=True, slots=True)
class SaddlePoints:
    """N places, the strongest first."""

    pixels: Floats
    """(N, 2) x, y."""
    edges: Floats
    """(N, 2, 2) unit vectors along the two edges that cross; each may point either way."""
    bright: Floats
    """(N, 2) unit vector into the bright quarters, either way."""
    strength: Floats
    """(N,) curvature, in the image's contrast a pixel squared."""


def saddle_points(image: Image) -> SaddlePoints:
    """The saddles of an (H, W) float32 image whose contrast is about 1."""
    smooth = np.asarray(cv2.GaussianBlur(image, (0, 0), SMOOTH_PX), np.float32)
    # Second derivatives: Sobel's 3 x 3 kernels weigh by 4.
    xx, yy, xy = (
        np.asarray(cv2.Sobel(smooth, cv2.CV_32F, i, j, ksize=3), np.float32) / 4 for i, j in ((2, 0), (0, 2), (1, 1))
    )
    # Local maxima of -det(Hessian), away from the border, the strongest first.
    response = np.maximum(xy * xy - xx * yy, 0)
    peak = np.asarray(cv2.dilate(response, np.ones((2 * APART_PX + 1, 2 * APART_PX + 1), np.uint8)))
    margin = int(np.ceil(RING_PX))
    highest = (response == peak) & (response > 0)
    highest[:margin] = highest[-margin:] = False
    highest[:, :margin] = highest[:, -margin:] = False
    y, x = np.nonzero(highest)
    order = np.argsort(-response[y, x], kind="stable")[:MAXIMA_MAX]
    y, x = y[order], x[order]
    # Those whose ring looks like a corner's, and that are not much weaker than the strongest.
    sound = _ring_is_corner(smooth, x, y)
    y, x = y[sound][:SADDLES_MAX], x[sound][:SADDLES_MAX]
    strength = np.sqrt(response[y, x].astype(np.float64))
    strong = strength > STRENGTH_SHARE_MIN * strength.max(initial=0.0)
    y, x, strength = y[strong], x[strong], strength[strong]
    hessian = np.stack([np.stack([xx[y, x], xy[y, x]], -1), np.stack([xy[y, x], yy[y, x]], -1)], -1).astype(np.float64)
    # The directions of edges want more smoothing than the places of corners do.
    wide = [np.asarray(cv2.blur(part, (3, 3)))[y, x].astype(np.float64) for part in (xx, xy, yy)]
    values, vectors = np.linalg.eigh(np.stack(wide, axis=-1)[:, [0, 1, 1, 2]].reshape(-1, 2, 2))
    bright, dark = vectors[..., 1], vectors[..., 0]
    # Along an edge the brightness does not bend: cos^2 of the positive and sin^2 of the negative curvature cancel.
    angle = np.arctan2(np.sqrt(np.maximum(values[:, 1], 1e-12)), np.sqrt(np.maximum(-values[:, 0], 1e-12)))
    along = [np.cos(angle)[:, None] * bright + sign * np.sin(angle)[:, None] * dark for sign in (1, -1)]
    return SaddlePoints(_between_pixels(smooth, x, y, hessian), np.stack(along, axis=1), bright, strength)


def _ring_is_corner(smooth: Image, x: npt.NDArray[np.intp], y: npt.NDArray[np.intp]) -> npt.NDArray[np.bool_]:
    """(N,) True for each place whose ring is bright, dark, bright, dark: see the head of this module."""
    angle = np.arange(RING) * 2 * np.pi / RING
    at_x = (x[:, None] + RING_PX * np.cos(angle)).astype(np.float32)
    at_y = (y[:, None] + RING_PX * np.sin(angle)).astype(np.float32)
    if not len(x):
        return np.zeros(0, bool)
    ring = np.asarray(cv2.remap(smooth, at_x, at_y, cv2.INTER_LINEAR))
    power = np.abs(np.fft.rfft(ring, axis=1)) ** 2
    # A real signal's highest term stands for one frequency, all others for two.
    power[:, RING // 2] /= 2
    total = np.maximum(power[:, 1:].sum(axis=1), 1e-20)
    return np.asarray((power[:, 2] / total > SECOND_SHARE_MIN) & (power[:, 1::2].sum(axis=1) / total < ODD_SHARE_MAX))


def _between_pixels(smooth: Image, x: npt.NDArray[np.intp], y: npt.NDArray[np.intp], hessian: Floats) -> Floats:
    """(N, 2) places at which the gradient vanishes, by one Newton step of at most a pixel."""
    by_x = (smooth[y, x + 1].astype(np.float64) - smooth[y, x - 1]) / 2
    by_y = (smooth[y + 1, x].astype(np.float64) - smooth[y - 1, x]) / 2
    gradient = np.stack([by_x, by_y], axis=-1)
    step = -np.linalg.solve(hessian + 1e-9 * np.eye(2), gradient[..., None])[..., 0] if len(x) else gradient
    return np.stack([x, y], axis=-1) + np.clip(step, -1, 1)
