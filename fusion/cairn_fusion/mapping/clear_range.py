"""How far the beams of a scan are certainly clear: what a sensor's noise, slanted surfaces and edges leave of them.

carved images    nearest neighbour - max(1 voxel, k sigma)      `clear_kernels`: edges and slants widen it
single beams     range - max(1 voxel, k sigma)                  lidars: their neighbours are far apart
silence          `no_return_clears_m`, where the rig states it  else a beam to which nothing came back says nothing
"""

import numpy as np

from cairn_calib.rig.rig import MountedCamera
from cairn_fusion.mapping.beam_returns import Returns
from cairn_fusion.mapping.clear_kernels import nearest_around
from cairn_map.arrays import Floats, Singles

MARGIN_VOXELS = 1.0
"""How far before a surface a voxel's centre must be to be free: a little more than half a voxel's diagonal, 0.87."""


def margins_m(sigma_m: Floats, *, voxel_edge_m: float, noise_sigmas: float) -> Floats:
    """(...) what to keep before a surface whose range has a standard deviation, metres; NaN for NaN."""
    return np.asarray(np.maximum(MARGIN_VOXELS * voxel_edge_m, noise_sigmas * sigma_m))


def clear_image(returns: Returns, mounted: MountedCamera, *, voxel_edge_m: float, noise_sigmas: float) -> Singles:
    """(H, W) how far each pixel of an image without gaps between its pixels is clear, metres; 0 for not known."""
    nearest_m, share = nearest_around(
        np.where(returns.silent, np.float32(np.inf), returns.range_m),
        returns.shield_m,
        returns.silent_m,
        float(max(mounted.camera.focal_px)),
        voxel_edge_m,
    )
    sigma_m = mounted.range_sigma_image(nearest_m)
    kept_m = share * margins_m(sigma_m, voxel_edge_m=voxel_edge_m, noise_sigmas=noise_sigmas).astype(np.float32)
    return np.asarray(np.maximum(nearest_m - kept_m, np.float32(0.0)))
