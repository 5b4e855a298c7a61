"""How far the centroid of a disc's image lies from the image of its centre.

A tilted disc's nearer half is larger, and a lens bends it: the centroid, which is what can be measured, is not where
the centre is seen. Heikkila gives a closed form for a pinhole; here the rim is projected through the whole lens and
the centroid of that polygon taken, which holds for any.
"""

import numpy as np

from cairn_calib.rig.lens import Lens
from cairn_map.arrays import Floats

RIM_POINTS = 48
"""Of a regular polygon, whose centroid is the disc's; only its foreshortening and bending err, by 1 / 48^2 of them."""


def disc_shift(lens: Lens, p_camera: Floats, R_camera_board: Floats, radius_m: float) -> Floats:
    """(V, N, 2) pixels from the images of centres to the centroids of the discs' images.

    Args:
        lens: the camera.
        p_camera: (V, N, 3) centres, metres.
        R_camera_board: (V, 3, 3) of the boards they lie on, whose z is the discs' axis.
        radius_m: of the discs.

    Returns:
        Centroid minus centre; NaN where the lens cannot see all of a disc.
    """
    angle = np.linspace(0, 2 * np.pi, RIM_POINTS, endpoint=False)
    rim = radius_m * np.stack([np.cos(angle), np.sin(angle)], axis=1) @ np.swapaxes(R_camera_board[..., :2], 1, 2)
    # About the centre's image, so that nothing large cancels.
    at = lens.project(p_camera[:, :, None] + rim[:, None]) - lens.project(p_camera)[:, :, None]
    after = np.roll(at, -1, axis=2)
    cross = at[..., 0] * after[..., 1] - after[..., 0] * at[..., 1]
    weighted = ((at + after) * cross[..., None]).sum(axis=2)
    return np.asarray(weighted / (3 * cross.sum(axis=2)[..., None]))
