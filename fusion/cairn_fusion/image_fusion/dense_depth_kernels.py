"""Coarse depth to a camera's own raster, with the picture as a guide: the loop of `eye_depth`."""

import math

import numba as nb
import numpy as np

from cairn_map.arrays import Bytes, Singles

NOTHING, MEASURED, FILLED = 0, 1, 2
"""`eye_depth.Origin`."""
REACH = 3
"""How far around a place is looked, drawn pixels."""
STEP_SHARE = 0.05
"""A window whose depths differ by more, as a share, shows two surfaces; what lies between them is on neither."""
SATURATED = 4


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
    """Fill rows `first` to `last` - 1 of (H, W) ranges and origins.

    Between four drawn pixels of one surface 1 / range is interpolated. Else the drawn pixels around vote: each with its
    trust, how close it is, and how alike its colour is; only the stronger of two surfaces has a say in the range. The
    nearer of two, and one alone, is not carried farther than `near_px`: too far out it would be painted
    with what is not there, whereas what goes too far behind something is found to be hidden. A range pixel is how far:
    the next one, had it been on the surface, would have said so, and up to there nobody knows where the surface ends.

    Args:
        range_m: (H, W) takes metres; NaN where nothing is known.
        origins: (H, W) takes `Origin`.
        picture: (H, W, 3) what the camera sees.
        nearness: (h, w) 1 / metres as drawn; 0 where nothing is known.
        marks: (h, w) why nothing is known; where too much light returned nothing is filled in.
        trust: (h, w) weight of a drawn pixel.
        coarse: (h, w, 3) the picture, as coarse as the drawing.
        alike: (3 * 256,) weight by the sum of the three differences of colour.
        close: (2 REACH + 2, 2 REACH + 2) weight by place, of rows and columns from the first that is looked at.
        near_px: how far a range pixel is from the next, drawn pixels; counted from each pixel's own place.
        step_px: pixels along a drawn one.
        first: row.
        last: row.
    """
    f = np.float32
    rows, columns = nearness.shape
    middle_px, share = 0.5 * (step_px - 1), f(1.0 / step_px)
    voters = (2 * REACH + 2) ** 2
    qs, weights, colours = np.empty(voters, np.float32), np.empty(voters, np.float32), np.empty((voters, 3), np.int32)
    downs, rights, near_square = np.empty(voters, np.float32), np.empty(voters, np.float32), f(near_px * near_px)
    # Pixels between the same four drawn ones, of which those beyond the border are the border's.
    for i in range(-1, rows):
        y0, y1 = max(first, math.ceil(i * step_px + middle_px)), min(last, math.ceil((i + 1) * step_px + middle_px))
        i0, i1 = max(i, 0), min(i + 1, rows - 1)
        for j in range(-1, columns if y0 < y1 else -1):
            x0 = max(0, math.ceil(j * step_px + middle_px))
            x1 = min(range_m.shape[1], math.ceil((j + 1) * step_px + middle_px))
            j0, j1 = max(j, 0), min(j + 1, columns - 1)
            q00, q01, q10, q11 = nearness[i0, j0], nearness[i0, j1], nearness[i1, j0], nearness[i1, j1]
            least, most = min(min(q00, q01), min(q10, q11)), max(max(q00, q01), max(q10, q11))
            if least > f(0.0) and most <= least * f(1.0 + STEP_SHARE):
                for y in range(y0, y1):
                    b = f(y - i * step_px - middle_px) * share
                    left, right = q00 + b * (q10 - q00), q01 + b * (q11 - q01)
                    for x in range(x0, x1):
                        a = f(x - j * step_px - middle_px) * share
                        range_m[y, x] = f(1.0) / (left + a * (right - left))
                        origins[y, x] = MEASURED
                continue
            count, least, most = 0, f(np.inf), f(0.0)
            for k in range(max(i - REACH, 0), min(i + 1 + REACH, rows - 1) + 1):
                for m in range(max(j - REACH, 0), min(j + 1 + REACH, columns - 1) + 1):
                    q = nearness[k, m]
                    if q > f(0.0):
                        qs[count], weights[count] = q, trust[k, m] * close[k - i + REACH, m - j + REACH]
                        downs[count], rights[count] = k - i, m - j
                        # Signed: bytes would wrap round.
                        for c in range(3):
                            colours[count, c] = np.int32(coarse[k, m, c])
                        least, most = min(least, q), max(most, q)
                        count += 1
            full = marks[i0, j0] == SATURATED or marks[i0, j1] == SATURATED
            full = full or marks[i1, j0] == SATURATED or marks[i1, j1] == SATURATED
            if count == 0 or full:
                range_m[y0:y1, x0:x1] = np.nan
                origins[y0:y1, x0:x1] = NOTHING
                continue
            origins[y0:y1, x0:x1] = FILLED
            is_one = most <= least * f(1.0 + STEP_SHARE)
            middle = f(0.0) if is_one else f(0.5) * (least + most)
            for y in range(y0, y1):
                b = f(y - i * step_px - middle_px) * share
                for x in range(x0, x1):
                    a = f(x - j * step_px - middle_px) * share
                    red, green, blue = (
                        np.int32(picture[y, x, 0]),
                        np.int32(picture[y, x, 1]),
                        np.int32(picture[y, x, 2]),
                    )
                    near, near_sum, far, far_sum = f(0.0), f(0.0), f(0.0), f(0.0)
                    for n in range(count):
                        if qs[n] > middle and (downs[n] - b) ** 2 + (rights[n] - a) ** 2 > near_square:
                            continue
                        other = abs(colours[n, 0] - red) + abs(colours[n, 1] - green) + abs(colours[n, 2] - blue)
                        weight = weights[n] * alike[other]
                        if qs[n] > middle:
                            near += weight
                            near_sum += weight * qs[n]
                        else:
                            far += weight
                            far_sum += weight * qs[n]
                    if near >= far and near > f(0.0):
                        range_m[y, x] = near / near_sum
                    elif far > f(0.0):
                        range_m[y, x] = far / far_sum
                    else:
                        range_m[y, x], origins[y, x] = np.nan, NOTHING
