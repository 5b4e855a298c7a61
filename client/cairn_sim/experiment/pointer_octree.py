"""The paper's way to keep a cell: an octree with pointers, occupied voxels alone, under zip. The baseline of Table 3.

    head   "POCT" | depth u8 | inner nodes u32 | leaves u32
    nodes  breadth-first, 5 bytes each: child mask u8, first child u32     children lie side by side, as bits are set
    leaves in Morton order, 8 bytes each: p i16, R G B u8, pad u8, temperature i16

The paper prints 8 B a voxel (16 MB for 128^3) and "zip-compressed octrees", not the fields' types; these are the types
that fit. A first child is numbered among all nodes, leaves after the inner ones. All of it goes through zlib, level 6.
What an occupied voxel holds comes back as it went in; what is free and what is unknown is one, as in the paper's.
"""

import struct
import zlib
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cairn_map.errors import DamagedDataError
from cairn_map.evidence.channels import ChannelKind
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.grid import DEPTH_MAX, CellKey, Geometry
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_map.evidence.voxels import voxels_of_evidence

FIELDS = np.dtype([("log_odds", "<i2"), ("rgb", "u1", (3,)), ("pad", "u1"), ("temperature", "<i2")])
NODE = np.dtype([("mask", "u1"), ("first", "<u4")])
HEAD = struct.Struct("<4sBII")
MAGIC = b"POCT"
ZIP_LEVEL = 6
"""Default level of zip."""
LOG_ODDS_STEP = 0.001
TEMPERATURE_STEP_K = 0.01
TEMPERATURE_ZERO_K = 273.15
"""So that an i16 reaches from -327 to 327 degrees Celsius."""
NO_TEMPERATURE = -(1 << 15)
"""Temperature of voxels that no thermal camera saw; without colour R, G and B are 0."""
RAW_BYTES_MAX = 1 << 29


@dataclass(frozen=True, slots=True, eq=False)
class OccupiedVoxels:
    """The occupied voxels of a cell: Morton codes (V,) uint32, rising, and their fields (V,) `FIELDS`."""

    depth: int
    places: npt.NDArray[np.uint32]
    fields: npt.NDArray[np.void]


def occupied_voxels(key: CellKey, evidence: Evidence, geometry: Geometry, model: SensorModel) -> OccupiedVoxels:
    """Occupied voxels of a cell's evidence, as the paper's octree keeps them."""
    places = evidence.voxels[model.occupied(evidence.counts)]
    voxels = voxels_of_evidence(key, evidence, geometry, model, occupied_only=True)
    fields = np.zeros(len(places), FIELDS)
    fields["log_odds"] = np.rint(model.log_odds(voxels.counts) / LOG_ODDS_STEP)
    fields["temperature"] = NO_TEMPERATURE
    colour, thermal = voxels.of_kind(ChannelKind.COLOUR), voxels.of_kind(ChannelKind.TEMPERATURE)
    if colour is not None:
        seen = colour.weight > 0
        fields["rgb"][seen] = np.rint(np.clip(colour.mean[seen], 0, 255))
    if thermal is not None:
        seen = thermal.weight > 0
        steps = np.rint((thermal.mean[seen] - TEMPERATURE_ZERO_K) / TEMPERATURE_STEP_K)
        fields["temperature"][seen] = np.clip(steps, NO_TEMPERATURE + 1, -NO_TEMPERATURE - 1)
    return OccupiedVoxels(geometry.depth, places, fields)


def encode_pointer_octree(voxels: OccupiedVoxels) -> bytes:
    """The octree's bytes, zipped."""
    masks, counts = _masks(voxels.places, voxels.depth)
    nodes = np.zeros(len(masks), NODE)
    nodes["mask"] = masks
    # Breadth-first, the children of all nodes follow the root without a gap: inner nodes first, then the leaves.
    nodes["first"] = 1 + np.cumsum(counts) - counts
    head = HEAD.pack(MAGIC, voxels.depth, len(nodes), len(voxels.places))
    return zlib.compress(head + nodes.tobytes() + voxels.fields.tobytes(), ZIP_LEVEL)


def decode_pointer_octree(data: bytes) -> OccupiedVoxels:
    """The mirror of `encode_pointer_octree`.

    Raises:
        DamagedDataError: not such bytes, cut off, or contradictory.
    """
    raw = _unzipped(data)
    magic, depth, node_count, leaf_count = HEAD.unpack_from(raw) if len(raw) >= HEAD.size else (b"", 0, 0, 0)
    nodes_at = HEAD.size
    leaves_at = nodes_at + NODE.itemsize * node_count
    if magic != MAGIC or not depth <= DEPTH_MAX or len(raw) != leaves_at + FIELDS.itemsize * leaf_count:
        raise DamagedDataError("bad_octree", "not a zipped pointer octree, or one that is cut off")
    nodes = np.frombuffer(raw, NODE, node_count, nodes_at)
    children = np.bitwise_count(nodes["mask"])
    if not np.array_equal(nodes["first"], 1 + np.cumsum(children) - children):
        raise DamagedDataError("bad_octree", "a node's children are not where breadth-first order has them")
    places = np.zeros(min(1, node_count), np.uint32)
    at = 0
    for _ in range(depth):
        mask = nodes["mask"][at : at + len(places)]
        if len(mask) < len(places):
            raise DamagedDataError("bad_octree", "inner nodes are missing")
        at += len(places)
        is_there = np.unpackbits(mask, bitorder="little").astype(np.bool_)
        places = ((places[:, None] << np.uint32(3)) | np.arange(8, dtype=np.uint32)).ravel()[is_there]
    if at != node_count or len(places) != leaf_count:
        raise DamagedDataError("bad_octree", "the octree has other numbers of nodes or leaves than its head names")
    return OccupiedVoxels(depth, places, np.frombuffer(raw, FIELDS, leaf_count, leaves_at))


def _masks(places: npt.NDArray[np.uint32], depth: int) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.int64]]:
    """(K,) child masks of the inner nodes, breadth-first, and how many children each has."""
    keys, by_depth = places, [np.empty(0, np.uint8)]
    for _ in range(depth if len(places) else 0):
        parents = keys >> np.uint32(3)
        starts = np.flatnonzero(np.append(True, parents[1:] != parents[:-1]))
        bits = (np.uint8(1) << (keys & np.uint32(7)).astype(np.uint8)).astype(np.uint8)
        by_depth.append(np.bitwise_or.reduceat(bits, starts))
        keys = parents[starts]
    masks = np.concatenate(by_depth[::-1])
    return masks, np.bitwise_count(masks).astype(np.int64)


def _unzipped(data: bytes) -> bytes:
    unzip = zlib.decompressobj()
    try:
        raw = unzip.decompress(data, RAW_BYTES_MAX)
    except zlib.error as exc:
        raise DamagedDataError("bad_octree", f"not zipped: {exc}") from exc
    if not unzip.eof or unzip.unused_data:
        raise DamagedDataError("bad_octree", "the zipped octree is cut off, too large, or followed by something")
    return raw
