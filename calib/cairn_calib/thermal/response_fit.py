"""Fit of a thermal camera's response to two or more black bodies of known temperature, with its covariance.

`planck` with fewer than four references finds R and O, for B is the band's (8 to 14 um: 1428 K, for which 5 % is
kept as uncertain); with four or more B too. `polynomial` finds a line of two references, a parabola of three or more.
Each reference weighs by the uncertainty of its temperature and counts; where references disagree by more than that, the
covariance grows accordingly (Birge 1932), and chi2 shows it.

A warm camera sees its own lens and housing, too. Where the references state its temperature, and that varied by more
than `HOUSING_SPAN_K`, the counts that it adds a kelvin are found with the rest: U = U(T) + h (T_housing - mean).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from cairn_calib.rig.radiometry import Housing, PlanckResponse, PolynomialResponse, Radiometry
from cairn_map.arrays import Floats
from cairn_map.errors import BadInputError

Law = Literal["planck", "polynomial"]

BAND_K = 1428.0
"""B of the band 8 to 14 um, as in FLIR's own files: they have 1374 to 1507."""
BAND_SHARE = 0.05
"""Standard deviation of other cameras' B from it, share of B."""
MARGIN_SHARE = 0.05
"""Share of the references' span by which a response holds beyond them."""
HOUSING_SPAN_K = 2.0
"""Span of the housings' temperatures, kelvin, below which their effect is not estimated."""
HOUSING_SHARE = 0.1
"""Share of the housings' span by which their effect holds beyond it."""
STEPS = 50
SETTLED = 1e-10
"""Gauss-Newton steps, at most, and the last one's length in standard deviations."""


@dataclass(frozen=True, slots=True)
class Reference:
    """One black body: its temperature, and the camera's counts of it."""

    kelvin: float
    sigma_k: float
    """Standard deviation of the temperature, independent of the other references'."""
    counts: float
    sigma_counts: float
    housing_k: float | None = None
    """Temperature of the camera itself; None where unknown."""


@dataclass(frozen=True, slots=True)
class ResponseFit:
    """Fitted response, with its residuals at the references."""

    radiometry: Radiometry
    residuals_k: Floats
    """(N,) the response's temperature minus the reference's."""
    chi2: float
    degrees_of_freedom: int


def fit_response(references: Sequence[Reference], *, law: Law, source: str, noise_counts: float = 0.0) -> ResponseFit:
    """Response that meets references best.

    Raises:
        BadInputError: fewer than two temperatures, a sigma that is not above 0, or counts that do not rise with them.
    """
    # Check: finite, two temperatures, counts that rise with them.
    rows = sorted(references, key=lambda each: each.kelvin)
    table = np.array([(r.kelvin, r.sigma_k, r.counts, r.sigma_counts) for r in rows]).reshape(-1, 4)
    T, sigma_k, U, sigma_u = table.T
    if not (np.isfinite(table).all() and (sigma_k > 0).all() and (sigma_u >= 0).all() and (T > 0).all()):
        raise BadInputError("bad_references", "a reference needs a temperature, and a standard deviation above 0 K")
    if len(set(T)) < 2:
        raise BadInputError("bad_references", "a response needs references of two temperatures or more")
    if np.polyfit(T, U, 1)[0] <= 0:
        raise BadInputError("bad_references", "the counts fall where the references get warmer")
    # Fit the law, with the housing's effect h where the references show it.
    warmth = _housing_excess(rows)
    response: PlanckResponse | PolynomialResponse
    if law == "planck":
        response, h, covariance, free = _planck(T, sigma_k, U, sigma_u, warmth)
    else:
        response, h, covariance, free = _polynomial(T, sigma_k, U, sigma_u, warmth)
    # chi2 of the residuals; where it exceeds its degrees of freedom, the covariance grows by their ratio (Birge).
    U = U - h * warmth
    residuals = response.kelvin_of(U) - T
    sigma = np.hypot(sigma_k, sigma_u / response.slope(T))
    chi2, freedom = float(np.sum((residuals / sigma) ** 2)), len(T) - free
    covariance *= max(1.0, chi2 / freedom) if freedom > 0 else 1.0
    # The response holds a little beyond its references, no further.
    margin = MARGIN_SHARE * (T[-1] - T[0])
    fitted = Radiometry(
        response=response,
        range_k=(float(T[0] - margin), float(T[-1] + margin)),
        covariance_lower=tuple(tuple(map(float, row[: n + 1])) for n, row in enumerate(covariance[:3])),
        noise_counts=noise_counts,
        housing=_housing(rows, h, covariance[3]) if warmth.any() else None,
        source=source,
    )
    return ResponseFit(fitted, residuals, chi2, freedom)


