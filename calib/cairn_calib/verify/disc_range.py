"""How far a circle target is from a range camera: a robust plane over all pixels of its middle that have a range.

The tape on its rim returns too much light and has none; the matt black middle has. On a plane with the vector n,
n . X = 1, a beam along the unit vector b ends at the range d with 1 / d = n . b. That is linear in n, also for a lens
that distorts. Where few pixels are left, a weak prior says that the target faces the camera.

Noise of the pixels falls with their number; what all of them share does not: the relief of the target, and what is not
known of the camera's range bias.
"""

import numpy as np
import numpy.typing as npt

from cairn_calib.rig.rig import MountedCamera
from cairn_calib.verify.disc_images import Disc

PIXELS_MIN = 3
SLANT_SIGMA = 0.6
"""Of the tangent of the target's tilt: 31 degrees."""
RELIEF_SIGMA_M = 0.0012
"""Of what is not in the plane: paper, aluminium and tape lie on one another, and light mixes at their edges. On
simulated targets, half a millimetre apart, ranges come out 1.2 mm too long whatever the number of pixels."""
ROUNDS = 10
TUKEY = 4.685
"""Robust standard deviations beyond which a pixel counts for nothing."""


def disc_range(disc: Disc, range_m: npt.NDArray[np.floating], mounted: MountedCamera) -> tuple[float, float] | None:
    """Range along the beam through a target's centroid, and its standard deviation, metres; None without a range.

    Args:
        disc: found in the camera's amplitude.
        range_m: (H, W), metres along the beam; NaN where nothing came back.
        mounted: the range camera.
    """
    x, y = disc.pixels.T
    d = np.asarray(range_m, np.float64)[y, x]
    seen = np.isfinite(d)
    if seen.sum() < PIXELS_MIN:
        return None
    d = d[seen]
    beams = mounted.camera.unproject(disc.pixels[seen].astype(np.float64))
    axis = mounted.camera.unproject(disc.centroid)
    sideways = np.linalg.svd(axis[None])[2][1:]
    terms = beams @ np.vstack([axis, sideways]).T
    sigma = np.maximum(mounted.range_noise_m(d), 1e-6) / d**2
    middle = float(np.median(1 / d))
    prior = np.diag([0.0, 1.0, 1.0]) / (SLANT_SIGMA * middle) ** 2
    weight = np.ones(len(d))
    n, normal = np.array([middle, 0.0, 0.0]), prior
    for _ in range(ROUNDS):
        left = (1 / d - terms @ n) / sigma
        spread = max(1.0, 1.4826 * float(np.median(np.abs(left - np.median(left)))))
        weight = np.maximum(0, 1 - (left / (TUKEY * spread)) ** 2) ** 2 / (sigma * spread) ** 2
        if (weight > 0).sum() < PIXELS_MIN:
            return None
        normal = (terms * weight[:, None]).T @ terms + prior
        n = np.linalg.solve(normal, (terms * weight[:, None]).T @ (1 / d))
    distance = float(1 / n[0])
    if not distance > 0:
        return None
    noise = distance**2 * float(np.sqrt(np.linalg.inv(normal)[0, 0]))
    bias = 0.0 if mounted.range_bias is None else float(mounted.range_bias.sigma_at(np.array(distance)))
    return distance, float(np.linalg.norm([noise, bias, RELIEF_SIGMA_M]))
