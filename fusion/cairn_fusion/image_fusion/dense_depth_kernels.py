"""Coarse depth to a camera's own raster, with the picture as a guide: the loops of `dense_depth`.

The picture is worked on in blocks: the pixels between the same four drawn ones. Beyond the border of the drawing its
last row and column stand for the next ones.
"""

import math

import numba as nb
import numpy as np

from cairn_map.arrays import Bytes, Int32s, Singles

Voters = tuple[Singles, Singles, Singles, Singles, Int32s]
"""Drawn pixels around a block: 1 / range, weight, place down and right of the block's first one, and (N, 3) colour."""
Block = tuple[int, int, int, int]
"""Pixels of a block: first row, one past the last, first column, one past the last."""

NOTHING, MEASURED, FILLED = 0, 1, 2
"""Values of `dense_depth.Origin`."""
REACH = 3
"""Reach of the search around a place, drawn pixels."""
STEP_SHARE = 0.05
"""Largest relative difference of depth on one surface; a window with more shows two, with nothing between them."""
SATURATED = 4
"""Value of `transfer.Label`."""


@nb.njit(cache=True, nogil=True, error_model="numpy")
def densify_into(
    range_m: Singles,
    origins: Bytes,
    picture: Bytes,
    nearness: Singles,
    marks: Bytes,
    trust: Singles,
    coarse: Bytes,
    alike: Singles,
    close: Singles,
    near_px: float,
    step_px: int,
    first: int,
    last: int,
) -> None:
    """Fill rows `first` to `last` - 1 of (H, W) ranges and origins: `_interpolate_into`, else `_vote_into`.

    Args:
        range_m: (H, W) takes metres; NaN where nothing is known.
        origins: (H, W) takes `Origin`.
        picture: (H, W, 3) image of the camera.
        nearness: (h, w) 1 / metres as drawn; 0 where nothing is known.
        marks: (h, w) reason for an unknown range; where too much light returned nothing is filled in.
        trust: (h, w) weight of a drawn pixel.
        coarse: (h, w, 3) the picture, as coarse as the drawing.
        alike: (3 * 256,) weight by the sum of the three differences of colour.
        close: (2 REACH + 2, 2 REACH + 2) weight by row and column, counted from the first of the window.
        near_px: distance from a range pixel to the next, drawn pixels; counted from each pixel's own place.
        step_px: pixels along a drawn one.
        first: first row.
        last: one past the last row.
    """
    f = np.float32
    rows, columns = nearness.shape
    # Room for every drawn pixel that may vote in one block.
    middle_px, room = 0.5 * (step_px - 1), (2 * REACH + 2) ** 2
    voters = np.empty(room, f), np.empty(room, f), np.empty(room, f), np.empty(room, f), np.empty((room, 3), np.int32)
    for i in range(-1, rows):
        # The block lies between the centres of drawn rows i and i + 1.
        top = i * step_px + middle_px
        y0, y1 = max(first, math.ceil(top)), min(last, math.ceil(top + step_px))
        i0, i1 = max(i, 0), min(i + 1, rows - 1)
        for j in range(-1, columns if y0 < y1 else -1):
            left = j * step_px + middle_px
            block = y0, y1, max(0, math.ceil(left)), min(range_m.shape[1], math.ceil(left + step_px))
            j0, j1 = max(j, 0), min(j + 1, columns - 1)
            # Four drawn pixels of one surface are interpolated; most blocks end here.
            corners = nearness[i0, j0], nearness[i0, j1], nearness[i1, j0], nearness[i1, j1]
            if _interpolate_into(range_m, origins, corners, block, top, left, step_px):
                continue
            # Elsewhere the drawn pixels around vote, those that have a range; but not where too much light returned.
            count, least, most = _gather_into(voters, nearness, trust, coarse, close, i, j)
            if count == 0 or _is_full(marks, i0, i1, j0, j1):
                range_m[block[0] : block[1], block[2] : block[3]] = np.nan
                origins[block[0] : block[1], block[2] : block[3]] = NOTHING
                continue
            # 1 / range above `middle` is the nearer of two surfaces', or the only one's.
            middle = f(0.0) if most <= least * f(1.0 + STEP_SHARE) else f(0.5) * (least + most)
            limits = middle, f(near_px * near_px)
            _vote_into(range_m, origins, picture, alike, voters, count, limits, block, top, left, step_px)


