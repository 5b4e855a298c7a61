"""Maps between planes: how a flat board's points lie in an image without distortion."""

import numpy as np

from cairn_map.arrays import Floats


def fit_homography(plane: Floats, pixels: Floats) -> Floats | None:
    """The (3, 3) homography from (N, 2) places on a plane to (N, 2) pixels, N >= 4, by the normalised linear method.

    Hartley and Zisserman, algorithm 4.2. None where the points do not determine it.
    """
    if len(plane) < 4:
        return None
    from_plane, from_pixels = _normaliser(plane), _normaliser(pixels)
    a, b = mapped(from_plane, plane), mapped(from_pixels, pixels)
    one, none = np.ones(len(a)), np.zeros((len(a), 3))
    p = np.column_stack([a, one])
    rows = np.concatenate([np.hstack([p, none, -b[:, :1] * p]), np.hstack([none, p, -b[:, 1:] * p])])
    values, vectors = np.linalg.eigh(rows.T @ rows)
    if values[1] < 1e-9 * values[-1]:
        return None
    homography = np.linalg.inv(from_pixels) @ vectors[:, 0].reshape(3, 3) @ from_plane
    if (homography[2] @ np.append(plane.mean(axis=0), 1)) < 0:
        homography = -homography
    return np.asarray(homography)


def mapped(homography: Floats, points: Floats) -> Floats:
    """(..., 2) points through a homography; NaN where they go to infinity or behind."""
    out = points @ homography[:, :2].T + homography[:, 2]
    depth = np.where(out[..., 2:] > 1e-12, out[..., 2:], np.nan)
    return np.asarray(out[..., :2] / depth)


def steps_between(homography: Floats, plane: Floats) -> Floats:
    """(N, 2, 2) pixels: how far the image goes for one unit along x, and along y, at (N, 2) places of the plane."""
    half = 0.5 * np.eye(2)
    return np.stack([mapped(homography, plane + h) - mapped(homography, plane - h) for h in half], axis=1)


def _normaliser(points: Floats) -> Floats:
    centre = points.mean(axis=0)
    scale = 1 / max(float(np.sqrt(((points - centre) ** 2).sum(axis=1).mean() / 2)), 1e-12)
    return np.array([[scale, 0, -scale * centre[0]], [0, scale, -scale * centre[1]], [0, 0, 1.0]])