def _housing_excess(rows: Sequence[Reference]) -> Floats:
    """(N,) kelvin by which the camera was warmer than on average; zeros where that is unknown or too little."""
    warm = np.array([np.nan if row.housing_k is None else row.housing_k for row in rows])
    if (
        len(rows) <= min(3, len({row.kelvin for row in rows}))
        or not np.isfinite(warm).all()
        or np.ptp(warm) < HOUSING_SPAN_K
    ):
        return np.zeros(len(rows))
    about = warm - warm.mean()
    # Where the camera warmed up in step with the black body, their effects cannot be separated.
    line = np.polynomial.Polynomial.fit([row.kelvin for row in rows], about, 1)
    apart = about - line(np.array([row.kelvin for row in rows]))
    return np.asarray(about) if np.ptp(apart) > HOUSING_SPAN_K else np.zeros(len(rows))


def _housing(rows: Sequence[Reference], h: float, covariance_row: Floats) -> Housing:
    warm = np.array([row.housing_k for row in rows], np.float64)
    margin = HOUSING_SHARE * float(np.ptp(warm))
    r, b, o, own = (float(v) for v in covariance_row)
    return Housing(
        at_k=float(warm.mean()),
        counts_per_k=h,
        covariance_row=(r, b, o, own),
        range_k=(float(warm.min()) - margin, float(warm.max()) + margin),
        spread_k=float(warm.std()),
    )


def _planck(
    T: Floats, sigma_k: Floats, U: Floats, sigma_u: Floats, warmth: Floats
) -> tuple[PlanckResponse, float, Floats, int]:
    """Gauss-Newton in (R, B, O, h); B near the band's unless four temperatures fix it, h 0 without warmth."""
    fits_b, warm = len(set(T)) >= 4, bool(warmth.any())
    # Start: with the band's B the law is linear in R and O.
    p = np.array([0.0, BAND_K, 0.0, 0.0])
    light = 1 / np.expm1(BAND_K / T)
    p[0], p[2] = np.polyfit(light, U, 1)
    prior, normal, scale = np.zeros((4, 4)), np.eye(4), np.ones(4)
    if not fits_b:
        prior[1, 1] = 1 / (BAND_SHARE * BAND_K) ** 2
    if not warm:
        prior[3, 3] = 1.0
    for _ in range(STEPS):
        at = PlanckResponse.model_construct(r=p[0], b_k=p[1], f=1.0, o=p[2])
        # Errors of temperatures count as errors of counts, by the law's slope.
        weight = 1 / (sigma_u**2 + (at.slope(T) * sigma_k) ** 2)
        J = np.column_stack([at.by_parameters(T), warmth])
        # Scaled, for R is 1e5 and more, and light 1e-2 and less.
        normal = (J * weight[:, None]).T @ J + prior
        scale = 1 / np.sqrt(np.diag(normal))
        right = (J * weight[:, None]).T @ (U - at.counts_of(T) - p[3] * warmth) - prior @ (p - [0, BAND_K, 0, 0])
        step = scale * np.linalg.solve(normal * scale * scale[:, None], scale * right)
        p = p + step
        if not (np.isfinite(p).all() and p[0] > 0 and p[1] > 0):
            raise BadInputError("bad_references", "no Planck response meets the references: try law polynomial")
        if (np.abs(step * np.sqrt(np.diag(normal))) < SETTLED).all():
            break
    covariance = scale[:, None] * np.linalg.inv(normal * scale * scale[:, None]) * scale
    found = PlanckResponse(r=float(p[0]), b_k=float(p[1]), o=float(p[2]))
    return found, float(p[3]), covariance, (3 if fits_b else 2) + warm


def _polynomial(
    T: Floats, sigma_k: Floats, U: Floats, sigma_u: Floats, warmth: Floats
) -> tuple[PolynomialResponse, float, Floats, int]:
    # Counts in units near 1, so that the powers are of one size.
    at, per = float((U[0] + U[-1]) / 2), float((U[-1] - U[0]) / 2)
    free, warm, h = min(3, len(set(T))), bool(warmth.any()), 0.0
    slope = np.full(len(T), (T[-1] - T[0]) / (2 * per))
    c, normal = np.zeros(3), np.eye(free + warm)
    for _ in range(STEPS if warm else 3):
        v = (U - h * warmth - at) / per
        # Counts that the housing adds are taken off before the parabola, so they bend with its slope.
        terms = np.column_stack([v[:, None] ** np.arange(free), *([-slope * warmth] if warm else [])])
        weight = 1 / (sigma_k**2 + (slope * sigma_u) ** 2)
        normal = (terms * weight[:, None]).T @ terms
        found = np.linalg.solve(normal, (terms * weight[:, None]).T @ T)
        c = np.zeros(3)
        c[:free] = found[:free]
        h += float(found[free]) if warm else 0.0
        slope = (c[1] + 2 * c[2] * v) / per
    # Rows of numbers that were not free, and of h without warmth, stay 0.
    at_all = [*range(free), *([3] if warm else [])]
    covariance = np.zeros((4, 4))
    covariance[np.ix_(at_all, at_all)] = np.linalg.inv(normal)
    if c[1] <= 0:
        raise BadInputError("bad_references", "no rising parabola meets the references")
    return PolynomialResponse(c0=c[0], c1=c[1], c2=c[2], at_counts=at, per_counts=per), h, covariance, free + warm