@nb.njit(forceinline=True, error_model="numpy")
def _interpolate_into(
    range_m: Singles,
    origins: Bytes,
    corners: tuple[float, float, float, float],
    block: Block,
    top: float,
    left: float,
    step_px: int,
) -> bool:
    """Fill a block from its four drawn pixels if they are of one surface; true if so.

    1 / range is linear over the image of a plane, so bilinear interpolation is exact there. `top`, `left` is the place
    of the first drawn pixel.
    """
    f, share = np.float32, np.float32(1.0 / step_px)
    q00, q01, q10, q11 = corners
    # An unknown corner is 0, and fails the test.
    least, most = min(min(q00, q01), min(q10, q11)), max(max(q00, q01), max(q10, q11))
    if not (least > f(0.0) and most <= least * f(1.0 + STEP_SHARE)):
        return False
    y0, y1, x0, x1 = block
    for y in range(y0, y1):
        # Along the left and the right edge first, then between them.
        b = f(y - top) * share
        first, last = q00 + b * (q10 - q00), q01 + b * (q11 - q01)
        for x in range(x0, x1):
            a = f(x - left) * share
            range_m[y, x] = f(1.0) / (first + a * (last - first))
            origins[y, x] = MEASURED
    return True


@nb.njit(forceinline=True)
def _is_full(marks: Bytes, i0: int, i1: int, j0: int, j1: int) -> bool:
    """True if too much light returned at one of a block's corners."""
    full: bool = marks[i0, j0] == SATURATED or marks[i0, j1] == SATURATED
    return full or marks[i1, j0] == SATURATED or marks[i1, j1] == SATURATED


@nb.njit(forceinline=True)
def _gather_into(
    voters: Voters, nearness: Singles, trust: Singles, coarse: Bytes, close: Singles, i: int, j: int
) -> tuple[int, np.float32, np.float32]:
    """Collect the drawn pixels around block (i, j): their number, and their least and largest 1 / range."""
    f = np.float32
    qs, weights, downs, rights, colours = voters
    rows, columns = nearness.shape
    count, least, most = 0, f(np.inf), f(0.0)
    # `REACH` beyond the block's corners on each side, cut at the border.
    for k in range(max(i - REACH, 0), min(i + 1 + REACH, rows - 1) + 1):
        for m in range(max(j - REACH, 0), min(j + 1 + REACH, columns - 1) + 1):
            q = nearness[k, m]
            if q > f(0.0):
                qs[count], weights[count] = q, trust[k, m] * close[k - i + REACH, m - j + REACH]
                downs[count], rights[count] = k - i, m - j
                # Signed: differences of bytes would wrap round.
                for c in range(3):
                    colours[count, c] = np.int32(coarse[k, m, c])
                least, most = min(least, q), max(most, q)
                count += 1
    return count, least, most


@nb.njit(forceinline=True, error_model="numpy")
def _vote_into(
    range_m: Singles,
    origins: Bytes,
    picture: Bytes,
    alike: Singles,
    voters: Voters,
    count: int,
    limits: tuple[np.float32, np.float32],
    block: Block,
    top: float,
    left: float,
    step_px: int,
) -> None:
    """Fill a block by the votes of `count` drawn pixels; NaN and NOTHING where none has a say.

    A vote counts by the drawn pixel's trust and closeness (its weight), and by how alike its colour is; only the
    stronger of two surfaces has a say, so that no range between them comes out. `limits` are the 1 / range above which
    a drawn pixel is of the nearer surface, and the square of that surface's reach, drawn pixels.

    The nearer surface, and one alone, has this reach of one range pixel because, carried farther, it would be painted
    with something that is not there; a surface carried too far behind another is found to be hidden. The next range
    pixel, had it been on the surface, would have said so, and up to there the surface's end is unknown.
    """
    f, share = np.float32, np.float32(1.0 / step_px)
    qs, weights, downs, rights, colours = voters
    middle, near_square = limits
    y0, y1, x0, x1 = block
    for y in range(y0, y1):
        b = f(y - top) * share
        for x in range(x0, x1):
            a = f(x - left) * share
            red, green, blue = np.int32(picture[y, x, 0]), np.int32(picture[y, x, 1]), np.int32(picture[y, x, 2])
            # Of both surfaces, sums of weights, and of weights times 1 / range.
            near, near_sum, far, far_sum = f(0.0), f(0.0), f(0.0), f(0.0)
            for n in range(count):
                if qs[n] > middle and (downs[n] - b) ** 2 + (rights[n] - a) ** 2 > near_square:
                    continue
                # Of an alike colour: probably of the same thing.
                other = abs(colours[n, 0] - red) + abs(colours[n, 1] - green) + abs(colours[n, 2] - blue)
                weight = weights[n] * alike[other]
                if qs[n] > middle:
                    near += weight
                    near_sum += weight * qs[n]
                else:
                    far += weight
                    far_sum += weight * qs[n]
            # The range of the stronger surface: one over its weighted mean of 1 / range.
            origins[y, x] = FILLED
            if near >= far and near > f(0.0):
                range_m[y, x] = near / near_sum
            elif far > f(0.0):
                range_m[y, x] = far / far_sum
            else:
                range_m[y, x], origins[y, x] = np.nan, NOTHING
