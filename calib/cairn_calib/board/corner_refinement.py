r"""Sub-pixel refinement of a chessboard's corners, each with its covariance.

      bright | dark        Near a corner the image is two edges that cross. Blurred, it is about
      -------+------       I(p) = mean + contrast * erf(u / sqrt2 s) * erf(v / sqrt2 s)
       dark  | bright      with u, v the distances of p from the two edges and s the blur, in pixels.

The seven numbers (place, two directions, s, mean, contrast) are fitted by Gauss-Newton to the pixels of about one cell,
on the image as recorded: nothing is resampled. The model is symmetric under half a turn about the corner, and so are
the parts that it leaves out (skew, the cells beyond): the place stays unbiased. The covariance of the place is that of
the least-squares fit, with the noise found in the residuals. It is right for noise that is independent from pixel to
pixel; compression and interpolation make it too small, by a factor that a solve finds per camera.
"""

from dataclasses import dataclass, fields

import numpy as np
import numpy.typing as npt

from cairn_map.arrays import Flags, Floats

Image = npt.NDArray[np.float32]
Indices = npt.NDArray[np.intp]

STEPS = 12
"""Gauss-Newton steps, at most."""
RADIUS_PX = (2, 8)
"""Bounds of the window's half width: at least 5 x 5 pixels, and not more than 17 x 17."""
REACH_CELLS = 0.5
"""Half width of the window, cells; beyond, the next corner would be seen."""
REACH_PX = 2.2
"""Half width of the window, pixels, at least, where cells are small; at most REACH_CELLS_MAX."""
REACH_CELLS_MAX = 0.7
BLUR_PX = (0.25, 6.0)
"""Bounds of the blur s, pixels."""
TURN_SIGMA_RAD = 0.15
"""Prior of an edge's direction about that of the grid, standard deviation: only tiny windows feel it."""
BLUR_LOG_SIGMA = 0.7
"""Prior of the blur about 0.8 px, standard deviation of its logarithm."""
BORDER_PX = 3
"""Half width, pixels, below which no window shrinks at the image's border."""
PIXELS_MIN = 12
"""Pixels of a window without which its corner is not fitted."""
UNKNOWNS = 7
"""x, y, direction 1, direction 2, blur, mean, contrast: the columns of `unknown` below."""
POOL_DOF = 40.0
"""Degrees of freedom with which the usual noise of the image's corners counts in that of one."""
SHADING_MIN = 12
"""Corners without which the change of brightness over a board is not estimated."""


@dataclass(frozen=True, slots=True)
class FittedCorners:
    """N corners as fitted; NaN where none could be."""

    pixels: Floats
    """(N, 2) x, y."""
    covariance_px2: Floats
    """(N, 2, 2) pixels squared."""
    contrast: Floats
    """(N,) half the step from dark to bright, counts; positive where the cell to the next column and row is bright."""
    misfit: Floats
    """(N,) root mean square of the residuals, share of the contrast."""
    moved: Floats
    """(N,) how far the corner lies from its guess, cells."""
    blur_px: Floats
    """(N,) standard deviation of the Gaussian that blurs its edges."""

    def reorder(self, order: Indices) -> "FittedCorners":
        """The same corners in another order."""
        return FittedCorners(*(getattr(self, each.name)[order] for each in fields(self)))

    def only(self, kept: Flags) -> "FittedCorners":
        """The same corners, NaN where they are not kept."""
        # Arrays of one, two and three dimensions, each with the corners first.
        values = (getattr(self, each.name) for each in fields(self))
        return FittedCorners(*(np.where(kept.reshape(-1, *[1] * (v.ndim - 1)), v, np.nan) for v in values))


