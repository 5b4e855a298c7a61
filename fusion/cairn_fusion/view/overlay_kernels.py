"""Ink of a map over a live image: visible surfaces solid, hidden ones in stripes, those on the map alone in dots.

Ink is colours multiplied by their cover, and the cover, all 0 to 255.
"""

import numba as nb
import numpy as np
import numpy.typing as npt

from cairn_map.arrays import Rgb

Covers = npt.NDArray[np.float32]
NOTHING, VISIBLE, SEE_THROUGH, MAP_ONLY = 0, 1, 2, 3
STRIPE_PX, STRIPES_PX = 3, 8
"""Width of a stripe, and the distance from one to the next."""
DOT_PX, DOTS_PX = 2, 4
"""Edge of a dot, and the distance from one to the next."""
VISIBLE_COVER, DOT_COVER, BETWEEN_COVER = 0.55, 0.85, 0.25
"""Covers of a visible surface, of a dot, and of the space between dots."""


@nb.njit(cache=True, nogil=True)
def ink_into(
    front: Rgb, front_covers: Covers, modes: Rgb, rest: Rgb, rest_covers: Covers, rest_modes: Rgb, step: int, ink: Rgb
) -> None:
    """(H, W, 4) ink of visible surfaces, and of the rest, which is known for `step` x `step` pixels at a time.

    Args:
        front: (H, W, 3) colours of visible surfaces, or of the map alone where it was looked up for this pixel.
        front_covers: (H, W) factors of its cover; 0 where there is neither.
        modes: (H, W) VISIBLE, MAP_ONLY or NOTHING.
        rest: (h, w, 3) colours of hidden surfaces, or of the map alone.
        rest_covers: (h, w) its cover; of the map alone, the factor of it.
        rest_modes: (h, w) SEE_THROUGH, MAP_ONLY or NOTHING.
        step: pixels along each edge that share one entry of `rest`.
        ink: takes the result.
    """
    H, W = modes.shape
    for y in range(H):
        for x in range(W):
            row, column = y // step, x // step
            # Stage 1: the visible surface.
            cover = np.float32(0)
            red, green, blue = front[y, x, 0], front[y, x, 1], front[y, x, 2]
            if modes[y, x] == VISIBLE:
                cover = front_covers[y, x] * np.float32(VISIBLE_COVER)
            # Stage 2: stripes go over it; dots only where the pixel has nothing else.
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
            # Stage 3: colours multiplied by their cover, rounded.
            ink[y, x, 0] = int(red * cover + np.float32(0.5))
            ink[y, x, 1] = int(green * cover + np.float32(0.5))
            ink[y, x, 2] = int(blue * cover + np.float32(0.5))
            ink[y, x, 3] = int(255 * cover + np.float32(0.5))


@nb.njit(cache=True, nogil=True)
def hatch_into(solid: Rgb, behind: Rgb, is_live: npt.NDArray[np.bool_], ink: Rgb) -> None:
    """(H, W, 4) ink of two layers that were blurred; the hatches stay sharp, or hidden things would look visible.

    Args:
        solid: (H, W, 4) ink of visible surfaces.
        behind: (H, W, 4) ink of the rest, without hatches.
        is_live: (H, W) true where there is a live depth: stripes, else dots.
        ink: takes the result.
    """
    H, W = is_live.shape
    for y in range(H):
        for x in range(W):
            if is_live[y, x]:
                share = np.float32(1 if (x + y) % STRIPES_PX < STRIPE_PX else 0)
            else:
                is_dot = (x % DOTS_PX < DOT_PX) & (y % DOTS_PX < DOT_PX)
                share = np.float32(DOT_COVER if is_dot else BETWEEN_COVER)
            # The hatches lie over the solid layer.
            left = np.float32(1) - share * behind[y, x, 3] / np.float32(255)
            for c in range(4):
                ink[y, x, c] = int(share * behind[y, x, c] + left * solid[y, x, c] + np.float32(0.5))
