"""How certain each pixel of a fused image is: the covariance of where in its source the value was taken from."""

import numpy as np

from cairn_calib.rig.rig import Rig
from cairn_fusion.image_fusion.across import Across
from cairn_fusion.image_fusion.eye_depth import Origin
from cairn_fusion.image_fusion.eye_depth_kernels import STEP_SHARE
from cairn_fusion.transfer.place_covariance import PlaceCovariance
from cairn_map.arrays import Singles


def fused_covariance(fused: Across, rig: Rig, *, range_camera: str) -> Singles:
    """(H, W, 3) float32 xx, xy, yy, px^2 of each pixel's source; NaN where the label is not OK.

    Range noise is the range camera's; where depth was filled in, what may differ in a window and still be taken for one
    surface.

    Args:
        fused: of `across`.
        rig: its rig; with a calibration's covariance if it has one.
        range_camera: that measured.

    Raises:
        BadInputError: a camera is a lidar.
    """
    out = np.full((*fused.labels.shape, 3), np.nan, np.float32)
    range_m = fused.depth.shown_m
    sigma_m = rig[range_camera].range_sigma_m(range_m).astype(np.float32)
    sigma_m = np.where(fused.depth.origins == Origin.FILLED, STEP_SHARE * range_m, sigma_m)
    for number, name in enumerate(fused.sources):
        y, x = np.nonzero(fused.ok & (fused.source == number))
        certainty = PlaceCovariance.of(rig, src=fused.camera, dst=name)
        out[y, x] = certainty.at(np.stack([x, y], axis=1), range_m[y, x], sigma_m[y, x])
    return out
