r"""Outlines of discs, fitted to the grey values along them: sub-pixel centroids of the regions, with covariance.

    value(x) = ground(x) + contrast(x) Phi(-d(x) / s)          d: distance from the outline, s: blur
    outline: centre + shape . (cos t, sin t) (1 + a0 + sum_k a_k cos k t + b_k sin k t),  k = 2, 3, 4

Least squares over the pixels of a band along the outline (Gauss and Newton). A tilted disc is an ellipse (k = 2), a
lens makes an egg of it (k = 3, 4); the terms with k = 1 are the centre itself. What is reported is the centroid of the
region within the outline, which is what `solve/corner_residuals.py` predicts: no plane, homography or lens is assumed
here. Ground and contrast vary as 1, u, v, u^2 - v^2, 2 u v. Where few pixels leave shape, blur or slopes open, priors
hold them; they are symmetric, so they do not move the centre. Pixels far from what the model can be, such as those
beyond the board's rim, have no weight.

The covariance is that of the fit by its own residuals, times the excess of what the residuals move pieces of the
outline by, over what independent noise would: edges that are ragged, or a blur that is not Gaussian, make the centroid
less certain.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from math import erf

import numpy as np
import numpy.typing as npt

from cairn_map.arrays import Flags, Floats

Image = npt.NDArray[np.float32]

HARMONIC_SIGMAS = np.array([0.15, 0.08, 0.08, 0.03, 0.03, 0.02, 0.02])
"""Prior standard deviations of a0, a2, b2, a3, b3, a4, b4, shares of the radius."""
BLUR_PX, BLUR_SIGMA = 0.9, 0.5
"""Prior blur, pixels, before the other discs are known, and the prior standard deviation of its logarithm."""
ROUGH_BLUR = 0.1
"""Blur of a first, rough fit at a predicted place, radii."""
BLURS_PX = (0.3, 30.0)
"""Bounds of the blur: a pixel's own width, and far more than a board that can be used has."""
SLOPE_SIGMA = 0.015
"""Prior standard deviation of the slopes of ground and contrast, shares of the contrast."""
GROUND_SIGMA = 1.0
"""That of the ground's linear terms, which may be steep."""
BAND_BLURS, BAND_PX = 3.0, 0.7
"""Half width of the band along the outline: blurs plus pixels."""
STEPS = 12
"""Steps of a fit, at most."""
SMALL_STEP_PX = 2e-3
"""Movement of the centre after which a fit has come to rest, pixels."""
MOVE_MAX = 0.25
"""Movement of the centre in one step, at most, radii."""
STRAY_SIGMAS, STRAY_SHARE = 6.0, 0.06
"""Residual from which a pixel has no weight: standard deviations, each at least this share of the contrast."""
PIECES = 16
"""Pieces of the outline whose own movement tells how ragged it is."""
RIM = np.linspace(0, 2 * np.pi, 64, endpoint=False)
_LINEAR = 10
"""Linear parameters: ground (5) and contrast (5), after centre (2), harmonics (7) and the logarithm of the blur."""
_ROWS = 512
"""Rows of a product of tall matrices at a time: BLAS starts threads for larger ones, which takes ten times as long."""


@dataclass(frozen=True, slots=True)
class Outline:
    """Closed curve about a disc's image."""

    centre: Floats
    """(2,) pixels."""
    shape: Floats
    """(2, 2) image of the unit circle, pixels."""
    harmonics: Floats
    """(7,) a0, a2, b2, a3, b3, a4, b4, shares of the radius."""
    blur_px: float

    @property
    def radius_px(self) -> float:
        """Radius of the circle of the same area, nearly."""
        return float(np.sqrt(abs(np.linalg.det(self.shape))) * (1 + self.harmonics[0]))

    def rim(self) -> Floats:
        """(64, 2) pixels along the curve."""
        radius = 1 + _RIM_WAVES @ self.harmonics
        return np.asarray(self.centre + (radius[:, None] * _RIM_UNITS) @ self.shape.T)

    def reach_px(self) -> float:
        """Distance from the centre that no point of the curve exceeds, pixels."""
        # The larger singular value of the shape, times the most that harmonics add.
        squares, determinant = float((self.shape**2).sum()), float(np.linalg.det(self.shape))
        largest = np.sqrt((squares + np.sqrt(max(squares**2 - 4 * determinant**2, 0.0))) / 2)
        return float(largest * (1 + np.abs(self.harmonics).sum()))


