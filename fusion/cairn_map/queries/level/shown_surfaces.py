"""A cell of a level as it is drawn: one voxel for each surface, with the mean of its votes, and what stands on it.

    votes of a column, from below  -->  windows of three bins with 15 % of them, and two at least  -->  a surface each
    other hits of the column       -->  windows with as many hits                                  -->  obstacles

`elevation` reads the lowest surface of a column; here a bridge stays over its road. A cell is read by itself: of a
column that goes on in the cell above or below, each has the share of its own votes.
"""

import numpy as np

from cairn_map.arrays import Flags, Ints
from cairn_map.evidence.channels import HEIGHT_OFFSET
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.grid import Geometry
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_map.kernels.morton_kernels import deinterleave
from cairn_map.queries.level.elevation_kernels import SHARE_PERCENT, VOTES_MIN, WINDOW_BINS


def shown_surfaces(evidence: Evidence, geometry: Geometry, model: SensorModel) -> Evidence:
    """Evidence of the voxels of a level's cell that are drawn, as a reading with log-odds.

    A surface is the lowest voxel with votes in its window: its samples are all votes of the window, as heights over its
    lower face (which may be more than its own height), its log-odds the highest there. Obstacles have no samples.
    """
    if not len(evidence):
        return evidence
    # Stage 1: voxels by column, from below; a window does not reach into the next column.
    numbers = deinterleave(evidence.voxels.astype(np.uint64))
    columns = numbers[:, 1] * geometry.side + numbers[:, 0]
    keys = columns * (geometry.side + WINDOW_BINS) + numbers[:, 2]
    order = np.argsort(keys)
    keys, columns = keys[order], columns[order]
    ends = np.searchsorted(keys, keys + WINDOW_BINS)
    planes = geometry.planes_of(HEIGHT_OFFSET.name)
    sums = np.zeros((len(evidence), 2), np.int64)
    sums[evidence.sampled] = evidence.samples[:, planes]
    offsets, votes = sums[order].T
    hits = evidence.counts[order, 0].astype(np.int64)
    totals = np.bincount(columns, weights=votes).astype(np.int64)[columns]
    # Stage 2: surfaces, from below, the next one of each column at a time.
    is_surface, is_within = np.zeros(len(keys), np.bool_), np.zeros(len(keys), np.bool_)
    is_left = votes > 0
    while True:
        starts = np.nonzero(is_left & _enough(np.where(is_left, votes, 0), ends, totals))[0]
        starts = starts[np.unique(columns[starts], return_index=True)[1]]
        if not len(starts):
            break
        is_surface[starts] = True
        is_within |= _covered(starts, ends)
        upper = np.zeros(int(columns.max()) + 1, np.int64)
        upper[columns[starts]] = keys[starts] + WINDOW_BINS
        is_left &= keys >= upper[columns]
    # Stage 3: what as many scans hit as make a surface.
    others = np.where(is_within, 0, hits)
    starts = np.nonzero((others > 0) & _enough(others, ends, totals))[0]
    is_shown = is_surface | (_covered(starts, ends) & (others > 0))
    # Stage 4: all votes of a window are its surface's.
    rows = np.nonzero(is_surface)[0]
    step = geometry.voxel_height_um / (1000 * HEIGHT_OFFSET.step)
    faces = np.rint((keys % (geometry.side + WINDOW_BINS)) * step).astype(np.int64)  # over the cell's lower face
    merged = np.stack([_window_sums(offsets + faces * votes, ends)[rows], _window_sums(votes, ends)[rows]], axis=1)
    merged[:, 0] -= faces[rows] * merged[:, 1]
    odds = evidence.log_odds(model)[order]
    # From each surface's row to the end of its window, which may be the end of all rows, and from there to the next.
    borders = np.stack([rows, ends[rows]], axis=1).ravel()
    odds[rows] = np.maximum.reduceat(np.append(odds, -np.inf), borders)[::2]
    return _reading(evidence, order, rows, is_shown, merged, odds, planes)


def _reading(
    evidence: Evidence, order: Ints, surfaces: Ints, is_shown: Flags, merged: Ints, odds: np.ndarray, planes: slice
) -> Evidence:
    """The voxels that are shown, in the order of their numbers; `order`: row of each in the evidence."""
    samples = np.zeros((len(evidence), evidence.samples.shape[1]), np.int64)
    samples[order[surfaces], planes] = merged
    all_odds = np.zeros(len(evidence))
    all_odds[order] = odds
    kept = np.sort(order[is_shown])
    sampled = np.nonzero(np.isin(kept, order[surfaces]))[0]
    return Evidence(
        voxels=evidence.voxels[kept],
        counts=evidence.counts[kept],
        sampled=sampled.astype(np.uint32),
        samples=samples[kept[sampled]],
        odds=all_odds[kept],
    )


def _window_sums(values: Ints, ends: Ints) -> Ints:
    """(V,) sums of the values from each row up to the end of its window."""
    before = np.concatenate([[0], np.cumsum(values)])
    sums: Ints = before[ends] - before[:-1]
    return sums


def _enough(values: Ints, ends: Ints, totals: Ints) -> Flags:
    """(V,) True where a window from this row on holds what makes a surface of its column."""
    counts = _window_sums(values, ends)
    return (counts >= VOTES_MIN) & (100 * counts >= SHARE_PERCENT * totals)


def _covered(starts: Ints, ends: Ints) -> Flags:
    """(V,) True for the rows of the windows that begin at these rows."""
    turns = np.zeros(len(ends) + 1, np.int64)
    np.add.at(turns, starts, 1)
    np.subtract.at(turns, ends[starts], 1)
    return np.cumsum(turns[:-1]) > 0
