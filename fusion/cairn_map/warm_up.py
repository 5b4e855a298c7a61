"""Every kernel of this package, run once on a few voxels, so that Numba compiles it ahead and keeps it.

Through the public functions, because a kernel is compiled anew for each type of its arguments: read-only arrays, as
decoding gives them, are another type than those that a robot made.
"""

import numpy as np

from cairn_map.brick_cell import BrickCell
from cairn_map.cell_code import decode_canonical_cell, encode_cell
from cairn_map.evidence import packed_evidence
from cairn_map.fingerprint import fingerprint
from cairn_map.grid import BRICK_DEPTH, Geometry, cell_key, voxels_in_cell


def warm_up() -> None:
    """Encode, decode, merge, take out again and fingerprint two voxels, one of them with samples."""
    geometry = Geometry(depth=BRICK_DEPTH)
    key = cell_key((0, 0, 0))
    samples = np.array([[0] * geometry.plane_count, [1] * geometry.plane_count], np.int64)
    made = packed_evidence(np.array([0, 511], np.uint32), np.array([[0, 1], [1, 0]], np.int32), samples, geometry)
    read = decode_canonical_cell(encode_cell(key, made, geometry).data).evidence
    cell = BrickCell(geometry)
    for evidence in (made, read):
        cell.merge(evidence)
        cell.unmerge(evidence)
        fingerprint(evidence, key)
        voxels_in_cell(evidence.voxels, key, geometry)
    cell.packed()
