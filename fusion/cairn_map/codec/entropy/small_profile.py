"""The profile *small*: groups of streams, each coded under a model of its neighbours in space (FORMAT.md section 14).

    group      its streams                        modelled on
    masks      1, 2                               states of neighbouring nodes
    counts     3, 4                               neighbouring leaves, and the octree
    channel c  16 + 8c to 18 + 8c + planes        neighbouring rows, hits, and the weights of the channel before

The stored bytes of a group's first stream hold the whole group; those of its other streams are empty. Their meaning is
unchanged: the raw streams, encoded again from the decoded numbers, have the digest of the cell.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cairn_map.arrays import Bytes, Ints
from cairn_map.codec.entropy.arithmetic_kernels import finish_decoding, finish_encoding, start_decoding, start_encoding
from cairn_map.codec.entropy.count_model_kernels import code_counts
from cairn_map.codec.entropy.mask_model_kernels import code_masks
from cairn_map.codec.entropy.neighbour_kernels import earlier_rows, index_leaves
from cairn_map.codec.entropy.sample_model_kernels import code_presence, code_squares, code_sums, code_weights
from cairn_map.codec.octree.cell_content import CellContent
from cairn_map.codec.octree.channel_streams import ChannelRows
from cairn_map.codec.octree.octree import Octree
from cairn_map.errors import DamagedDataError
from cairn_map.evidence.channels import Channel

Coder = npt.NDArray[np.int64]
Code = Callable[[Coder, Bytes], bool]
"""Function that runs kernels, which read or write its own numbers; False if one that was read is out of range."""
NUMBERS_PER_BYTE = 1024
"""Leaves or masks for each stored byte, at most: so a few bytes cannot keep a reader busy for minutes."""


@dataclass(frozen=True, slots=True, eq=False)
class Ground:
    """Leaves of an octree, and the index of their places, by which models find neighbours."""

    octree: Octree
    depth: int
    brick_of: npt.NDArray[np.int32]
    leaf_of: npt.NDArray[np.int32]


def ground_of(octree: Octree, *, depth: int) -> Ground:
    """Ground of one octree."""
    return Ground(octree, depth, *index_leaves(octree.starts, octree.sizes, depth))


def encode_masks(octree: Octree, *, depth: int) -> bytes | None:
    """Masks under their model, or None if that would not be shorter than the masks."""
    child_masks, leaf_masks = octree.child_masks.copy(), octree.leaf_masks.copy()
    room = len(child_masks) + len(leaf_masks)

    def code(coder: Coder, data: Bytes) -> bool:
        code_masks(coder, data, child_masks, leaf_masks, depth, depth)
        return True

    return _encoded(code, room, room)


def decode_masks(data: bytes, *, child_count: int, leaf_count: int, depth: int, stop: int) -> tuple[Bytes, Bytes]:
    """Child masks and leaf masks, with `stop` below `depth` only the first ones; the mirror of `encode_masks`.

    Raises:
        DamagedDataError: there are other numbers of masks.
    """
    child_masks, leaf_masks = np.zeros(child_count, np.uint8), np.zeros(leaf_count, np.uint8)
    read = np.frombuffer(data, np.uint8).copy()
    coder = start_decoding(read)
    children, leaves = code_masks(coder, read, child_masks, leaf_masks, depth, stop)
    complete = (children, leaves) == (child_count, leaf_count) and finish_decoding(coder, read)
    if children < 0 or (stop == depth and not complete):
        raise DamagedDataError("bad_stream", "modelled masks are cut off, left over, or not as many as stated")
    return child_masks[:children], leaf_masks[:leaves]


def encode_counts(content: CellContent, ground: Ground) -> bytes | None:
    """Hits and misses under their model, or None if that would not be shorter than one byte each."""
    counts = content.counts.copy()
    return _encoded(_counts_coder(counts, ground), len(counts), 2 * len(counts))


def decode_counts(data: bytes, ground: Ground) -> npt.NDArray[np.int32]:
    """(N, 2) hits and misses; the mirror of `encode_counts`.

    Raises:
        DamagedDataError: a count is out of range.
    """
    counts = np.zeros((len(ground.octree.starts), 2), np.int32)
    read_modelled(_counts_coder(counts, ground), data)
    return counts


def encode_channel(
    channel: Channel, rows: ChannelRows, hits: npt.NDArray[np.int32], before: Ints, ground: Ground
) -> bytes | None:
    """One channel's samples under their model, or None if that would not be shorter than two bytes a number.

    `hits` (N,) are those of the leaves, `before` (N,) the weights of the channel before, all zeros for the first.
    """
    present = np.zeros(len(hits), np.bool_)
    present[rows.leaves] = True
    sums = rows.sums.copy()

    def code(coder: Coder, data: Bytes) -> bool:
        _code_presence(coder, data, present, hits, before, ground)
        return _code_rows(coder, data, channel, rows.leaves, sums, hits, before, ground)

    return _encoded(code, len(hits), 64 + len(hits) // 8 + 2 * sums.size)


def decode_channel(
    data: bytes,
    channel: Channel,
    hits: npt.NDArray[np.int32],
    before: Ints,
    ground: Ground,
    *,
    check_count: Callable[[int], None],
) -> ChannelRows:
    """Rows of one channel; the mirror of `encode_channel`. `check_count` refuses too many rows before they are decoded.

    Raises:
        DamagedDataError: a weight or sum is out of range.
    """
    found: list[ChannelRows] = []

    def code(coder: Coder, read: Bytes) -> bool:
        present = np.zeros(len(hits), np.bool_)
        _code_presence(coder, read, present, hits, before, ground)
        leaves = np.nonzero(present)[0]
        check_count(len(leaves))
        sums = np.zeros((len(leaves), len(channel.planes)), np.int64)
        found.append(ChannelRows(leaves, sums))
        return _code_rows(coder, read, channel, leaves, sums, hits, before, ground)

    read_modelled(code, data)
    return found[0]


def weights_by_leaf(rows: ChannelRows, leaves: int) -> Ints:
    """(N,) weights of a channel; 0 where it has no row."""
    weights = np.zeros(leaves, np.int64)
    weights[rows.leaves] = rows.sums[:, -1]
    return weights


def _counts_coder(counts: npt.NDArray[np.int32], ground: Ground) -> Code:
    octree = ground.octree
    where = (octree.starts, octree.sizes, ground.brick_of, ground.leaf_of, ground.depth)
    return lambda coder, data: code_counts(coder, data, counts, *where)


def _code_presence(
    coder: Coder,
    data: Bytes,
    present: npt.NDArray[np.bool_],
    hits: npt.NDArray[np.int32],
    before: Ints,
    ground: Ground,
) -> None:
    where = (ground.brick_of, ground.leaf_of, ground.depth)
    code_presence(coder, data, present, ground.octree.starts, ground.octree.sizes, before, hits, *where)


def _code_rows(
    coder: Coder,
    data: Bytes,
    channel: Channel,
    leaves: Ints,
    sums: Ints,
    hits: npt.NDArray[np.int32],
    before: Ints,
    ground: Ground,
) -> bool:
    """Code weights, sums and squares; `sums` is read when encoding, written when decoding."""
    # Weights are guessed from those of the channel before, else from hits.
    near = earlier_rows(ground.octree.starts, leaves, ground.brick_of, ground.leaf_of, ground.depth)
    references = np.where(before[leaves] > 0, before[leaves], hits[leaves].astype(np.int64))
    # Kernels take contiguous columns. `rests` are residuals of the sums, on which the squares are modelled.
    weights = sums[:, -1].copy()
    values = np.ascontiguousarray(sums[:, : channel.value_count])
    rests = np.zeros_like(values)
    sound = code_weights(coder, data, weights, references, near) and code_sums(
        coder, data, values, rests, weights, near
    )
    sums[:, : channel.value_count], sums[:, -1] = values, weights
    if "square_sum" in channel.planes and sound:
        squares = sums[:, 1].copy()
        sound = code_squares(coder, data, squares, values[:, 0].copy(), rests[:, 0].copy(), weights, near)
        sums[:, 1] = squares
    return sound


def _encoded(code: Code, numbers: int, room: int) -> bytes | None:
    """Bytes of a group under its model; None if they need more room, or are so few that a reader would refuse them."""
    data = write_modelled(code, room=room)
    return None if data is None or numbers > NUMBERS_PER_BYTE * len(data) else data


def write_modelled(code: Code, *, room: int) -> bytes | None:
    """Bytes that a model writes, or None if they would be more than `room`."""
    data, coder = np.empty(room, np.uint8), start_encoding()
    code(coder, data)
    size = finish_encoding(coder, data)
    return None if size < 0 else data[:size].tobytes()


def read_modelled(code: Code, data: bytes) -> None:
    """Let a model read the bytes that it wrote.

    Raises:
        DamagedDataError: bytes that it does not write, or a number out of range.
    """
    # A copy that may be written: kernels that code read and write through the same argument.
    read = np.frombuffer(data, np.uint8).copy()
    coder = start_decoding(read)
    if not code(coder, read) or not finish_decoding(coder, read):
        raise DamagedDataError("bad_stream", "a modelled stream is cut off, left over or holds a number out of range")


def check_effort(numbers: int, data: bytes) -> None:
    """Refuse too few bytes for the numbers that they claim to hold.

    Raises:
        DamagedDataError: more than NUMBERS_PER_BYTE numbers for each byte.
    """
    if numbers > NUMBERS_PER_BYTE * len(data):
        raise DamagedDataError("bad_stream", f"{len(data)} modelled bytes cannot say {numbers} masks or leaves")