def fit_corners(image: Image, guesses: Floats, steps: Floats) -> FittedCorners:
    """Fit crossing edges at guessed corners.

    Args:
        image: (H, W) float32 counts as recorded, not resampled.
        guesses: (N, 2) pixels x, y, right to about a third of a cell; NaN for none.
        steps: (N, 2, 2) pixels: `[:, 0]` to the next column, `[:, 1]` to the next row.

    Returns:
        The corners, in the order of the guesses.
    """
    # Fit; take the shading from the fitted means; fit again without it.
    first = _fit(image, guesses, steps, np.zeros_like(guesses))
    shading = _shading(first.pixels, first.mean)
    final = _fit(image, np.where(np.isfinite(first.pixels), first.pixels, guesses), steps, shading)
    moved = np.linalg.solve(_columns(steps), np.nan_to_num(final.pixels - guesses)[..., None])[..., 0]
    return FittedCorners(
        pixels=final.pixels,
        covariance_px2=final.inverse * _pool(final.variance, final.dof)[:, None, None],
        contrast=final.contrast,
        misfit=np.sqrt(final.variance) / np.maximum(np.abs(final.contrast), 1e-9),
        moved=np.where(np.isfinite(final.pixels[:, 0]), np.linalg.norm(moved, axis=1), np.nan),
        blur_px=final.blur,
    )


@dataclass(frozen=True, slots=True)
class _Fit:
    pixels: Floats
    inverse: Floats
    variance: Floats
    dof: Floats
    mean: Floats
    contrast: Floats
    blur: Floats


def _fit(image: Image, guesses: Floats, steps: Floats, shading: Floats) -> _Fit:
    """Gauss-Newton fit of all corners at once, each in its own window; `shading` is (N, 2) counts a pixel."""
    # Windows of pixels about the guesses, without shading.
    column, line, weight, usable = _windows(image, guesses, steps)
    values = image[np.clip(line, 0, image.shape[0] - 1), np.clip(column, 0, image.shape[1] - 1)].astype(np.float64)
    x, y = column.astype(np.float64), line.astype(np.float64)
    start = np.where(usable[:, None], guesses, 0.0)
    ramp = shading[:, :1] * (x - start[:, :1]) + shading[:, 1:] * (y - start[:, 1:])
    values = values - ramp
    # Start: edges along the grid, a usual blur, the window's mean.
    count = np.maximum(weight.sum(axis=1), 1)
    angles = np.arctan2(steps[..., 1], steps[..., 0])
    mean = (weight * values).sum(axis=1) / count
    spread = np.sqrt((weight * (values - mean[:, None]) ** 2).sum(axis=1) / count)
    unknown = np.column_stack([start, angles, np.full(len(start), 0.8), mean, np.zeros(len(start))])
    scale = np.maximum(spread, 1e-9)
    # The product of the edges is linear in the contrast: its sign and size need no guess.
    shape = _model(unknown, x, y)[0]
    unknown[:, 6] = (weight * shape * (values - mean[:, None])).sum(axis=1) / np.maximum(
        (weight * shape**2).sum(axis=1), 1e-9
    )
    prior = np.zeros((len(start), UNKNOWNS))
    limit = REACH_CELLS * np.minimum(*(np.linalg.norm(steps[:, k], axis=1) for k in (0, 1)))
    for _ in range(STEPS):
        residual, normal, gradient = _normal(unknown, x, y, values, weight)
        # Counts to the prior's units: a prior worth one pixel whose noise is a tenth of the spread.
        strength = (0.1 * scale) ** 2
        prior[:, 2:4] = (strength / TURN_SIGMA_RAD**2)[:, None]
        prior[:, 4] = strength / (BLUR_LOG_SIGMA * unknown[:, 4]) ** 2
        gradient[:, 2:4] += prior[:, 2:4] * _wrap(angles - unknown[:, 2:4])
        gradient[:, 4] += prior[:, 4] * unknown[:, 4] * np.log(0.8 / unknown[:, 4])
        normal += _ridge(normal, prior, scale)
        step = np.linalg.solve(normal, gradient[..., None])[..., 0]
        # Steps are bounded: half the limit for the place, 0.3 rad for the directions.
        step[:, :2] *= np.minimum(1, limit / np.maximum(2 * np.linalg.norm(step[:, :2], axis=1), 1e-12))[:, None]
        step[:, 2:4] = np.clip(step[:, 2:4], -0.3, 0.3)
        unknown += step
        unknown[:, 4] = np.clip(unknown[:, 4], *BLUR_PX)
        if np.abs(step[usable, :2]).max(initial=0.0) < 1e-4:
            break
    # Residuals and normal matrix at the minimum; a corner that left its surroundings is lost.
    residual, normal, _ = _normal(unknown, x, y, values, weight)
    normal += _ridge(normal, prior, scale)
    dof = np.maximum(count - UNKNOWNS, 1)
    lost = ~usable | (np.linalg.norm(unknown[:, :2] - start, axis=1) > limit)
    unknown[lost] = np.nan
    return _Fit(
        pixels=unknown[:, :2],
        inverse=np.where(lost[:, None, None], np.nan, np.linalg.inv(normal)[:, :2, :2]),
        variance=np.where(lost, np.nan, (weight * residual**2).sum(axis=1) / dof),
        dof=dof,
        mean=unknown[:, 5],
        contrast=unknown[:, 6],
        blur=unknown[:, 4],
    )