@dataclass(frozen=True, slots=True)
class DiscFit:
    """One fitted disc."""

    outline: Outline
    centroid: Floats
    """(2,) of the region within the outline, pixels."""
    covariance_px2: Floats
    """(2, 2)"""
    contrast: float
    """Counts from disc to ground; positive for a dark disc."""
    misfit: float
    """Root mean square residual, share of the contrast."""
    contrast_terms: Floats
    """(5,) contrast as a function of the place."""
    frame: tuple[Floats, Floats]
    """Centre and inverse shape in whose units ground and contrast are stated."""
    fourth_variance: Floats
    """(2,) of a4 and b4, the prior being part of it."""


def first_outline(centre: Floats, shape: Floats, blur_px: float = BLUR_PX) -> Outline:
    """The ellipse of a candidate."""
    return Outline(np.asarray(centre, np.float64), np.asarray(shape, np.float64), np.zeros(7), blur_px)


def fit_outlines(dark: Image, outlines: Sequence[Outline | None]) -> list[DiscFit | None]:
    """Discs fitted in an image in which they are darker than their ground; None where there is no outline.

    Each disc is fitted alone, then again without what the blur of its neighbours adds to its ground.
    """
    first = list(fits_alone(dark, outlines))
    again = dict(fits_again(dark, first))
    return [again.get(n) for n in range(len(first))]


def fits_alone(dark: Image, outlines: Sequence[Outline | None]) -> Iterator[DiscFit | None]:
    """The first fits of `fit_outlines`, in order."""
    for own in outlines:
        others = [other for other in outlines if other is not None and other is not own]
        # A blob is mostly near enough; where its edge is too far off, a wide blur sees it.
        yield None if own is None else _fit(dark, own, others, []) or fit_outline(dark, own, others)


def fits_again(dark: Image, first: Sequence[DiscFit | None]) -> Iterator[tuple[int, DiscFit]]:
    """The second fits of `fit_outlines`, each with its index in the first ones: the worst of these first."""
    found = [each for each in first if each is not None]
    if not found:
        return
    # One lens, one blur: the usual one starts the second fit.
    blur = float(np.median([each.outline.blur_px for each in found]))
    centres = np.array([each.outline.centre for each in found])
    reaches = np.array([each.outline.reach_px() for each in found])
    there = [(n, each) for n, each in enumerate(first) if each is not None]
    for index, each in sorted(there, key=lambda pair: -pair[1].misfit):
        # Neighbours whose blur reaches into this band; most are farther off than any outline reaches.
        start = replace(each.outline, blur_px=blur)
        widest, reach = 2 * (BAND_BLURS * blur + BAND_PX), each.outline.reach_px()
        away = np.linalg.norm(centres - each.outline.centre, axis=1)
        near = [
            found[n]
            for n in np.flatnonzero(away < widest + reach + reaches).tolist()
            if found[n] is not each and _gap_px(each, found[n]) < widest
        ]
        yield index, _fit(dark, start, [], near) or each


def fit_outline(dark: Image, start: Outline, others: Sequence[Outline]) -> DiscFit | None:
    """One disc near a predicted outline; None where there is none.

    A wide blur comes first, which sees an edge from afar; pixels that are nearer to other discs do not count.
    """
    wide = ROUGH_BLUR * start.radius_px
    if wide < 1.5 * BLUR_PX:
        return _fit(dark, start, others, [])
    rough = _fit(dark, replace(start, blur_px=wide), others, [])
    if rough is None:
        return _fit(dark, start, others, [])
    return _fit(dark, replace(rough.outline, harmonics=_even(rough.outline.harmonics), blur_px=BLUR_PX), others, [])


def _even(harmonics: Floats) -> Floats:
    """(7,) the radius and the ellipse alone: higher ones of a rough fit are its blur's."""
    return np.concatenate([harmonics[:3], np.zeros(4)])


def _gap_px(one: DiscFit, other: DiscFit) -> float:
    """Distance between two discs along the line of their centres, pixels."""
    way = other.outline.centre - one.outline.centre
    length = float(np.linalg.norm(way))
    reach = sum(
        1 / max(float(np.linalg.norm(np.linalg.solve(each.outline.shape, way / length))), 1e-9) for each in (one, other)
    )
    return length - reach


