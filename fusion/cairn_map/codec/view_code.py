"""The view code: a view as bytes and back, its octree, probabilities, colours and temperatures each under a model.

    head | masks | palette | probabilities | colours | temperatures        FORMAT.md section 15

A view has a third of the bytes of the exact cell: counts become one number, noise is rounded away, and free space may
be left out.
"""

import struct
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cairn_map.arrays import Bytes, Flags, Ints
from cairn_map.codec.entropy.mask_model_kernels import code_masks
from cairn_map.codec.entropy.neighbour_kernels import earlier_rows
from cairn_map.codec.entropy.sample_model_kernels import code_presence, code_ranks, code_sums
from cairn_map.codec.entropy.small_profile import Code, Coder, Ground, ground_of, read_modelled, write_modelled
from cairn_map.codec.octree.octree import build_octree, parse_octree
from cairn_map.codec.octree.octree_kernels import expand_into, leaves_of_rows
from cairn_map.errors import BadInputError, DamagedDataError
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.grid import CELL_LIMIT, DEPTH_MAX, CellKey, Geometry, cell_key, cell_of_key
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_map.evidence.view import LOG_ODDS_ZERO, TOPS, Chance, Colours, Extent, View, ViewStyle, view_of

MAGIC = b"CRNV"
VERSION = 1
HEAD = struct.Struct("<4sBBBBBBdIiiiIIII")
LENGTH = struct.Struct("<I")
GROUPS = 5
EXTENTS, CHANCES, COLOURS = list(Extent), list(Chance), list(Colours)
"""Styles by their codes in the head, which are indices of these lists."""
VIEW_BYTES_MAX = 1 << 26
NODES_MAX = 1 << 24
"""Default limit of the nodes that a reader accepts: all of the largest cell, some 500 MB."""


@dataclass(frozen=True, slots=True)
class DecodedView:
    """Content of a view's bytes: the cell, its grid, and its view."""

    key: CellKey
    voxel_edge_um: int
    cell_depth: int
    view: View


def encode_view(
    key: CellKey, evidence: Evidence, geometry: Geometry, model: SensorModel, *, style: ViewStyle | None = None
) -> bytes:
    """Bytes of one cell's view.

    Raises:
        BadInputError: kind `bad_style`: deeper than the cell.
    """
    # The view, and its octree: nodes with equal probabilities and nothing else collapse.
    view = view_of(evidence, geometry, model, style or ViewStyle())
    octree, rows = build_octree(_as_evidence(view), depth=view.depth)
    child_masks, leaf_masks, N = octree.child_masks.copy(), octree.leaf_masks.copy(), len(rows)
    # Values by leaf, and the coders that model them on the leaves' neighbours.
    chances = view.chances[rows]
    coloured = _flags(leaves_of_rows(rows, view.coloured.astype(np.uint32)), N)
    warm = _flags(leaves_of_rows(rows, view.scalar_rows.astype(np.uint32)), N)
    ground, occupied = ground_of(octree, depth=view.depth), _occupied(chances, view.style)
    colours = _samples_coder(coloured, view.rgb.copy(), occupied, np.zeros(N, np.bool_), ground)
    temperatures = _samples_coder(warm, view.scalar_steps.copy(), occupied, coloured, ground)
    # Probabilities come from two small counts, so there are few different ones; ranks, the highest first, are coded.
    palette, ranks = np.unique(-chances, return_inverse=True)
    groups = [
        _written(_masks_coder(child_masks, leaf_masks, view.depth), len(child_masks)),
        (-palette).astype("<u2").tobytes(),
        _written(_ranks_coder(ranks, ground), N),
        _written(colours, N + view.rgb.size),
        _written(temperatures, N + view.scalar_steps.size),
    ]
    head = HEAD.pack(
        MAGIC,
        VERSION,
        geometry.depth,
        view.depth,
        EXTENTS.index(view.style.extent),
        CHANCES.index(view.style.chance),
        COLOURS.index(view.style.colours),
        view.style.scalar_step or 0.0,
        geometry.voxel_edge_um,
        *cell_of_key(key),
        N,
        len(view),
        len(child_masks),
        len(leaf_masks),
    )
    return head + b"".join(LENGTH.pack(len(group)) + group for group in groups)


