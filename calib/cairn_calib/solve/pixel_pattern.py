r"""Range offset of each single pixel, by the residuals that a solve leaves on the boards' planes.

    residual of a range = offset of its pixel + noise          offset ~ 0 +- pattern, noise ~ 0 +- noise

    pattern^2 = mean of products of two residuals of one pixel, from two images       (pairs: noise cancels)
    offset    = sum of its n residuals / (n + noise^2 / pattern^2)                    shrunken: BLUP, Henderson 1975
    sigma^2   = pattern^2 noise^2 / (n pattern^2 + noise^2)                           n = 0: offset 0, sigma = pattern

All pixels of all boards count, not only those that the solve was of. Where the pattern is no more than chance makes it,
there is no map: noise would be stored as if it were the camera's. A pixel that is far off every time keeps its offset;
it has no say in the pattern. What varies smoothly over the image is another matter: the boards' places and the corners'
part swallow most of it (of a bump of 10 mm, 25 pixels wide, 1 mm was left). Where blocks of pixels show such a rest,
the solve goes on with a grid of nodes (`range_nodes.py`), whose part of the map is added here.
"""

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from cairn_calib.rig.pixel_offsets import PixelOffsets, pixel_offsets
from cairn_calib.rig.range_terms import NODE_SIGMA_M
from cairn_calib.solve.adjustment import Adjustment
from cairn_calib.solve.board_views import BoardViews
from cairn_calib.solve.range_nodes import image_nodes
from cairn_calib.solve.range_residuals import RangeData, plane_ranges, range_data
from cairn_map.arrays import Floats

Indices = npt.NDArray[np.intp]

FOUND_SIGMAS = 4.0
"""Standard deviations by which the pattern's variance must exceed 0."""
STRAY_SIGMAS = 4.0
"""Standard deviations (noise and pattern) from a pixel's median beyond which a range is left out."""

BLOCK_PX = 16
"""Side of a block of pixels whose mean residual shows what varies smoothly, pixels."""
BLOCK_SHARE = 0.25
"""Share of a block's pixels that one image must show."""


@dataclass(frozen=True, slots=True)
class PixelPattern:
    """Estimate of the pixels' own offsets."""

    pairs: int
    """Number of pairs of residuals of one pixel, from two images."""
    variance_m2: float
    """Variance of the pixels' offsets; chance may make it negative."""
    variance_sigma_m2: float
    """Standard deviation of `variance_m2` by chance alone, were there no pattern."""
    seen_share: float
    """Share of the image's pixels on which a board was."""
    smooth_m: float
    """Standard deviation of the blocks' offsets, metres; 0 where it is no more than chance makes."""
    offsets: PixelOffsets | None
    """Map of the offsets; None where the pattern is no more than chance makes."""

    @property
    def at_most_m(self) -> float:
        """Standard deviation above which a pattern would have been found."""
        return float(np.sqrt(FOUND_SIGMAS * self.variance_sigma_m2))


def pixel_pattern(views: BoardViews, done: Adjustment, covariance: Floats) -> PixelPattern | None:
    """Each pixel's offset, by the residuals of a solve, plus its nodes' part; None without range images in it.

    `covariance` is (P, P), of the solve's shared parameters.
    """
    sensor, state, board = done.problem.sensors[-1], done.state, views.board
    used = sensor.data
    if not isinstance(used, RangeData):
        return None
    # Residuals of all pixels of all boards, not only of those that the solve was of.
    lens = state.lenses[used.camera]
    whole = lens.width * lens.height
    every = range_data(used.camera, views.ranges, views.frames, state, board, sigma_m=used.sigma_m, pixels_max=whole)
    if every is None:
        return None
    every = every.with_terms(used.terms, lens)
    true_m, measured_m = plane_ranges(every, state, board)
    left_m = measured_m - true_m - every.added_m(lens, true_m, state.bias)
    # The pixels' own part, then the nodes'.
    sound = _sound(every, left_m, lens.width, STRAY_SIGMAS * sensor.scale * used.sigma_m)
    found = _pattern_of(sound, (lens.height, lens.width))
    at = done.problem.layout.bias_at[len(used.terms.document_names) :]
    if used.terms.nodes is None:
        return found
    around = image_nodes(lens, used.terms.nodes)
    node_m, among = state.bias[len(used.terms.document_names) :], covariance[np.ix_(at, at)]
    return replace(found, offsets=_with_nodes(found, sound, around.values(node_m), around.variances(among)))


@dataclass(frozen=True, slots=True)
class _Sound:
    """N residuals."""

    views: Indices
    """(N,) image of each residual."""
    pixels: Indices
    """(N,) number of each residual's pixel, row by row."""
    left_m: Floats
    """(N,) residuals, metres."""