def _fit(dark: Image, start: Outline, excluding: Sequence[Outline], without: Sequence[DiscFit]) -> DiscFit | None:
    """One disc; None where it is cut by the image's border, or is no disc.

    Args:
        dark: (H, W) image.
        start: where it is searched.
        excluding: outlines nearer to which no pixel counts.
        without: fitted neighbours, whose own share is taken off.
    """
    band = _band(dark, start, excluding, without)
    if band is None:
        return None
    pixels, values = band
    inverse = np.asarray(np.linalg.inv(start.shape), np.float64)
    terms = _surface((pixels - start.centre) @ inverse.T)
    outline, prior_blur = start, float(np.log(start.blur_px))
    # Levels first: linear in ground and contrast, whose places are in units of the start from here on.
    cover = _cover(_distances(outline, pixels)[0] / outline.blur_px)
    flat = np.column_stack([terms[:, :3], cover])
    linear = np.asarray(np.linalg.solve(_gram(flat) + 1e-9 * len(flat) * np.eye(4), flat.T @ values), np.float64)
    contrast = float(-linear[3])
    if contrast <= 0:
        return None
    levels = np.concatenate([linear[:3], np.zeros(2), linear[3:], np.zeros(4)])
    noise = float(np.std(values - flat @ linear)) + 1e-9
    for _ in range(STEPS):
        J, residual = _linearise(outline, levels, pixels, values, terms)
        # Pixels that are neither disc nor its ground, as beyond the board's rim, do not count.
        root = _roots(residual, contrast)
        J, residual = root[:, None] * J, root * residual
        # Normal equations with priors as pseudo-observations.
        weights, expected = _priors(contrast, noise, outline, levels, prior_blur)
        normal = _gram(J) + np.diag(weights)
        step = np.linalg.solve(normal, J.T @ residual + weights * expected)
        # A step may not throw the outline off the disc.
        length = float(np.linalg.norm(inverse @ step[:2]))
        factor = min(1.0, MOVE_MAX / max(length, 1e-12))
        step = step * factor
        outline = Outline(
            outline.centre + step[:2],
            outline.shape,
            np.clip(outline.harmonics + step[2:9], -0.5, 0.5),
            float(np.clip(outline.blur_px * np.exp(np.clip(step[9], -0.5, 0.5)), *BLURS_PX)),
        )
        levels = levels + step[10:]
        contrast = max(float(-levels[5]), 1e-9)
        # Noise by the residuals, from which the priors take their weight.
        noise = float(np.sqrt((residual**2).sum() / max(int((root > 0.5).sum()) - J.shape[1], 1))) + 1e-9
        if factor == 1 and np.linalg.norm(step[:2]) < SMALL_STEP_PX and abs(step[9]) < 0.02:
            break
    # A bright spot, or a neighbour: no disc is here.
    if levels[5] >= 0 or float(np.linalg.norm(inverse @ (outline.centre - start.centre))) > 0.7:
        return None
    return _result(outline, levels, pixels, values, terms, (start.centre, inverse), prior_blur)


def _band(
    dark: Image, start: Outline, excluding: Sequence[Outline], without: Sequence[DiscFit]
) -> tuple[Floats, Floats] | None:
    """Pixels (P, 2) along an outline and their values (P,); None where the image's border cuts it."""
    half = BAND_BLURS * start.blur_px + BAND_PX
    rim = start.rim()
    size = np.array(dark.shape[::-1])
    if (rim < 0.5).any() or (rim > size - 1.5).any():
        return None
    # The window about the outline, and in it what is near the curve.
    low = np.maximum(np.floor(rim.min(axis=0) - half), 0).astype(int)
    high = np.minimum(np.ceil(rim.max(axis=0) + half) + 1, size).astype(int)
    x, y = np.meshgrid(np.arange(low[0], high[0], dtype=np.float64), np.arange(low[1], high[1], dtype=np.float64))
    pixels = np.stack([x.ravel(), y.ravel()], axis=1)
    distance = _distances(start, pixels)[0]
    kept = np.abs(distance) < half
    pixels, distance = pixels[kept], distance[kept]
    # Before the neighbours are fitted each pixel belongs to the nearest outline.
    reach = start.reach_px() if excluding else 0.0
    for other in excluding:
        # No pixel of this band is as near to the other outline.
        if float(np.linalg.norm(other.centre - start.centre)) > reach + other.reach_px() + 2 * half:
            continue
        nearer = _distances(other, pixels)[0] < distance
        pixels, distance = pixels[~nearer], distance[~nearer]
    at = pixels.astype(np.intp)
    values = dark[at[:, 1], at[:, 0]].astype(np.float64)
    # Fitted neighbours: what their blur adds here is taken off, and pixels inside them do not count.
    for fitted in without:
        off = _distances(fitted.outline, pixels)[0]
        outside = off > 0
        pixels, values, off = pixels[outside], values[outside], off[outside]
        centre, inverse = fitted.frame
        level = _surface((pixels - centre) @ inverse.T) @ fitted.contrast_terms
        values = values - level * _cover(off / fitted.outline.blur_px)
    return None if len(values) < 3 * _LINEAR else (pixels, values)


