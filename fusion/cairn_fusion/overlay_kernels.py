"""The ink of a map over a live image: the visible solid, what is behind in stripes, what the map alone has in dots.

No checks. Ink is colours multiplied by their cover, and the cover, all 0 to 255.
"""

import numba as nb
import numpy as np
import numpy.typing as npt

Rgb = npt.NDArray[np.uint8]
Covers = npt.NDArray[np.float32]
NOTHING, VISIBLE, SEE_THROUGH, MAP_ONLY = 0, 1, 2, 3
STRIPE_PX, STRIPES_PX = 3, 8
"""Width of a stripe, and from one to the next."""
DOT_PX, DOTS_PX = 2, 4
VISIBLE_COVER, DOT_COVER, BETWEEN_COVER = 0.65, 0.85, 0.25


@nb.njit(cache=True, nogil=True)
def ink_into(
    front: Rgb, front_modes: Rgb, front_covers: Covers, behind: Rgb, covers: Covers, step: int, ink: Rgb
) -> None:
    """(H, W, 4) ink of two layers.

    Args:
        front: (H, W, 3) colours of what the map has in front.
        front_modes: (H, W) VISIBLE, MAP_ONLY or NOTHING.
        front_covers: (H, W) by which its cover is multiplied.
        behind: (h, w, 3) colours of what is behind, one for `step` x `step` pixels.
        covers: (h, w) of what is behind; 0 where nothing is.
        step: see `behind`.
        ink: out.
    """
    H, W = front_modes.shape
    for y in range(H):
        for x in range(W):
            cover = np.float32(0)
            mode = front_modes[y, x]
            if mode == VISIBLE:
                cover = front_covers[y, x] * np.float32(VISIBLE_COVER)
            elif mode == MAP_ONLY:
                is_dot = (x % DOTS_PX < DOT_PX) & (y % DOTS_PX < DOT_PX)
                cover = front_covers[y, x] * np.float32(DOT_COVER if is_dot else BETWEEN_COVER)
            red, green, blue = front[y, x, 0], front[y, x, 1], front[y, x, 2]
            if (x + y) % STRIPES_PX < STRIPE_PX:
                through = covers[y // step, x // step]
                if through > 0:
                    cover = through
                    row, column = y // step, x // step
                    red, green, blue = behind[row, column, 0], behind[row, column, 1], behind[row, column, 2]
            ink[y, x, 0] = int(red * cover + np.float32(0.5))
            ink[y, x, 1] = int(green * cover + np.float32(0.5))
            ink[y, x, 2] = int(blue * cover + np.float32(0.5))
            ink[y, x, 3] = int(255 * cover + np.float32(0.5))
