"""Every kernel of this package, run once on a few voxels, so that Numba compiles it ahead and keeps it.

Through the public functions, because a kernel is compiled anew for each type of its arguments: read-only arrays, as
decoding gives them, are another type than those that a robot made.
"""

import numpy as np

from cairn_map.brick_cell import BrickCell
from cairn_map.cell_code import Profile, decode_canonical_cell, encode_cell
from cairn_map.evidence import packed_evidence
from cairn_map.fingerprint import fingerprint
from cairn_map.grid import BRICK_DEPTH, Geometry, cell_key, voxels_in_cell
from cairn_map.sensor_model import SensorModel
from cairn_map.view_code import decode_view, encode_view


def warm_up() -> None:
    """Encode, decode, view, merge, take out again and fingerprint some voxels, half of them with samples."""
    geometry = Geometry(depth=BRICK_DEPTH)
    key = cell_key((0, 0, 0))
    # As many as make models pay: profile small falls back to the fast one otherwise.
    places = np.arange(0, 512, 3, dtype=np.uint32)
    noise = (places * np.uint32(2654435761)) >> np.uint32(20)
    counts = np.stack([places % 2, noise % 5], axis=1).astype(np.int32)
    samples = np.where(places[:, None] % 2 == 1, np.ones(geometry.plane_count, np.int64), 0)
    made = packed_evidence(places, counts, samples, geometry)
    small = encode_cell(key, made, geometry, profile=Profile.SMALL).data
    read = decode_canonical_cell(small).evidence
    read = decode_canonical_cell(encode_cell(key, read, geometry).data).evidence
    decode_view(encode_view(key, read, geometry, SensorModel()))
    cell = BrickCell(geometry)
    for evidence in (made, read):
        cell.merge(evidence)
        cell.unmerge(evidence)
        fingerprint(evidence, key)
        voxels_in_cell(evidence.voxels, key, geometry)
    cell.packed()
