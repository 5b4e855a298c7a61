"""Tables of the readings of all nodes of a cell's bricks: its voxels, and nodes of 2, 4 and 8 voxels along an edge.

    table [row of the brick, 0 .. 511]    its voxels in Morton order       n = 0
                          [512 .. 575]    its nodes of 2 voxels            n = 1
                          [576 .. 583]    of 4                             n = 2
                          [584]           the brick itself                 n = 3

The mean of a node is that of all samples below it, its probability the highest below it, as in `view`.
"""

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from cairn_map.arrays import Floats, Ints, Words32
from cairn_map.evidence.brick_cell import BrickCell
from cairn_map.evidence.channels import Channel, ChannelKind, class_colours
from cairn_map.evidence.grid import Geometry
from cairn_map.evidence.inverse_sensor_model import SensorModel, known
from cairn_map.evidence.voxels import reading_of_sums
from cairn_map.queries.point_queries import first_of_kind

Table = npt.NDArray[np.float32]
"""(B, 585, planes) float32; NaN where the node has no value."""

NODES = 585
FIRST_OF_NODE = np.array([0, 512, 576, 584], np.int64)
"""By n: index in a brick's row of the first node of 2^n voxels along an edge."""


def probability_table(cell: BrickCell, model: SensorModel) -> Table:
    """Table of the clamped probability, one plane."""
    pool = cell.counts.pool.reshape(-1, 2)
    odds = np.where(known(pool), cell.log_odds(model).reshape(-1), -np.inf)
    highest = _pyramid(odds[:, None], lambda parts: parts.max(axis=2))
    with np.errstate(over="ignore"):  # exp(inf), for unknown nodes
        return np.where(highest > -np.inf, 1 / (1 + np.exp(-highest)), np.nan).astype(np.float32)


def mean_table(cell: BrickCell, channel: Channel, geometry: Geometry) -> Table:
    """Table of the mean of a channel's samples in its unit, one plane; three for colours, and for those of classes."""
    places, samples = cell.samples.packed()
    sums = samples[:, geometry.planes_of(channel.name)]
    if channel.kind is ChannelKind.CLASSES:
        return _class_table(cell, channel, places, sums)
    dense = np.zeros((len(cell.counts.pool) * 512, channel.value_count + 1))
    rows = cell.counts.brick_of[places >> np.uint32(9)].astype(np.int64) * 512 + (places & np.uint32(511))
    dense[rows, :-1], dense[rows, -1] = sums[:, : channel.value_count], sums[:, -1]
    added = _pyramid(dense, lambda parts: parts.sum(axis=2))
    weight = np.where(added[..., -1:] > 0, added[..., -1:], np.nan)
    return np.asarray(added[..., :-1] / weight * channel.step + channel.zero, np.float32)


def drawn_in_colours(geometry: Geometry) -> Channel:
    """Channel by which a map is drawn in colours: the first of colours; in a map without any that of classes.

    Raises:
        BadInputError: kind `unknown_channel`: it has neither.
    """
    kinds = {channel.kind for channel in geometry.channels}
    is_classed = ChannelKind.CLASSES in kinds and ChannelKind.COLOUR not in kinds
    return first_of_kind(geometry, ChannelKind.CLASSES if is_classed else ChannelKind.COLOUR)


def _class_table(cell: BrickCell, channel: Channel, places: Words32, sums: Ints) -> Table:
    """Table of the colours of classes, three planes; a larger node has the colour of its part with the most votes."""
    reading = reading_of_sums(channel, sums)
    rows = cell.counts.brick_of[places >> np.uint32(9)].astype(np.int64) * 512 + (places & np.uint32(511))
    dense = np.zeros((len(cell.counts.pool) * 512, 4))
    seen = reading.weight > 0
    dense[rows[seen], :3] = class_colours(len(channel.classes))[reading.mean[seen].astype(np.int64)]
    dense[rows, 3] = reading.weight

    def with_most(parts: Floats) -> Floats:
        best = parts[..., 3].argmax(axis=2)[..., None, None]
        return np.take_along_axis(parts, best, axis=2)[:, :, 0]

    found = _pyramid(dense, with_most)
    return np.where(found[..., 3:] > 0, found[..., :3], np.nan).astype(np.float32)


def _pyramid(voxels: Floats, join: Callable[[Floats], Floats]) -> Floats:
    """(B, 585, P) nodes of (B * 512, P) voxels: eight neighbours in Morton order are joined to one, three times."""
    B = len(voxels) // 512
    nodes = [voxels.reshape(B, 512, voxels.shape[1])]
    for count in (64, 8, 1):
        nodes.append(join(nodes[-1].reshape(B, count, 8, voxels.shape[1])))
    return np.concatenate(nodes, axis=1)