def _ridge(normal: Floats, prior: Floats, scale: Floats) -> Floats:
    """(N, 7, 7) on the diagonal: the prior, and just enough that a window without any edge is not singular."""
    own = np.diagonal(normal, axis1=1, axis2=2)
    return np.asarray((prior + 1e-9 * (scale[:, None] ** 2 + own))[..., None] * np.eye(UNKNOWNS))


def _windows(
    image: Image, guesses: Floats, steps: Floats
) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp], Floats, Flags]:
    """(N, K) pixels x and y about each guess, which of them belong to its cells, and (N,) which guesses have enough."""
    lengths = np.linalg.norm(steps, axis=2)
    # One that is not in the image, however far, lacks half of its window.
    sound = ((guesses > -1) & (guesses < image.shape[::-1])).all(axis=1) & (lengths > 1).all(axis=1)
    reach = np.clip(REACH_PX / np.maximum(lengths, 1e-9), REACH_CELLS, REACH_CELLS_MAX)
    wanted = float(np.max(np.where(sound, (reach * lengths).sum(axis=1), 0.0), initial=0.0))
    radius = int(np.clip(np.ceil(wanted), *RADIUS_PX))
    at = np.round(np.where(sound[:, None], guesses, 0)).astype(np.intp)
    dy, dx = (grid.ravel() for grid in np.mgrid[-radius : radius + 1, -radius : radius + 1])
    x, y = at[:, :1] + dx, at[:, 1:] + dy
    away = np.stack([x, y], axis=-1) - np.where(sound[:, None], guesses, 0)[:, None]
    safe = np.where(sound[:, None, None], steps, np.eye(2))
    # (N, K, 2) in cells along columns and rows.
    # In the lattice's own axes a window is a square, however the board is tilted.
    cells = np.linalg.solve(_columns(safe)[:, None], away[..., None])[..., 0]
    inside = (x >= 0) & (y >= 0) & (x < image.shape[1]) & (y < image.shape[0])
    # At the border of the image the window is smaller all round: one that lost a side would pull its corner inwards.
    border = np.minimum(at, np.array(image.shape[::-1]) - 1 - at).min(axis=1)
    limit = np.minimum(radius, np.maximum(border, BORDER_PX))[:, None] + 0.5
    near = (np.abs(cells) < reach[:, None]).all(axis=-1) & (np.hypot(away[..., 0], away[..., 1]) < limit)
    weight = (inside & near).astype(np.float64)
    return x, y, weight, sound & (weight.sum(axis=1) >= np.maximum(PIXELS_MIN, 0.8 * near.sum(axis=1)))


def _columns(steps: Floats) -> Floats:
    """(N, 2, 2) matrices whose columns are the steps, made invertible where they are not."""
    matrix = np.swapaxes(np.nan_to_num(steps), 1, 2)
    flat = np.abs(np.linalg.det(matrix)) < 1e-6
    return np.asarray(np.where(flat[:, None, None], np.eye(2), matrix))


