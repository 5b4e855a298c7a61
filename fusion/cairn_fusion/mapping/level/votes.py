"""Votes of a scan: for each column of flat voxels and each surface in it, the height of its lowest returns.

    z                         column of voxels, 20 cm wide, 5 cm high
    |  o o     deck           second surface: more than a gap above the first
    |
    |  o       top of a wall  hit without a vote: a thing stands here
    |  o o
    |  o o .   ground         vote: hit and sample in the bin of the mean of the lowest returns
    +------

A vote is a hit with one sample of the channel `height`, its place above the bin's lower face. The top of a surface that
is taller than two bins is a hit without a sample, so that it says nothing about the ground. Bins from which nothing
came back, that a beam crossed on its way to a return of the same column, are missed if they lie below another return of
it: grass and branches are seen through. All of it depends on the scan alone.
"""

import numpy as np

from cairn_fusion.mapping.level.vote_kernels import GAP_STEPS, NO_VOTE, column_votes
from cairn_map.arrays import Flags, Floats, Ints
from cairn_map.errors import BadInputError
from cairn_map.evidence.channels import HEIGHT_OFFSET
from cairn_map.evidence.evidence import Evidence, packed_evidence
from cairn_map.evidence.grid import NANOMETRES, CellKey, Geometry, split_voxels, voxels_of_points

GAP_M = 0.5
"""Height without a return between two surfaces of a column, metres, at least: beams of a lidar of 64 are as far apart
on a wall 50 m away, and a robot does not fit below."""
OFFSET_NM = round(HEIGHT_OFFSET.step * 1e6)
"""Step of the offsets of votes, nanometres."""
COLUMNS_MAX = 1 << 40
"""Columns in the box around one scan: 1000 km to each side at 1 m."""


def votes_of(origin_m: Floats, points_m: Floats, geometry: Geometry) -> dict[CellKey, Evidence]:
    """Votes of the returns of one scan, by cell: one hit or miss a voxel.

    Args:
        origin_m: (3,) place of the sensor, metres, map frame.
        points_m: (N, 3) returns, metres, map frame.
        geometry: of a level layer.

    Raises:
        BadInputError: the scan reaches beyond the numbered space.
    """
    if not len(points_m):
        return {}
    # Columns, numbered row by row of the box around all of them.
    points = np.ascontiguousarray(points_m, np.float64)
    returned, size_nm = voxels_of_points(points, geometry), geometry.voxel_size_um() * 1000
    x, y = (np.ascontiguousarray(each) for each in returned.T[:2])
    W, H = int(x.max() - x.min()) + 1, int(y.max() - y.min()) + 1
    if W * H > COLUMNS_MAX:
        raise BadInputError("scan_too_large", f"one scan spans {W} x {H} columns; limit its range")
    numbers = (y - y.min()) * W + (x - x.min())
    gap_nm = max(round(GAP_M * NANOMETRES), GAP_STEPS * int(size_nm[2]))
    order = np.argsort(numbers, kind="stable")
    origin = np.ascontiguousarray(origin_m, np.float64)
    return _by_cell(*column_votes(order, numbers, returned, points, origin, size_nm, gap_nm, OFFSET_NM), geometry)


def _by_cell(voxels: Ints, offsets: Ints, hits: Flags, geometry: Geometry) -> dict[CellKey, Evidence]:
    """Evidence of (M, 3) different voxels, by cell."""
    counts = np.stack([hits, ~hits], axis=1).astype(np.int32)
    planes = geometry.planes_of(HEIGHT_OFFSET.name)
    samples = np.zeros((len(voxels), geometry.plane_count), np.int64)
    voted = offsets != NO_VOTE
    samples[voted, planes.start] = offsets[voted]
    samples[voted, planes.stop - 1] = 1
    cells, places = split_voxels(voxels, geometry)
    order = np.argsort(cells, kind="stable")
    keys, starts = np.unique(cells[order], return_index=True)
    return {
        CellKey(int(key)): packed_evidence(places[rows], counts[rows], samples[rows], geometry)
        for key, rows in zip(keys, np.split(order, starts[1:]), strict=True)
    }
