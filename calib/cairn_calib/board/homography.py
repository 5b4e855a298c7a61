"""Homographies: maps between planes, as from a flat board to an image without distortion."""

import numpy as np

from cairn_map.arrays import Floats


def fit_homography(plane: Floats, pixels: Floats) -> Floats | None:
    """The (3, 3) homography from (N, 2) places on a plane to (N, 2) pixels, N >= 4, by the normalised linear method.

    Hartley and Zisserman, algorithm 4.2. None where the points do not determine it.
    """
    if len(plane) < 4:
        return None
    # Normalise: without it the system's columns differ by the square of an image's width.
    from_plane, from_pixels = _normaliser(plane), _normaliser(pixels)
    a, b = map_points(from_plane, plane), map_points(from_pixels, pixels)
    # Two rows a point: the cross product of its pixel with the mapped place is 0, Hartley and Zisserman, eq. 4.3.
    one, none = np.ones(len(a)), np.zeros((len(a), 3))
    p = np.column_stack([a, one])
    rows = np.concatenate([np.hstack([p, none, -b[:, :1] * p]), np.hstack([none, p, -b[:, 1:] * p])])
    # The solution is the eigenvector of the smallest eigenvalue; two of that size leave it open (points on a line).
    values, vectors = np.linalg.eigh(rows.T @ rows)
    if values[1] < 1e-9 * values[-1]:
        return None
    homography = np.linalg.inv(from_pixels) @ vectors[:, 0].reshape(3, 3) @ from_plane
    # Of both signs, the one that puts the points before the camera.
    if (homography[2] @ np.append(plane.mean(axis=0), 1)) < 0:
        homography = -homography
    return np.asarray(homography)


def map_points(homography: Floats, points: Floats) -> Floats:
    """(..., 2) points through a homography; NaN where they go to infinity or behind."""
    out = points @ homography[:, :2].T + homography[:, 2]
    depth = np.where(out[..., 2:] > 1e-12, out[..., 2:], np.nan)
    return np.asarray(out[..., :2] / depth)


def steps_between(homography: Floats, plane: Floats) -> Floats:
    """(N, 2, 2) steps in the image, pixels, for one unit along x, and along y, at (N, 2) places of the plane."""
    half = 0.5 * np.eye(2)
    return np.stack([map_points(homography, plane + h) - map_points(homography, plane - h) for h in half], axis=1)


def _normaliser(points: Floats) -> Floats:
    """(3, 3) similarity that moves points to their centroid and scales them to a mean distance of about sqrt 2."""
    centre = points.mean(axis=0)
    scale = 1 / max(float(np.sqrt(((points - centre) ** 2).sum(axis=1).mean() / 2)), 1e-12)
    return np.array([[scale, 0, -scale * centre[0]], [0, scale, -scale * centre[1]], [0, 0, 1.0]])