def _waves(angle: Floats) -> Floats:
    """(P, 7) the harmonics at angles."""
    return _waves_of(np.cos(angle), np.sin(angle))


def _waves_of(cosine: Floats, sine: Floats) -> Floats:
    """(P, 7) the harmonics at angles of which cosine and sine are given: 1, cos 2t, sin 2t, ..., sin 4t."""
    waves = np.empty((len(cosine), 7))
    waves[:, 0] = 1
    c, s = cosine, sine
    for column in (1, 3, 5):
        # cos (k + 1) t and sin (k + 1) t by the sum formulae.
        c, s = c * cosine - s * sine, s * cosine + c * sine
        waves[:, column], waves[:, column + 1] = c, s
    return waves


_RIM_UNITS = np.stack([np.cos(RIM), np.sin(RIM)], axis=1)
_RIM_WAVES = _waves(RIM)


def _surface(at: Floats) -> Floats:
    """(P, 5) 1, u, v, u^2 - v^2, 2 u v."""
    u, v = at.T
    return np.stack([np.ones_like(u), u, v, u * u - v * v, 2 * u * v], axis=1)


_ERF_AT = np.linspace(-5, 5, 4001)
_ERF = np.array([erf(x) for x in _ERF_AT])


def _cover(x: Floats) -> Floats:
    """Phi(-x): share of a blurred pixel within the outline at x blurs outside of it."""
    return np.asarray(0.5 - 0.5 * np.interp(x / np.sqrt(2), _ERF_AT, _ERF))


def _distances(outline: Outline, pixels: Floats) -> tuple[Floats, Floats, Floats]:
    """Signed distance (P,) from the outline, to first order; its gradient (P, 2), and waves (P, 7) over the slope."""
    inverse = np.linalg.inv(outline.shape)
    u, v = (inverse @ (pixels - outline.centre).T).reshape(2, -1)
    radius = np.maximum(np.hypot(u, v), 1e-6)
    unit = np.stack([u / radius, v / radius], axis=1)
    waves = _waves_of(unit[:, 0], unit[:, 1])
    # f = |w| - r(angle); its gradient in the image is shape^-T (unit - r' / |w| tangent).
    a2, b2, a3, b3, a4, b4 = outline.harmonics[1:]
    turn = waves @ np.array([0, 2 * b2, -2 * a2, 3 * b3, -3 * a3, 4 * b4, -4 * a4]) / radius
    # Near the centre the angle means nothing, nor does its derivative.
    turn = np.where(radius > 0.3, turn, 0.0)
    gradient = np.stack([unit[:, 0] + turn * unit[:, 1], unit[:, 1] - turn * unit[:, 0]], axis=1) @ inverse
    steep = np.maximum(np.hypot(gradient[:, 0], gradient[:, 1]), 1e-9)
    # To first order the distance is f over the length of its gradient.
    return (radius - 1 - waves @ outline.harmonics) / steep, gradient / steep[:, None], waves / steep[:, None]


def _linearise(
    outline: Outline, levels: Floats, pixels: Floats, values: Floats, terms: Floats
) -> tuple[Floats, Floats]:
    """Derivatives (P, 20) of the model by all parameters, and residuals (P,)."""
    distance, gradient, waves = _distances(outline, pixels)
    x = distance / outline.blur_px
    cover = _cover(x)
    contrast = terms @ levels[5:]
    # d Phi(-d / s) = -phi(d / s) dd / s; the distance shrinks as the centre or the radius comes nearer.
    edge = contrast * np.exp(-0.5 * x * x) / (np.sqrt(2 * np.pi) * outline.blur_px)
    J = np.empty((len(pixels), 20))
    J[:, :2] = edge[:, None] * gradient
    J[:, 2:9] = edge[:, None] * waves
    J[:, 9] = edge * distance
    J[:, 10:15] = terms
    J[:, 15:] = terms * cover[:, None]
    return J, values - terms @ levels[:5] - contrast * cover


def _roots(residual: Floats, contrast: float) -> Floats:
    """(P,) square roots of Tukey's weights: 1 for what the noise explains, 0 for what is far off."""
    sigma = max(float(np.median(np.abs(residual))) / 0.6745, STRAY_SHARE * contrast)
    return np.asarray(np.clip(1 - (residual / (STRAY_SIGMAS * sigma)) ** 2, 0, None))


