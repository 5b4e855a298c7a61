"""Which cells come first: a link that is slow or breaks soon has carried what matters most by then.

    rings from the robot   0  1  2  3  4  5  6 ...    cells along the farthest axis
    a hot cell counts as   0  1  1  1  1  2  2 ...    a quarter of that, rounded up

So the robot's own surroundings come before all else, and then a fire four times as far away as a bare wall. That is
all that heat buys: no cell waits for hot ones that are more than four times as far, however many there are. In the
same place in the queue the really nearer comes first, then the hot one, then what changed last; without a robot's
place, hot ones come first, then what changed last.
"""

import numpy as np
import numpy.typing as npt

from cairn_map.evidence.channels import ChannelKind
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.grid import Cell, Geometry

HOT_ABOVE_K = 10.0
"""A cell is hot if its hottest voxel is so much above that of the middle one of all cells that have temperatures.

Twice the +-5 K that makers of uncooled thermal cameras state, so that what two cameras make of the same wall is not
hot; and never more than half of the cells are: heat is what stands out, not summer."""
HOT_RINGS = 4
"""Rings of hot cells that count as one."""


def hottest_k(evidence: Evidence, geometry: Geometry) -> float | None:
    """Highest mean of a cell's voxels in the first temperature channel, kelvin (apparent); None: none has samples."""
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
    """The order of cells, as in the module's head.

    Args:
        cells: (N, 3) their numbers.
        near: the cell that the robot is in.
        changed: (N,) log entry that last changed each.
        hottest_k: (N,) kelvin; NaN where it has no temperature, or nobody says.

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
