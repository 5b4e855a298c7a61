"""The ink of a map over a live image: the visible solid, what is behind in stripes, what the map alone has in dots.

No checks. Ink is colours multiplied by their cover, and the cover, all 0 to 255.
"""

import numba as nb
import numpy as np
import numpy.typing as npt

from cairn_map.arrays import Rgb

Covers = npt.NDArray[np.float32]
NOTHING, VISIBLE, SEE_THROUGH, MAP_ONLY = 0, 1, 2, 3
STRIPE_PX, STRIPES_PX = 3, 8
"""Width of a stripe, and from one to the next."""
DOT_PX, DOTS_PX = 2, 4
VISIBLE_COVER, DOT_COVER, BETWEEN_COVER = 0.55, 0.85, 0.25


@nb.njit(cache=True, nogil=True)
def ink_into(
    front: Rgb, front_covers: Covers, modes: Rgb, rest: Rgb, rest_covers: Covers, rest_modes: Rgb, step: int, ink: Rgb
) -> None:
    """(H, W, 4) ink of what is visible, and of the rest, which is known for `step` x `step` pixels at a time.

    Args:
        front: (H, W, 3) colours of what is visible, or was looked up for this pixel on the map alone.
        front_covers: (H, W) by which its cover is multiplied; 0 where there is neither.
        modes: (H, W) VISIBLE, MAP_ONLY or NOTHING.
        rest: (h, w, 3) colours of what is behind, or on the map alone.
        rest_covers: (h, w) its cover; on the map alone, by which it is multiplied.
        rest_modes: (h, w) SEE_THROUGH, MAP_ONLY or NOTHING.
        step: see above.
        ink: out.
    """
    H, W = modes.shape
    for y in range(H):
        for x in range(W):
            row, column = y // step, x // step
            cover = np.float32(0)
            red, green, blue = front[y, x, 0], front[y, x, 1], front[y, x, 2]
            if modes[y, x] == VISIBLE:
                cover = front_covers[y, x] * np.float32(VISIBLE_COVER)
            is_stripe = (rest_modes[row, column] == SEE_THROUGH) & ((x + y) % STRIPES_PX < STRIPE_PX)
            if is_stripe | (modes[y, x] == MAP_ONLY):
                if is_stripe | (front_covers[y, x] == 0):
                    red, green, blue = rest[row, column, 0], rest[row, column, 1], rest[row, column, 2]
                    cover = rest_covers[row, column]
                else:
                    cover = front_covers[y, x]
                if not is_stripe:
                    is_dot = (x % DOTS_PX < DOT_PX) & (y % DOTS_PX < DOT_PX)
                    cover *= np.float32(DOT_COVER if is_dot else BETWEEN_COVER)
            ink[y, x, 0] = int(red * cover + np.float32(0.5))
            ink[y, x, 1] = int(green * cover + np.float32(0.5))
            ink[y, x, 2] = int(blue * cover + np.float32(0.5))
            ink[y, x, 3] = int(255 * cover + np.float32(0.5))


@nb.njit(cache=True, nogil=True)
def hatch_into(solid: Rgb, behind: Rgb, is_live: npt.NDArray[np.bool_], ink: Rgb) -> None:
    """(H, W, 4) ink of two layers that were spread: the hatches are not, or what is behind looked as if in front.

    Args:
        solid: (H, W, 4) of what is visible.
        behind: (H, W, 4) of the rest, without hatches.
        is_live: (H, W) whether there is a live depth: stripes, else dots.
        ink: out.
    """
    H, W = is_live.shape
    for y in range(H):
        for x in range(W):
            if is_live[y, x]:
                share = np.float32(1 if (x + y) % STRIPES_PX < STRIPE_PX else 0)
            else:
                is_dot = (x % DOTS_PX < DOT_PX) & (y % DOTS_PX < DOT_PX)
                share = np.float32(DOT_COVER if is_dot else BETWEEN_COVER)
            left = np.float32(1) - share * behind[y, x, 3] / np.float32(255)
            for c in range(4):
                ink[y, x, c] = int(share * behind[y, x, c] + left * solid[y, x, c] + np.float32(0.5))