def _sound(data: RangeData, left_m: Floats, width: int, stray_m: float) -> _Sound:
    """Residuals, without those far from their pixel's median.

    Those of a pixel with fewer than three are measured from 0: two cannot show which of them is wrong.
    """
    seen = data.measured & np.isfinite(left_m)
    x, y = data.pixels[seen].astype(np.intp).T
    pixels, left, views = y * width + x, left_m[seen], np.nonzero(seen)[0]
    # Sorted by pixel, then by residual, each pixel's median stands in the middle of its run.
    order = np.lexsort((left, pixels))
    pixels, left, views = pixels[order], left[order], views[order]
    _, starts, counts = np.unique(pixels, return_index=True, return_counts=True)
    medians = np.where(counts < 3, 0.0, left[starts + (counts - 1) // 2])
    kept = np.abs(left - np.repeat(medians, counts)) <= stray_m
    return _Sound(views[kept], pixels[kept], left[kept])


def _pattern_of(sound: _Sound, shape: tuple[int, int]) -> PixelPattern:
    size, pixels, left_m = shape[0] * shape[1], sound.pixels, sound.left_m
    counts = np.bincount(pixels, minlength=size)
    sums, squares = (
        np.asarray(np.bincount(pixels, weights=each, minlength=size), np.float64) for each in (left_m, left_m**2)
    )
    total = float(np.mean(left_m**2)) if len(left_m) else 0.0
    # A pixel that is always far off keeps its offset, but has no say in the pattern.
    usual = np.abs(sums) <= STRAY_SIGMAS * np.sqrt(total) * np.maximum(counts, 1)
    pairs, variance, by_chance = _shared_variance(counts[usual], sums[usual], squares[usual])
    smooth_m = _smooth(sound, usual, shape, variance)
    seen_share = float(np.mean(counts > 0))
    if not variance > FOUND_SIGMAS * by_chance:
        return PixelPattern(pairs, variance, by_chance, seen_share, smooth_m, None)
    # Shrunken offsets and their standard deviations, as in the head; noise is what the pattern leaves of the total.
    noise = max(float(np.sum(squares[usual]) / np.sum(counts[usual])) - variance, 1e-3 * total)
    offset_m = sums / (counts + noise / variance)
    sigma_m = np.sqrt(variance * noise / (counts * variance + noise))
    offsets = pixel_offsets(
        offset_m.reshape(shape),
        sigma_m.reshape(shape),
        counts.reshape(shape),
        pattern_sigma_m=float(np.sqrt(variance)),
        noise_sigma_m=float(np.sqrt(noise)),
    )
    return PixelPattern(pairs, variance, by_chance, seen_share, smooth_m, offsets)


def _with_nodes(found: PixelPattern, sound: _Sound, smooth_m: Floats, variance_m2: Floats) -> PixelOffsets:
    """Map of the pixels' own offsets plus (H, W) metres and variances of the nodes."""
    fine = found.offsets
    counts = np.bincount(sound.pixels, minlength=smooth_m.size).reshape(smooth_m.shape)
    # Where no board was, only the prior is known.
    offset_m = np.where(counts > 0, smooth_m, 0.0) + (0.0 if fine is None else fine.offset_m)
    seen_m2 = float(np.mean(smooth_m[counts > 0] ** 2))
    unseen_m2 = max(NODE_SIGMA_M**2, seen_m2)
    sigma_m2 = np.where(counts > 0, variance_m2, unseen_m2) + (0.0 if fine is None else fine.sigma_m**2)
    return pixel_offsets(
        offset_m,
        np.sqrt(sigma_m2),
        counts,
        pattern_sigma_m=float(np.hypot(np.sqrt(seen_m2), 0.0 if fine is None else fine.pattern_sigma_m)),
        noise_sigma_m=float(np.sqrt(np.mean(sound.left_m**2))) if fine is None else fine.noise_sigma_m,
    )


def _shared_variance(counts: Indices, sums: Floats, squares: Floats) -> tuple[int, float, float]:
    """Number of pairs of residuals within groups, the variance that pairs share, and its sigma by chance, m^2.

    `counts`, `sums` and `squares` are the number of each group's residuals, their sum and their sum of squares.
    """
    pairs = int(np.sum(counts * (counts - 1))) // 2
    if pairs == 0:
        return 0, 0.0, 0.0
    # Sum over pairs of r_i r_j = (sum^2 - sum of squares) / 2; products of pure noise scatter by its variance.
    total = float(np.sum(squares) / np.sum(counts))
    return pairs, float(np.sum(sums**2 - squares)) / (2 * pairs), total / float(np.sqrt(pairs))


def _smooth(sound: _Sound, usual: npt.NDArray[np.bool_], shape: tuple[int, int], fine_m2: float) -> float:
    """Standard deviation of the blocks' offsets, by their mean residuals in several images, metres.

    `fine_m2` is the variance of single pixels.
    """
    # Mean residual of each block in each image, where enough of it was seen.
    kept = usual[sound.pixels]
    y, x = np.divmod(sound.pixels[kept], shape[1])
    columns = -(-shape[1] // BLOCK_PX)
    blocks = columns * -(-shape[0] // BLOCK_PX)
    # A number for each block of each image.
    number = sound.views[kept] * blocks + (y // BLOCK_PX) * columns + x // BLOCK_PX
    seen = np.bincount(number)
    means = np.bincount(number, weights=sound.left_m[kept]) / np.maximum(seen, 1)
    whole = np.flatnonzero(seen >= BLOCK_SHARE * BLOCK_PX**2)
    means, block = means[whole], whole % blocks
    sums, squares = (
        np.asarray(np.bincount(block, weights=each, minlength=blocks), np.float64) for each in (means, means**2)
    )
    _, variance, by_chance = _shared_variance(np.bincount(block, minlength=blocks), sums, squares)
    # Offsets of single pixels add a little to their blocks' means: that is no smooth part.
    variance -= max(fine_m2, 0.0) * float(np.mean(1 / seen[whole])) if len(whole) else 0.0
    return float(np.sqrt(variance)) if variance > FOUND_SIGMAS * by_chance else 0.0
