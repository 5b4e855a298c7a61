"""Places where a picture looks like the corner of a chessboard: saddles of brightness with four quiet quarters.

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
RING_PX = 3.5
"""Less than half a cell of 8 pixels; smaller cells are looked for in an enlarged image."""
RING = 16
APART_PX = 2
"""Of two maxima this near only the higher one counts."""
MAXIMA = 2500
KEPT = 400
WEAK = 0.06
"""Of the strongest: what is weaker is noise, or hidden in it."""
SECOND_MIN = 0.45
"""Share of the second Fourier term in the ring's variance: 0.81 at right angles, 0.5 at 40 degrees."""
ODD_MAX = 0.25


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
    xx, yy, xy = (
        np.asarray(cv2.Sobel(smooth, cv2.CV_32F, i, j, ksize=3), np.float32) / 4 for i, j in ((2, 0), (0, 2), (1, 1))
    )
    response = np.maximum(xy * xy - xx * yy, 0)
    peak = np.asarray(cv2.dilate(response, np.ones((2 * APART_PX + 1, 2 * APART_PX + 1), np.uint8)))
    margin = int(np.ceil(RING_PX))
    highest = (response == peak) & (response > 0)
    highest[:margin] = highest[-margin:] = False
    highest[:, :margin] = highest[:, -margin:] = False
    y, x = np.nonzero(highest)
    order = np.argsort(-response[y, x], kind="stable")[:MAXIMA]
    y, x = y[order], x[order]
    sound = _ring_is_corner(smooth, x, y)
    y, x = y[sound][:KEPT], x[sound][:KEPT]
    strength = np.sqrt(response[y, x].astype(np.float64))
    strong = strength > WEAK * strength.max(initial=0.0)
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
    angle = np.arange(RING) * 2 * np.pi / RING
    at_x = (x[:, None] + RING_PX * np.cos(angle)).astype(np.float32)
    at_y = (y[:, None] + RING_PX * np.sin(angle)).astype(np.float32)
    if not len(x):
        return np.zeros(0, bool)
    ring = np.asarray(cv2.remap(smooth, at_x, at_y, cv2.INTER_LINEAR))
    power = np.abs(np.fft.rfft(ring, axis=1)) ** 2
    power[:, RING // 2] /= 2
    total = np.maximum(power[:, 1:].sum(axis=1), 1e-20)
    return np.asarray((power[:, 2] / total > SECOND_MIN) & (power[:, 1::2].sum(axis=1) / total < ODD_MAX))


def _between_pixels(smooth: Image, x: npt.NDArray[np.intp], y: npt.NDArray[np.intp], hessian: Floats) -> Floats:
    """Where the gradient vanishes, by one Newton step of at most a pixel."""
    by_x = (smooth[y, x + 1].astype(np.float64) - smooth[y, x - 1]) / 2
    by_y = (smooth[y + 1, x].astype(np.float64) - smooth[y - 1, x]) / 2
    gradient = np.stack([by_x, by_y], axis=-1)
    step = -np.linalg.solve(hessian + 1e-9 * np.eye(2), gradient[..., None])[..., 0] if len(x) else gradient
    return np.stack([x, y], axis=-1) + np.clip(step, -1, 1)
