r"""Brown's distortion of the normalised image plane, and its inverse by Newton's method.

    (x, y)  --distort-->  (x', y')      five coefficients k1, k2, p1, p2, k3, in OpenCV's order,
    (x, y) <--undistort-- (x', y')      or eight, with the denominator's k4, k5, k6: the rational model

                                                    1 + k1 r^2 + k2 r^4 + k3 r^6
      r'   __              The radial part  r' = r ------------------------------  rises up to a turning point and
      |   /  \                                      1 + k4 r^2 + k5 r^4 + k6 r^6
      |  /    \            may fall again: the model folds the outer scene back over the inner. Only the part
      | /      \           before the fold describes a lens, so a point behind it has no image, and a place in
      +-------------- r    the image that no point before it reaches has no origin. Both are NaN. A zero of the
                           denominator ends the lens as a fold does.

Brown 1971, "Close-range camera calibration"; CONVENTIONS.md has the formulae.
"""

from functools import lru_cache
from typing import Annotated

import numpy as np
from pydantic import AfterValidator, Field

from cairn_map.arrays import Floats

COEFFICIENT_MAX = 1e12
"""Far above any lens's (k3 of a 2 degree one may reach 1e8), far below an overflow."""
Coefficient = Annotated[float, Field(ge=-COEFFICIENT_MAX, le=COEFFICIENT_MAX, allow_inf_nan=False)]


def _fill(given: tuple[float, ...]) -> tuple[float, ...]:
    """Five coefficients, or eight with a denominator: missing ones are 0."""
    return given + (0.0,) * ((5 if len(given) <= 5 else 8) - len(given))


Coefficients = Annotated[tuple[Coefficient, ...], Field(min_length=2, max_length=8), AfterValidator(_fill)]
"""k1, k2[, p1, p2[, k3[, k4, k5, k6]]] as given; five or eight once read. The functions take five or eight."""

RADIUS_MAX = 1e3
"""Largest radius in the plane of a lens that does not fold: 89.9 degrees off the axis."""
BEFORE_POLE = 1 - 1e-6
"""Share of the radius at which the denominator is zero up to which the lens is used."""
TABLE_SIZE = 4096
"""Radii of the table that Newton starts from, 0.5 % apart: two steps later it is exact."""
CHUNK = 1 << 14
"""Points at a time, so that a step stays in the processor's cache: 0.2 s against 0.5 s for 1280 x 960."""
STEPS = 30
STEP_AGAIN = 1e-11
"""Error of the plane above which another step is taken; each step squares the error."""
TOLERANCE = 5e-13
"""Error of the plane, relative beyond 1: 7e-10 px at a focal length of 1300 px. Beyond it, no origin."""
PULL_BACK = 0.98
"""Factor on the radius of a guess that went over the fold."""


def distort(plane: Floats, coefficients: Coefficients) -> Floats:
    """(..., 2) normalised image plane without distortion to the plane with it; NaN beyond the fold."""
    if not any(coefficients):
        return plane
    radius = np.hypot(plane[..., 0], plane[..., 1])
    # Taken out before: far away the polynomial overflows.
    near = np.where((radius < radius_limit(coefficients))[..., None], plane, np.nan)
    x, y = near[..., 0], near[..., 1]
    # The lens may fold inside that radius, too: there the determinant of the Jacobian turns negative.
    unfolded = jacobian(x, y, coefficients)[3] > 0
    return np.where(unfolded[..., None], np.stack(_brown(x, y, coefficients), axis=-1), np.nan)


def undistort(plane: Floats, coefficients: Coefficients) -> Floats:
    """The mirror of `distort`: (..., 2) the plane without distortion; NaN where no point before the fold goes."""
    if not any(coefficients):
        return plane
    flat = plane.reshape(-1, 2)
    result = np.empty_like(flat)
    # Point by point independent, so cut into chunks.
    for start in range(0, len(flat), CHUNK):
        part = slice(start, start + CHUNK)
        result[part, 0], result[part, 1] = _newton(flat[part, 0], flat[part, 1], coefficients)
    return result.reshape(plane.shape)


@lru_cache(maxsize=64)
def radius_limit(coefficients: Coefficients) -> float:
    """The radius at which the radial part first turns, at most RADIUS_MAX.

    There the derivative of r N(s) / D(s), s = r^2, is zero: D (N + 2 s N') - 2 s N D', which is
    1 + 3 k1 s + 5 k2 s^2 + 7 k3 s^3 where D is 1; or D is.
    """
    k1, k2, _, _, k3 = coefficients[:5]
    turn, below = np.array([1.0, 3 * k1, 5 * k2, 7 * k3]), np.array([1.0, *coefficients[5:]])
    if len(below) == 1:
        return first_root(turn, at_most=RADIUS_MAX)
    # Lowest power first, as np.convolve does not mind: 2 s D' begins with 0.
    inner = np.convolve(below, turn) - np.convolve([1.0, k1, k2, k3], 2 * np.arange(4) * below)
    return min(first_root(inner, at_most=RADIUS_MAX), first_root(below, at_most=RADIUS_MAX) * BEFORE_POLE)


def first_root(rising: Floats, *, at_most: float) -> float:
    """The first positive r at which 1 + a r^2 + b r^4 + ... is zero, of its coefficients 1, a, b, ...; or a limit."""
    # In u = 1 / s the polynomial begins with 1 whatever the coefficients; its largest root is the first in s.
    roots = np.roots(rising)
    u = float(np.max(roots.real[roots.imag == 0], initial=0.0))
    return at_most if u * at_most**2 <= 1 else 1 / float(np.sqrt(u))