def _model(unknown: Floats, x: Floats, y: Floats) -> tuple[Floats, ...]:
    """(N, K) crossing edges from -1 to 1, and what their gradients are made of."""
    dx, dy = x - unknown[:, :1], y - unknown[:, 1:2]
    sin1, cos1, sin2, cos2 = (f(unknown[:, k : k + 1]) for k in (2, 3) for f in (np.sin, np.cos))
    blur = unknown[:, 4:5]
    # Distances from both edges, and places along them.
    u, v = cos1 * dy - sin1 * dx, sin2 * dx - cos2 * dy
    along_u, along_v = cos1 * dx + sin1 * dy, cos2 * dx + sin2 * dy
    edge_u, slope_u = _edge(u, blur)
    edge_v, slope_v = _edge(v, blur)
    # Chain rule: d(edge_u edge_v) by u and by v, then by place, directions and blur.
    in_u, in_v = slope_u * edge_v, edge_u * slope_v
    by_x = in_u * sin1 - in_v * sin2
    by_y = in_v * cos2 - in_u * cos1
    by_blur = -(in_u * u + in_v * v) / blur
    return edge_u * edge_v, by_x, by_y, -in_u * along_u, in_v * along_v, by_blur


def _normal(unknown: Floats, x: Floats, y: Floats, values: Floats, weight: Floats) -> tuple[Floats, Floats, Floats]:
    """Residuals (N, K), normal matrices (N, 7, 7) and gradients (N, 7) of the fit."""
    shape, *slopes = _model(unknown, x, y)
    contrast = unknown[:, 6:7]
    residual = values - unknown[:, 5:6] - contrast * shape
    jacobian = np.stack([*(contrast * slope for slope in slopes), np.ones_like(shape), shape], axis=-1)
    weighted = np.swapaxes(jacobian * weight[..., None], 1, 2)
    return residual, weighted @ jacobian, (weighted @ residual[..., None])[..., 0]


def _edge(distance: Floats, blur: Floats) -> tuple[Floats, Floats]:
    """erf(distance / sqrt2 blur), and its slope. Abramowitz and Stegun 7.1.26, good to 1.5e-7."""
    z = distance / (np.sqrt(2) * blur)
    size = np.abs(z)
    t = 1 / (1 + 0.3275911 * size)
    bell = np.exp(-size * size)
    tail = t * (0.254829592 + t * (-0.284496736 + t * (1.421413741 + t * (-1.453152027 + t * 1.061405429)))) * bell
    return np.sign(z) * (1 - tail), np.sqrt(2 / np.pi) / blur * bell


def _wrap(angle: Floats) -> Floats:
    return np.asarray((angle + np.pi) % (2 * np.pi) - np.pi)


def _shading(pixels: Floats, mean: Floats) -> Floats:
    """(N, 2) gradient of the mean brightness at each corner, counts a pixel, by a quadric over all of them.

    An uneven light over a board would push corners sideways; over one corner's window it looks like a move.
    """
    # A quadric through the fitted means, twice: the second time without outliers.
    sound = np.isfinite(mean)
    if sound.sum() < SHADING_MIN:
        return np.zeros_like(pixels)
    centre, scale = pixels[sound].mean(axis=0), pixels[sound].std() + 1e-9
    x, y = ((pixels - centre) / scale).T
    one, none = np.ones_like(x), np.zeros_like(x)
    terms = np.stack([one, x, y, x * x, x * y, y * y], axis=-1)
    factors = np.linalg.lstsq(terms[sound], mean[sound], rcond=None)[0]
    off = np.abs(mean - terms @ factors)
    keep = sound & (off <= 4 * np.median(off[sound]) + 1e-9)
    factors = np.linalg.lstsq(terms[keep], mean[keep], rcond=None)[0]
    by_x = np.stack([none, one, none, 2 * x, y, none], axis=-1) @ factors / scale
    by_y = np.stack([none, none, one, none, x, 2 * y], axis=-1) @ factors / scale
    return np.asarray(np.nan_to_num(np.stack([by_x, by_y], axis=-1)))


def _pool(variance: Floats, dof: Floats) -> Floats:
    """(N,) noise of each corner, counts squared: its residuals', pooled with the image's usual noise."""
    sound = np.isfinite(variance)
    usual = float(np.median(variance[sound])) if sound.any() else np.nan
    return np.asarray((dof * variance + POOL_DOF * usual) / (dof + POOL_DOF))