def decode_view(data: bytes, *, nodes_max: int = NODES_MAX) -> DecodedView:
    """View of a cell's bytes, every size checked before anything is allocated; the mirror of `encode_view`.

    Raises:
        DamagedDataError: cut off, contradictory or out of range.
        BadInputError: a version that this reader does not know, or too large.
    """
    # Head, and the bytes of the five groups.
    head = _head(data)
    style, depth, N = head.style, head.depth, head.leaves
    if head.nodes > nodes_max or len(data) > VIEW_BYTES_MAX:
        raise BadInputError(
            "too_large", f"a view of {len(data)} bytes, {head.nodes} nodes; at most {nodes_max} are read"
        )
    masks, palette_bytes, rank_bytes, colours, temperatures = _groups(data)
    # Octree.
    child_masks, leaf_masks = np.zeros(head.child_masks, np.uint8), np.zeros(head.leaf_masks, np.uint8)
    read_modelled(_masks_coder(child_masks, leaf_masks, depth), masks)
    octree = parse_octree(child_masks, leaf_masks, depth=depth)
    if len(octree.starts) != N or int(octree.sizes.sum()) != head.nodes:
        raise DamagedDataError("bad_view", "the octree has other numbers of nodes or leaves than the head names")
    # Probabilities: ranks in a palette.
    ground, ranks = ground_of(octree, depth=depth), np.zeros(N, np.int64)
    read_modelled(_ranks_coder(ranks, ground), rank_bytes)
    palette = _read_palette(palette_bytes, style)
    if N and int(ranks.max()) >= len(palette):
        raise DamagedDataError("bad_view", "a probability is not in the palette")
    found = palette[ranks]
    # Colours, then temperatures, whose presence is modelled on that of colours.
    occupied, none = _occupied(found, style), np.zeros(N, np.bool_)
    coloured, rgb = _read_samples(colours, occupied, none, ground, columns=len(TOPS[style.colours]))
    columns = 0 if style.scalar_step is None else 1 if depth == head.cell_depth else 2
    warm, steps = _read_samples(temperatures, occupied, _flags(coloured, N), ground, columns=columns)
    if (rgb > np.array(TOPS[style.colours])).any():
        raise DamagedDataError("bad_view", "a colour is out of range")
    # From leaves to nodes.
    nodes, spread = np.empty(head.nodes, np.uint32), np.empty((head.nodes, 2), np.int32)
    expand_into(octree.starts, octree.sizes, np.stack([found, found], axis=1).astype(np.int32), nodes, spread)
    rows = np.cumsum(octree.sizes) - octree.sizes
    view = View(depth, style, nodes, spread[:, 0].astype(np.int64), rows[coloured], rgb, rows[warm], steps)
    return DecodedView(cell_key(head.cell), head.voxel_edge_um, head.cell_depth, view)


@dataclass(frozen=True, slots=True)
class _Head:
    """Fields of a view's head."""

    cell_depth: int
    depth: int
    style: ViewStyle
    voxel_edge_um: int
    cell: tuple[int, int, int]
    leaves: int
    nodes: int
    child_masks: int
    leaf_masks: int


def _head(data: bytes) -> _Head:
    # Fields in the order of the table in FORMAT.md section 15.
    if len(data) < HEAD.size or data[:4] != MAGIC:
        raise DamagedDataError("bad_view", "not a view of a cell: it must begin with CRNV and a whole head")
    fields = HEAD.unpack_from(data)
    version, cell_depth, depth, extent, chance, colours = fields[1:7]
    step_k, edge_um, i, j, k, N, V, children, leaves = fields[7:]
    if version != VERSION:
        raise BadInputError("unknown_version", f"this reader knows views of version {VERSION}, got {version}")
    # Codes and numbers that exist.
    known = extent < len(EXTENTS) and chance < len(CHANCES) and colours < len(COLOURS)
    within = all(-CELL_LIMIT <= number < CELL_LIMIT for number in (i, j, k))
    if not known or not within or not 1 <= depth <= cell_depth <= DEPTH_MAX:
        raise DamagedDataError("bad_view", "a code, a depth or a cell number in the view's head is out of range")
    try:
        style = ViewStyle(depth, EXTENTS[extent], CHANCES[chance], COLOURS[colours], step_k or None)
    except BadInputError as exc:
        raise DamagedDataError("bad_view", str(exc)) from exc
    # At each depth an inner node has a leaf of its own below it.
    if not N <= V <= 8**depth or children > depth * N or leaves > children:
        raise DamagedDataError("bad_view", "the head's numbers of leaves, nodes and masks contradict each other")
    return _Head(cell_depth, depth, style, edge_um, (i, j, k), N, V, children, leaves)


def _groups(data: bytes) -> list[bytes]:
    groups: list[bytes] = []
    at = HEAD.size
    for _ in range(GROUPS):
        # A length that is cut off, or too large, leads to a wrong end.
        if at + LENGTH.size > len(data):
            break
        (size,) = LENGTH.unpack_from(data, at)
        groups.append(data[at + LENGTH.size : at + LENGTH.size + size])
        at += LENGTH.size + size
    if at != len(data) or len(groups) < GROUPS:
        raise DamagedDataError("bad_view", "the view is cut off, or something follows it")
    return groups