def jacobian(x: Floats, y: Floats, coefficients: Coefficients) -> tuple[Floats, Floats, Floats, Floats]:
    """dx'/dx, dx'/dy = dy'/dx (Brown's is symmetric), dy'/dy, and the determinant."""
    k1, k2, p1, p2, k3 = coefficients[:5]
    s = x * x + y * y
    radial = _radial(s, coefficients)
    # slope = 2 d(radial) / ds; with a denominator by the quotient rule.
    slope = 2 * (k1 + s * (2 * k2 + s * 3 * k3))
    if len(coefficients) > 5:
        k4, k5, k6 = coefficients[5:]
        slope = (slope - 2 * radial * (k4 + s * (2 * k5 + s * 3 * k6))) / _denominator(s, coefficients)
    # Derivatives of CONVENTIONS.md's formulae, the radial part and then the tangential.
    xx = radial + x * x * slope + 2 * p1 * y + 6 * p2 * x
    xy = x * y * slope + 2 * p1 * x + 2 * p2 * y
    yy = radial + y * y * slope + 6 * p1 * y + 2 * p2 * x
    return xx, xy, yy, xx * yy - xy * xy


def coefficient_gradients(x: Floats, y: Floats, coefficients: Coefficients) -> Floats:
    """(..., 2, 5 or 8) how places of the distorted plane move with each coefficient, in their order."""
    s = x * x + y * y
    # x' and y' are linear in k1 to p2; k4 to k6 stand in the denominator.
    below = np.ones_like(s) if len(coefficients) == 5 else _denominator(s, coefficients)
    rising = np.stack([s, s * s, s * s * s], axis=-1) / below[..., None]
    k1, k2, k3 = (rising[..., n, None] * np.stack([x, y], axis=-1) for n in range(3))
    p1 = np.stack([2 * x * y, s + 2 * y * y], axis=-1)
    p2 = np.stack([s + 2 * x * x, 2 * x * y], axis=-1)
    columns = [k1, k2, p1, p2, k3]
    if len(coefficients) > 5:
        columns += [-_radial(s, coefficients)[..., None] * column for column in (k1, k2, k3)]
    return np.stack(columns, axis=-1)


def _newton(x_to: Floats, y_to: Floats, coefficients: Coefficients) -> tuple[Floats, Floats]:
    """The origins (N,), (N,) of places in the distorted plane.

    The start is the radial part alone, inverted by table: near the answer and before the fold, where a start at
    the place itself may step over it.
    """
    radius_to = np.hypot(x_to, y_to)
    radii, reached = _radial_table(coefficients)
    # The tangential part moves a point by 3 |p| r^2 at most.
    reach = reached[-1] + 3 * np.hypot(coefficients[2], coefficients[3]) * radii[-1] ** 2
    radius_to = np.where(radius_to <= reach, radius_to, np.nan)
    scale = np.interp(radius_to, reached[:-1], radii[:-1]) / np.maximum(radius_to, np.finfo(np.float64).tiny)
    x, y = x_to * scale, y_to * scale
    for _ in range(STEPS):
        x_at, y_at = _brown(x, y, coefficients)
        # Newton: subtract the inverse Jacobian times the error. A guess beyond the fold is pulled back instead.
        x_error, y_error = x_at - x_to, y_at - y_to
        xx, xy, yy, det = jacobian(x, y, coefficients)
        inside = det > 0
        det = np.where(inside, det, 1.0)
        x = np.where(inside, x - (yy * x_error - xy * y_error) / det, x * PULL_BACK)
        y = np.where(inside, y - (xx * y_error - xy * x_error) / det, y * PULL_BACK)
        # Invariant: every guess stays within the radial limit, where the model is a lens.
        radius = np.hypot(x, y)
        over = radius >= radii[-1]
        x[over], y[over] = (v[over] * (PULL_BACK * radii[-1] / radius[over]) for v in (x, y))
        if not np.any(np.abs(x_error) + np.abs(y_error) > STEP_AGAIN):
            break
    x_at, y_at = _brown(x, y, coefficients)
    # A place counts only if its origin maps back to it, before the fold.
    right = np.hypot(x_at - x_to, y_at - y_to) <= TOLERANCE * np.maximum(radius_to, 1)
    found = right & (jacobian(x, y, coefficients)[3] > 0)
    return np.where(found, x, np.nan), np.where(found, y, np.nan)


@lru_cache(maxsize=64)
def _radial_table(coefficients: Coefficients) -> tuple[Floats, Floats]:
    """Rising radii up to the limit, and where the radial part takes them."""
    limit = radius_limit(coefficients)
    radii = np.append(0.0, np.geomspace(1e-9 * limit, limit, TABLE_SIZE))
    return radii, radii * _radial(radii * radii, coefficients)


def _radial(s: Floats, coefficients: Coefficients) -> Floats:
    k1, k2, _, _, k3 = coefficients[:5]
    radial = 1 + s * (k1 + s * (k2 + s * k3))
    return radial if len(coefficients) == 5 else radial / _denominator(s, coefficients)


def _denominator(s: Floats, coefficients: Coefficients) -> Floats:
    k4, k5, k6 = coefficients[5:]
    return 1 + s * (k4 + s * (k5 + s * k6))


def _brown(x: Floats, y: Floats, coefficients: Coefficients) -> tuple[Floats, Floats]:
    p1, p2 = coefficients[2:4]
    # Brown 1971 in OpenCV's form: radial part, then tangential (decentring) part.
    s = x * x + y * y
    radial = _radial(s, coefficients)
    return (
        x * radial + 2 * p1 * x * y + p2 * (s + 2 * x * x),
        y * radial + p1 * (s + 2 * y * y) + 2 * p2 * x * y,
    )
