"""Reading of a cell's bytes, as far as needed: octree, counts, channels, each decoded when it is first read.

    masks --> octree --> counts --> channel 0 --> channel 1 --> ...          --> only where a group is modelled

Groups of streams depend on those before them only if they are modelled (FORMAT.md section 14). So a reader of the
topology decodes nothing else, and a reader of temperatures skips colours. There are three ways to read a cell:

    topology    the octree down to a depth, from the first bytes of the masks
    bricks      the leaves of some bricks
    content     all leaves: in one pass if the cell is plain (`plain_cell`), else part by part

`canonical_bytes`, over which the digest is taken, holds the raw streams: as they were read, or encoded again from the
numbers that a model gave.
"""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import numpy.typing as npt

from cairn_map.codec.entropy import small_profile
from cairn_map.codec.entropy.small_profile import Ground, check_effort
from cairn_map.codec.octree import channel_streams
from cairn_map.codec.octree.cell_content import (
    CHILD_MASKS,
    HITS,
    LEAF_MASKS,
    MISSES,
    CellContent,
    canonical_bytes,
    count_streams,
    counts_of_streams,
    topology_streams,
)
from cairn_map.codec.octree.cell_head import CellHead, decode_head, is_canonical_head
from cairn_map.codec.octree.channel_streams import ChannelRows, stream_count, stream_of_channel
from cairn_map.codec.octree.octree import Octree, parse_octree
from cairn_map.codec.octree.streams import (
    MODELLED,
    RAW_BYTES_MAX,
    STORED,
    ZSTD,
    StoredStream,
    split_streams,
    zstd_prefix,
)
from cairn_map.codec.plain_cell import PlainCell, is_plain, plain_content
from cairn_map.errors import BadInputError, DamagedDataError
from cairn_map.evidence.channels import ChannelKind
from cairn_map.evidence.grid import BRICK_DEPTH

VOXEL_BYTES = 12
"""Bytes of a voxel in packed evidence: its number and two counts."""

CELL_BYTES_MAX = 1 << 28
"""Bytes of one encoded cell that a reader accepts."""
EVIDENCE_BYTES_MAX = 1 << 31
"""Bytes of one cell's packed evidence: the largest cell, full, with the standard channels in every voxel, has 1.4e9."""