def _as_evidence(view: View) -> Evidence:
    """Evidence whose octree is the view's: nodes collapse where probabilities are equal and no other value is known."""
    # Hits of 1 more than the probability, because a voxel without counts does not exist.
    counts = np.stack([view.chances + 1, np.zeros_like(view.chances)], axis=1).astype(np.int32)
    sampled = np.union1d(view.coloured, view.scalar_rows).astype(np.uint32)
    return Evidence(view.nodes, counts, sampled, np.zeros((len(sampled), 0), np.int64))


def _occupied(chances: Ints, style: ViewStyle) -> npt.NDArray[np.int32]:
    """(N,) 1 where the probability is above one half; the presence of samples is modelled on it."""
    return (chances > (127 if style.chance is Chance.BYTE else LOG_ODDS_ZERO)).astype(np.int32)


def _flags(rows: Ints, count: int) -> Flags:
    flags = np.zeros(count, np.bool_)
    flags[rows] = True
    return flags


def _written(code: Code, numbers: int) -> bytes:
    # Room for any numbers: the coder's worst case is far below eight bytes each.
    data = write_modelled(code, room=64 + 8 * numbers)
    if data is None:
        raise AssertionError("eight bytes a number were too few")
    return data


def _masks_coder(child_masks: Bytes, leaf_masks: Bytes, depth: int) -> Code:
    count = (len(child_masks), len(leaf_masks))
    return lambda coder, data: code_masks(coder, data, child_masks, leaf_masks, depth, depth) == count


def _ranks_coder(ranks: Ints, ground: Ground) -> Code:
    """Coder of all leaves' (N,) ranks in the palette."""
    where = (ground.brick_of, ground.leaf_of, ground.depth)
    near = earlier_rows(ground.octree.starts, np.arange(len(ranks)), *where)
    return lambda coder, data: code_ranks(coder, data, ranks, near)


def _read_palette(data: bytes, style: ViewStyle) -> Ints:
    """Distinct probabilities of a view, the highest first."""
    # Canonical: each probability once, in falling order.
    palette = np.frombuffer(data[: len(data) & ~1], "<u2").astype(np.int64)
    top = 255 if style.chance is Chance.BYTE else 2 * LOG_ODDS_ZERO - 1
    if len(data) % 2 or (np.diff(palette) >= 0).any() or (palette > top).any():
        raise DamagedDataError("bad_view", "the palette of probabilities does not fall, or is out of range")
    return palette


def _samples_coder(
    present: Flags, values: Ints, occupied: npt.NDArray[np.int32], before: Flags, ground: Ground
) -> Code:
    """Coder of one kind of (S, C) values, and of the leaves that have them; `before`: leaves with the kind before."""

    def code(coder: Coder, data: Bytes) -> bool:
        _code_presence(coder, data, present, occupied, before, ground)
        return _code_rows(coder, data, values, np.nonzero(present)[0], ground)

    return code if values.shape[1] else lambda coder, data: True


def _read_samples(
    data: bytes, occupied: npt.NDArray[np.int32], before: Flags, ground: Ground, *, columns: int
) -> tuple[Ints, Ints]:
    """Leaves that have values of one kind, and the values; the mirror of `_samples_coder`."""
    found: list[Ints] = [np.empty(0, np.int64), np.empty((0, columns), np.int64)]

    def code(coder: Coder, read: Bytes) -> bool:
        # The number of values is known only once the presence is decoded.
        present = np.zeros(len(before), np.bool_)
        _code_presence(coder, read, present, occupied, before, ground)
        leaves = np.nonzero(present)[0]
        found[:] = [leaves, np.zeros((len(leaves), columns), np.int64)]
        return _code_rows(coder, read, found[1], leaves, ground)

    read_modelled(code if columns else lambda coder, read: True, data)
    return found[0], found[1]


def _code_presence(
    coder: Coder, data: Bytes, present: Flags, occupied: npt.NDArray[np.int32], before: Flags, ground: Ground
) -> None:
    octree, where = ground.octree, (ground.brick_of, ground.leaf_of, ground.depth)
    code_presence(coder, data, present, octree.starts, octree.sizes, before.astype(np.int64), occupied, *where)


def _code_rows(coder: Coder, data: Bytes, values: Ints, leaves: Ints, ground: Ground) -> bool:
    near = earlier_rows(ground.octree.starts, leaves, ground.brick_of, ground.leaf_of, ground.depth)
    return code_sums(coder, data, values, np.zeros_like(values), np.ones(len(leaves), np.int64), near)
