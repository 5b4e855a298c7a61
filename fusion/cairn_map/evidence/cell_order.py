"""Order in which cells are sent: the most important ones first, because a link may be slow or break soon.

    rings from the robot   0  1  2  3  4  5  6 ...    cells along the farthest axis
    a hot cell counts as   0  1  1  1  1  2  2 ...    a quarter of that, rounded up

So the robot's own surroundings come first, and then a fire counts as much as a bare wall at a quarter of its distance.
No cell waits for hot ones that are more than four times as far, however many there are. Among cells with the same
place in the queue the truly nearer comes first, then the hot one, then the one that changed last; without a robot's
place, hot cells come first, then those that changed last.
"""

import numpy as np
import numpy.typing as npt

from cairn_map.evidence.channels import ChannelKind
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.grid import Cell, Geometry

HOT_ABOVE_K = 10.0
"""Kelvin by which a hot cell's hottest voxel is above the median cell's.

Twice the +-5 K that makers of uncooled thermal cameras state, so that the difference of two cameras on one wall is not
heat. Relative to the median, never more than half of the cells are hot: a fire stands out, a summer's day does not."""
HOT_RINGS = 4
"""Rings of hot cells that count as one ring."""


def hottest_k(evidence: Evidence, geometry: Geometry) -> float | None:
    """Highest mean of a cell's voxels in the first temperature channel, kelvin (apparent); None without samples."""
    channel = next((c for c in geometry.channels if c.kind is ChannelKind.TEMPERATURE), None)
    if channel is None:
        return None
    planes = geometry.planes_of(channel.name)
    sums, weights = evidence.samples[:, planes.start], evidence.samples[:, planes.stop - 1]
    has = weights > 0
    if not has.any():
        return None
    return channel.zero + channel.step * float((sums[has] / weights[has]).max())


def first_to_last(
    cells: npt.NDArray[np.int64],
    *,
    near: Cell | None,
    changed: npt.NDArray[np.int64],
    hottest_k: npt.NDArray[np.float64],
) -> npt.NDArray[np.intp]:
    """Rows of cells in the order in which they are sent, as the module's head explains it.

    Args:
        cells: (N, 3) numbers.
        near: cell of the robot; None: unknown.
        changed: (N,) log entry that last changed each.
        hottest_k: (N,) kelvin; NaN where it has no temperature, or it is unknown.

    Returns:
        (N,) rows of `cells`.
    """
    rings = np.zeros(len(cells), np.int64) if near is None else np.abs(cells - np.array(near)).max(axis=1, initial=0)
    is_hot = _stand_out(hottest_k)
    places = np.where(is_hot, -(-rings // HOT_RINGS), rings)
    return np.lexsort((-changed, ~is_hot, rings, places))


def _stand_out(hottest_k: npt.NDArray[np.float64]) -> npt.NDArray[np.bool_]:
    known = hottest_k[~np.isnan(hottest_k)]
    return hottest_k > (np.median(known) if len(known) else 0.0) + HOT_ABOVE_K