def _gram(J: Floats) -> Floats:
    """J^T J of a tall matrix."""
    # Filled up with zeros, which add nothing.
    whole = np.zeros((-(-len(J) // _ROWS) * _ROWS, J.shape[1]))
    whole[: len(J)] = J
    parts = whole.reshape(-1, _ROWS, J.shape[1])
    return np.asarray((np.swapaxes(parts, 1, 2) @ parts).sum(axis=0))


def _priors(contrast: float, noise: float, outline: Outline, levels: Floats, blur: float) -> tuple[Floats, Floats]:
    """Weights (20,) of the priors in units of the noise, and how far parameters are from them (20,)."""
    # Centre, mean ground and contrast are free; what is held is held at 0, but for the blur.
    slope, ground = SLOPE_SIGMA * contrast, GROUND_SIGMA * contrast
    open_ = 1e6 * contrast
    sigma = np.concatenate(
        [[1e6, 1e6], HARMONIC_SIGMAS, [BLUR_SIGMA], [open_, ground, ground, slope, slope], [open_], [slope] * 4]
    )
    value = np.concatenate([np.zeros(2), outline.harmonics, [np.log(outline.blur_px) - blur], levels])
    return noise**2 / sigma**2, -np.where(sigma < 1e5 * max(contrast, 1), value, 0.0)


def _result(
    outline: Outline,
    levels: Floats,
    pixels: Floats,
    values: Floats,
    terms: Floats,
    frame: tuple[Floats, Floats],
    prior_blur: float,
) -> DiscFit | None:
    """Centroid and covariance of a fit that has come to rest."""
    J, residual = _linearise(outline, levels, pixels, values, terms)
    contrast = float(-levels[5])
    root = _roots(residual, contrast)
    J, residual = root[:, None] * J, root * residual
    # Priors hold some parameters, which take no freedom from the residuals then.
    seen, squares = int((root > 0.5).sum()), float((residual**2).sum())
    noise, normal = float(np.sqrt(squares / max(seen - J.shape[1], 1))) + 1e-9, _gram(J)
    weights, _ = _priors(contrast, noise, outline, levels, prior_blur)
    taken = float((np.linalg.inv(normal + np.diag(weights)) * normal).sum())
    noise = float(np.sqrt(squares / max(seen - taken, 1))) + 1e-9
    weights, _ = _priors(contrast, noise, outline, levels, prior_blur)
    covariance = noise**2 * np.asarray(np.linalg.inv(normal + np.diag(weights)), np.float64)
    # Ragged edges: more than independent noise.
    covariance *= _raggedness(outline, pixels, J, residual, noise)
    # The centroid moves with the centre, and with the harmonics by how they shift the region.
    shift, *moved = _shifts(outline.shape, outline.harmonics + np.vstack([np.zeros(7), 1e-4 * np.eye(7)]))
    by = np.zeros((2, 20))
    by[:, :2] = np.eye(2)
    by[:, 2:9] = (np.array(moved) - shift).T / 1e-4
    return DiscFit(
        outline,
        outline.centre + shift,
        by @ covariance @ by.T,
        contrast,
        noise / contrast,
        levels[5:],
        frame,
        np.diag(covariance)[7:9],
    )


def _shifts(shape: Floats, harmonics: Floats) -> Floats:
    """(K, 2) from the centre to the centroid of the region of (K, 7) harmonics: of the polygon of its rim."""
    at = ((1 + harmonics @ _RIM_WAVES.T)[..., None] * _RIM_UNITS) @ shape.T
    after = np.roll(at, -1, axis=1)
    # Centroid of a polygon by cross products.
    cross = at[..., 0] * after[..., 1] - after[..., 0] * at[..., 1]
    return np.asarray(((at + after) * cross[..., None]).sum(axis=1) / (3 * cross.sum(axis=1, keepdims=True)))


def _raggedness(outline: Outline, pixels: Floats, J: Floats, residual: Floats, noise: float) -> float:
    """Variance of the pieces' own movements over that of independent noise, at least 1."""
    w = (pixels - outline.centre) @ np.linalg.inv(outline.shape).T
    piece = ((np.arctan2(w[:, 1], w[:, 0]) / (2 * np.pi) + 0.5) * PIECES).astype(np.intp) % PIECES
    # Movement of a piece: least squares of its residuals over the derivative by the radius.
    edge = J[:, 2]
    strength = np.bincount(piece, edge * edge, PIECES)
    moved = np.bincount(piece, edge * residual, PIECES)
    seen: Flags = strength > 0
    chi2 = float((moved[seen] ** 2 / strength[seen]).sum()) / noise**2
    # Nine parameters of the outline took their share.
    return max(1.0, chi2 / max(int(seen.sum()) - 9, 1))