@dataclass(slots=True, eq=False)
class CellReader:
    """Reader of one cell's bytes, of which nothing but the head is decoded at first; not thread-safe."""

    head: CellHead
    head_bytes: bytes
    stored: dict[int, StoredStream]
    """Streams by number, in the order of the file."""
    sampled_max: int
    """Leaves with samples that are accepted, at most."""
    is_plain: bool = False
    """True if the whole cell can be read in one pass (`plain_content`)."""
    _parts: "_Parts" = field(init=False)
    _plain: PlainCell | None = field(init=False)
    """The whole cell, once `content` has read it in one pass."""

    def __post_init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Drop all that was decoded so far."""
        self._parts = _Parts(self.head, self.stored)
        self._plain = None

    def limit_evidence(self, evidence_bytes_max: int) -> None:
        """Refuse from now on samples that do not fit into this much packed evidence.

        Raises:
            BadInputError: kind `too_large`: the cell's voxels alone do not fit.
        """
        self.sampled_max = sampled_max_of(self.head, evidence_bytes_max)

    def octree(self) -> Octree:
        """The whole octree.

        Raises:
            DamagedDataError: its masks contradict each other or the head.
        """
        return self._parts.octree

    def topology(self, depth: int) -> Octree:
        """The octree no deeper than `depth`, 1 or more; inner nodes at that depth count as leaves of their whole size.

        Raises:
            DamagedDataError: masks so far are cut off or contradict each other.
        """
        if not 1 <= depth <= self.head.geometry.depth:
            raise BadInputError("bad_depth", f"depth must be 1 to {self.head.geometry.depth}, got {depth}")
        return self.octree() if depth == self.head.geometry.depth else self._parts.topology(depth)

    def counts(self) -> npt.NDArray[np.int32]:
        """(N, 2) hits and misses of the leaves.

        Raises:
            DamagedDataError: damaged, or a count out of range.
        """
        return self._parts.counts

    def channel(self, c: int) -> ChannelRows:
        """Samples of channel number c.

        Raises:
            DamagedDataError: damaged.
            BadInputError: kind `too_large`: more samples than `sampled_max`.
        """
        return self._parts.channel(c, self.sampled_max)

    def bricks(self, first: int, stop: int) -> CellContent:
        """Content of the bricks of 8^3 voxels from `first` to before `stop`; leaves that reach beyond are cut off.

        The octree is read whole. Of the other streams, unless they are modelled, only the counts of these leaves are
        decoded, and the samples up to them: each sum is coded as a difference to the one before.

        Raises:
            BadInputError: kind `bad_depth`: no such bricks; or as `content`.
            DamagedDataError: as `content`.
        """
        # Leaves [lo, hi) touch the voxels [low, high).
        head, octree, parts = self.head, self.octree(), self._parts
        if not 0 <= first <= stop <= 8 ** (head.geometry.depth - BRICK_DEPTH):
            raise BadInputError("bad_depth", f"a cell of depth {head.geometry.depth} has no bricks {first} to {stop}")
        low, high = first << 3 * BRICK_DEPTH, stop << 3 * BRICK_DEPTH
        begins = octree.starts.astype(np.int64)
        lo, hi = int(np.searchsorted(begins + octree.sizes, low, "right")), int(np.searchsorted(begins, high))
        hi = max(lo, hi)
        # Their counts and samples.
        counts = parts.counts_between(lo, hi)
        channels = [
            _between(parts.channel_before(c, hi, self.sampled_max), lo, hi) for c in range(len(head.geometry.channels))
        ]
        sampled, samples = channel_streams.join_samples(
            channels, head.geometry, leaves=hi - lo, signed=head.signed, sampled_max=self.sampled_max
        )
        # Leaves cut off at the first and the last brick.
        starts = np.maximum(begins[lo:hi], low)
        sizes = np.minimum(begins[lo:hi] + octree.sizes[lo:hi], high) - starts
        part = Octree(octree.child_masks, octree.leaf_masks, starts.astype(np.uint32), sizes)
        return CellContent(part, counts, sampled, samples)

    def content(self) -> CellContent:
        """Content of the whole cell.

        Raises:
            DamagedDataError: damaged.
            BadInputError: kind `too_large`.
        """
        head, parts = self.head, self._parts
        if self.is_plain:
            parts.read_raw(list(self.stored))
            self._plain = plain_content(head, self.head_bytes, parts.raw, sampled_max=self.sampled_max)
            return self._plain.content
        octree, counts = self.octree(), self.counts()
        channels = [self.channel(c) for c in range(len(head.geometry.channels))]
        if len(parts.raw) != len(self.stored):
            raise DamagedDataError("bad_stream", "there are streams that no channel owns")
        sampled, samples = channel_streams.join_samples(
            channels, head.geometry, leaves=head.leaves, signed=head.signed, sampled_max=self.sampled_max
        )
        return CellContent(octree, counts, sampled, samples)

    def is_canonical(self, content: CellContent) -> bool | None:
        """True if these bytes are the canonical form of their content; None if only encoding it again can decide."""
        if self._plain is None:
            return None
        is_fewest = self._plain.is_fewest and content.is_collapsed(self.head.geometry)
        return is_fewest and is_canonical_head(self.head, self.head_bytes)

    def canonical_bytes(self) -> bytes:
        """Bytes over which the digest is taken; the whole content was read before."""
        if self._plain is not None:
            return self._plain.canonical
        # In the order of the stored streams, which is that of their numbers.
        return canonical_bytes(self.head_bytes, {number: self._parts.raw[number] for number in self.stored})


def cell_reader(data: bytes, *, evidence_bytes_max: int = EVIDENCE_BYTES_MAX) -> CellReader:
    """Reader of one cell's bytes; the head and the sizes are checked.

    Raises:
        DamagedDataError: cut off or contradictory.
        BadInputError: a version or kind of cell that this reader does not know, or too large.
    """
    if len(data) > CELL_BYTES_MAX:
        raise BadInputError("too_large", f"a cell has at most {CELL_BYTES_MAX} bytes, got {len(data)}")
    head, head_bytes = decode_head(data)
    sampled_max = sampled_max_of(head, evidence_bytes_max)
    stored = split_streams(
        data[len(head_bytes) :], count=head.streams, raw_bytes_max=min(RAW_BYTES_MAX, head.raw_bytes_max)
    )
    check_efforts(head, stored)
    return CellReader(head, head_bytes, stored, sampled_max, is_plain(head, stored))


def sampled_max_of(head: CellHead, evidence_bytes_max: int) -> int:
    """Largest number of leaves with samples for which a cell's evidence stays within a bound.

    Raises:
        BadInputError: kind `too_large`: its voxels alone are too many.
    """
    sampled_max = (evidence_bytes_max - VOXEL_BYTES * head.voxels) // (4 + 8 * head.geometry.plane_count)
    if sampled_max < 0:
        raise BadInputError("too_large", f"{head.voxels} voxels are more than {evidence_bytes_max} bytes of evidence")
    return sampled_max


def check_efforts(head: CellHead, stored: dict[int, StoredStream]) -> None:
    """Refuse modelled groups with too few bytes for the numbers that the head claims, before anything is decoded.

    Raises:
        BadInputError: kind `too_large`.
    """
    if all(stream.coding != MODELLED for stream in stored.values()):
        return
    # Numbers that the first stream of each group stands for: masks, or one or more a leaf.
    masks = sum(stored[number].raw_bytes for number in (CHILD_MASKS, LEAF_MASKS) if number in stored)
    firsts = [HITS, *(stream_of_channel(c) for c in range(len(head.geometry.channels)))]
    for first, numbers in {CHILD_MASKS: masks, **dict.fromkeys(firsts, head.leaves)}.items():
        if first in stored and stored[first].coding == MODELLED:
            check_effort(numbers, stored[first].body)


class _Parts:
    """Decoded parts of one cell: each is decoded when it is first read, after those on which it is modelled."""

    def __init__(self, head: CellHead, stored: dict[int, StoredStream]) -> None:
        self._head = head
        self._stored = stored
        self._channels: dict[int, ChannelRows] = {}
        self.raw: dict[int, bytes] = {}
        """Raw streams of the parts decoded so far."""

    @cached_property
    def octree(self) -> Octree:
        octree = self.topology(self._head.geometry.depth)
        if len(octree.starts) != self._head.leaves or int(octree.sizes.sum()) != self._head.voxels:
            raise DamagedDataError("bad_cell", "the octree has other numbers of voxels or leaves than the head names")
        self.raw |= topology_streams(octree)
        return octree

    @cached_property
    def counts(self) -> npt.NDArray[np.int32]:
        signed = self._head.signed
        if not self._is_modelled([HITS, MISSES]):
            self.read_raw([HITS, MISSES])
            return counts_of_streams(self.raw, leaves=self._head.leaves, signed=signed)
        counts = small_profile.decode_counts(self._stream(HITS).body, self._ground)
        self._encode_again(count_streams(counts, signed=signed))
        return counts

    @cached_property
    def _ground(self) -> Ground:
        """Places of the leaves, on which counts and samples are modelled."""
        return small_profile.ground_of(self.octree, depth=self._head.geometry.depth)

    def topology(self, stop: int) -> Octree:
        """The octree down to depth `stop`; its raw streams are not kept."""
        depth = self._head.geometry.depth
        if self._is_modelled([CHILD_MASKS, LEAF_MASKS]):
            child_masks, leaf_masks = small_profile.decode_masks(
                self._stream(CHILD_MASKS).body,
                child_count=self._stream(CHILD_MASKS).raw_bytes,
                leaf_count=self._stream(LEAF_MASKS).raw_bytes,
                depth=depth,
                stop=stop,
            )
        else:
            # No octree has more inner nodes above `stop`, one byte each.
            most = (8**stop - 1) // 7 if stop < depth else RAW_BYTES_MAX
            child_masks, leaf_masks = (
                np.frombuffer(_prefix(self._stream(number), most), np.uint8) for number in (CHILD_MASKS, LEAF_MASKS)
            )
        return parse_octree(child_masks, leaf_masks, depth=depth, stop=stop)

    def counts_between(self, lo: int, hi: int) -> npt.NDArray[np.int32]:
        """(hi - lo, 2) counts of the leaves from `lo` to before `hi`."""
        if self._is_modelled([HITS, MISSES]):
            return self.counts[lo:hi]
        self.read_raw([HITS, MISSES])
        return counts_of_streams(self.raw, leaves=self._head.leaves, signed=self._head.signed, part=slice(lo, hi))

    def channel(self, c: int, sampled_max: int) -> ChannelRows:
        """Samples of all leaves."""
        if c not in self._channels:
            is_modelled = self._is_channel_modelled(c)
            self._channels[c] = (
                self._modelled_channel(c, sampled_max) if is_modelled else self._raw_channel(c, sampled_max, None)
            )
        return self._channels[c]

    def channel_before(self, c: int, stop: int, sampled_max: int) -> ChannelRows:
        """Samples of the leaves before `stop` at least: of all, if the channel is decoded already or modelled."""
        if c in self._channels or self._is_channel_modelled(c):
            return self.channel(c, sampled_max)
        return self._raw_channel(c, sampled_max, stop)

    def read_raw(self, numbers: list[int]) -> None:
        """Decompress streams into `raw`."""
        for number in numbers:
            self.raw[number] = self._stream(number).raw()

    def _raw_channel(self, c: int, sampled_max: int, stop: int | None) -> ChannelRows:
        head, numbers = self._head, self._numbers_of(c)
        self.read_raw(numbers)
        return channel_streams.decode_channel(
            numbers[0],
            head.geometry.channels[c],
            self.raw,
            leaves=head.leaves,
            signed=head.signed,
            sampled_max=sampled_max,
            stop=stop,
        )

    def _modelled_channel(self, c: int, sampled_max: int) -> ChannelRows:
        head, channel, first = self._head, self._head.geometry.channels[c], stream_of_channel(c)
        # Its model: weights of the channel before, hits, and the neighbours of each leaf.
        before = np.zeros(head.leaves, np.int64)
        if c > 0:
            before = small_profile.weights_by_leaf(self.channel(c - 1, sampled_max), head.leaves)
        rows = small_profile.decode_channel(
            self._stream(first).body,
            channel,
            self.counts[:, 0].copy(),
            before,
            self._ground,
            check_count=lambda count: channel_streams.check_count(count, sampled_max),
        )
        self._encode_again(channel_streams.encode_channel(first, channel, rows, leaves=head.leaves, signed=head.signed))
        return rows

    def _is_channel_modelled(self, c: int) -> bool:
        has_votes = self._head.geometry.channels[c].kind is ChannelKind.CLASSES
        return self._is_modelled(self._numbers_of(c), has_votes=has_votes)

    def _numbers_of(self, c: int) -> list[int]:
        """Numbers of a channel's streams: presence, weight and values."""
        first = stream_of_channel(c)
        return list(range(first, first + stream_count(self._head.geometry.channels[c])))

    def _stream(self, number: int) -> StoredStream:
        if number not in self._stored:
            raise DamagedDataError("bad_stream", f"stream {number} is missing")
        return self._stored[number]

    def _is_modelled(self, numbers: list[int], *, has_votes: bool = False) -> bool:
        """True if a group is modelled: all of its streams or none, and only the first has bytes."""
        group = [self._stream(number) for number in numbers]
        modelled = [stream for stream in group if stream.coding == MODELLED]
        if not modelled:
            return False
        if len(modelled) < len(group) or any(stream.body for stream in group[1:]) or self._head.signed:
            raise DamagedDataError("bad_stream", f"streams {numbers} are modelled in part, or in a signed cell")
        if has_votes:
            raise DamagedDataError("bad_stream", f"streams {numbers} are votes for classes, which have no model")
        return True

    def _encode_again(self, streams: dict[int, bytes]) -> None:
        """Keep the raw streams of modelled numbers, which have the lengths that their heads state."""
        for number, raw in streams.items():
            if len(raw) != self._stream(number).raw_bytes:
                raise DamagedDataError("bad_stream", f"stream {number} is modelled, but not of the stated length")
            self.raw[number] = raw


def _between(rows: ChannelRows, first: int, stop: int) -> ChannelRows:
    """Rows of the leaves from `first` to before `stop`, numbered from `first` on."""
    part = slice(*np.searchsorted(rows.leaves, [first, stop]))
    return ChannelRows(rows.leaves[part] - first, rows.sums[part])


def _prefix(stream: StoredStream, most: int) -> bytes:
    """The first `most` raw bytes of a stream, or all of them."""
    if stream.raw_bytes <= most or stream.coding not in (STORED, ZSTD):
        return stream.raw()
    return zstd_prefix(stream.body, size_bytes=most) if stream.coding == ZSTD else stream.body[:most]
