"""A cell's bytes, read as far as one asks: octree, counts, channels, each decoded when it is first wanted.

Groups of streams stand on those before them: masks, counts, channels. So who wants topology alone decodes nothing else,
and who wants temperatures skips colours, unless they are modelled on them. Beside the numbers come the raw streams,
which the digest is taken of: as they were read, or made anew from what a model said.
"""

from dataclasses import dataclass, field

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
from cairn_map.codec.octree.channel_streams import ChannelRows, stream_of_channel
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
from cairn_map.evidence.grid import BRICK_DEPTH

VOXEL_BYTES = 12
"""Of packed evidence: a voxel's number and two counts."""

CELL_BYTES_MAX = 1 << 28
"""Bytes of one encoded cell that a reader accepts."""
EVIDENCE_BYTES_MAX = 1 << 31
"""Bytes of one cell's packed evidence: the largest cell, full, with the standard channels in every voxel, has 1.4e9."""


@dataclass(slots=True, eq=False)
class CellReader:
    """One cell's bytes, of which nothing but the head is decoded yet; not thread-safe."""

    head: CellHead
    head_bytes: bytes
    stored: dict[int, StoredStream]
    sampled_max: int
    is_plain: bool = False
    """Whether all of it can be read at once (`plain_content`)."""
    raw: dict[int, bytes] = field(default_factory=dict)
    """Raw streams of what was read so far."""
    _octree: Octree | None = None
    _ground: Ground | None = None
    _counts: npt.NDArray[np.int32] | None = None
    _channels: dict[int, ChannelRows] = field(default_factory=dict)
    _plain: PlainCell | None = None

    def octree(self) -> Octree:
        """The whole octree.

        Raises:
            DamagedDataError: its masks contradict each other or the head.
        """
        if self._octree is None:
            octree = self._topology(self.head.geometry.depth)
            if len(octree.starts) != self.head.leaves or int(octree.sizes.sum()) != self.head.voxels:
                raise DamagedDataError(
                    "bad_cell", "the octree has other numbers of voxels or leaves than the head names"
                )
            self.raw |= topology_streams(octree)
            self._octree = octree
        return self._octree

    def topology(self, depth: int) -> Octree:
        """The octree no deeper than `depth`, 1 or more; what is inner there counts as a leaf of its whole size.

        Raises:
            DamagedDataError: masks so far are cut off or contradict each other.
        """
        if not 1 <= depth <= self.head.geometry.depth:
            raise BadInputError("bad_depth", f"depth must be 1 to {self.head.geometry.depth}, got {depth}")
        return self.octree() if depth == self.head.geometry.depth else self._topology(depth)

    def counts(self) -> npt.NDArray[np.int32]:
        """(N, 2) hits and misses of the leaves.

        Raises:
            DamagedDataError: damaged, or a count out of range.
        """
        if self._counts is None:
            octree, signed = self.octree(), self.head.signed
            if self._is_modelled([HITS, MISSES]):
                self._counts = small_profile.decode_counts(self.stored[HITS].body, self._ground_of(octree))
                self._remake(count_streams(self._counts, signed=signed))
            else:
                self._read([HITS, MISSES])
                self._counts = counts_of_streams(self.raw, leaves=self.head.leaves, signed=signed)
        return self._counts

    def channel(self, c: int) -> ChannelRows:
        """The samples of channel number c.

        Raises:
            DamagedDataError: damaged.
            BadInputError: kind `too_large`: more samples than `sampled_max`.
        """
        if c not in self._channels:
            head, channel = self.head, self.head.geometry.channels[c]
            first = channel_streams.stream_of_channel(c)
            numbers = list(range(first, first + 1 + len(channel.planes)))
            if self._is_modelled(numbers):
                before = np.zeros(head.leaves, np.int64)
                if c > 0:
                    before = small_profile.weights_by_leaf(self.channel(c - 1), head.leaves)
                rows = small_profile.decode_channel(
                    self.stored[first].body,
                    channel,
                    self.counts()[:, 0].copy(),
                    before,
                    self._ground_of(self.octree()),
                    check_count=lambda count: channel_streams.check_count(count, self.sampled_max),
                )
                again = channel_streams.encode_channel(first, channel, rows, leaves=head.leaves, signed=head.signed)
                self._remake(again)
            else:
                self._read(numbers)
                rows = channel_streams.decode_channel(
                    first, channel, self.raw, leaves=head.leaves, signed=head.signed, sampled_max=self.sampled_max
                )
            self._channels[c] = rows
        return self._channels[c]

    def bricks(self, first: int, stop: int) -> CellContent:
        """What bricks of 8^3 voxels hold, from number `first` to before `stop`; leaves that reach beyond are cut off.

        The octree is read whole. Of the other streams, unless they are modelled, only the counts of these leaves are,
        and the samples up to them: no sum can be told without those before it.

        Raises:
            BadInputError: kind `bad_depth`: no such bricks; or as `content`.
            DamagedDataError: as `content`.
        """
        head, octree = self.head, self.octree()
        if not 0 <= first <= stop <= 8 ** (head.geometry.depth - BRICK_DEPTH):
            raise BadInputError("bad_depth", f"a cell of depth {head.geometry.depth} has no bricks {first} to {stop}")
        low, high = first << 3 * BRICK_DEPTH, stop << 3 * BRICK_DEPTH
        begins = octree.starts.astype(np.int64)
        lo, hi = int(np.searchsorted(begins + octree.sizes, low, "right")), int(np.searchsorted(begins, high))
        hi = max(lo, hi)
        if self._is_modelled([HITS, MISSES]):
            counts = self.counts()[lo:hi]
        else:
            self._read([HITS, MISSES])
            counts = counts_of_streams(self.raw, leaves=head.leaves, signed=head.signed, part=slice(lo, hi))
        channels = [_between(self._channel_before(c, hi), lo, hi) for c in range(len(head.geometry.channels))]
        sampled, samples = channel_streams.join_samples(
            channels, head.geometry, leaves=hi - lo, signed=head.signed, sampled_max=self.sampled_max
        )
        starts = np.maximum(begins[lo:hi], low)
        sizes = np.minimum(begins[lo:hi] + octree.sizes[lo:hi], high) - starts
        part = Octree(octree.child_masks, octree.leaf_masks, starts.astype(np.uint32), sizes)
        return CellContent(part, counts, sampled, samples)

    def content(self) -> CellContent:
        """All of it.

        Raises:
            DamagedDataError: damaged.
            BadInputError: kind `too_large`.
        """
        head, channels = self.head, range(len(self.head.geometry.channels))
        if self.is_plain:
            self._read(list(self.stored))
            self._plain = plain_content(head, self.head_bytes, self.raw, sampled_max=self.sampled_max)
            return self._plain.content
        octree, counts = self.octree(), self.counts()
        parts = [self.channel(c) for c in channels]
        if len(self.raw) != len(self.stored):
            raise DamagedDataError("bad_stream", "there are streams that no channel owns")
        sampled, samples = channel_streams.join_samples(
            parts, head.geometry, leaves=head.leaves, signed=head.signed, sampled_max=self.sampled_max
        )
        return CellContent(octree, counts, sampled, samples)

    def is_canonical(self, content: CellContent) -> bool | None:
        """Whether these are the canonical form of what `content` gave; None if only coding it anew can tell."""
        if self._plain is None:
            return None
        is_fewest = self._plain.is_fewest and content.is_collapsed(self.head.geometry)
        return is_fewest and is_canonical_head(self.head, self.head_bytes)

    def canonical_bytes(self) -> bytes:
        """What the digest is taken of, once all of it was read."""
        if self._plain is not None:
            return self._plain.canonical
        # In the order in which streams stand, which is that of their numbers.
        return canonical_bytes(self.head_bytes, {number: self.raw[number] for number in self.stored})

    def forget(self) -> None:
        """Drop all that was read so far."""
        self.raw.clear()
        self._channels.clear()
        self._octree = self._ground = self._counts = self._plain = None

    def _channel_before(self, c: int, stop: int) -> ChannelRows:
        """The samples of the leaves before one, or of all."""
        first, channel = channel_streams.stream_of_channel(c), self.head.geometry.channels[c]
        numbers = list(range(first, first + 1 + len(channel.planes)))
        if c in self._channels or self._is_modelled(numbers):
            return self.channel(c)
        self._read(numbers)
        return channel_streams.decode_channel(
            first,
            channel,
            self.raw,
            leaves=self.head.leaves,
            signed=self.head.signed,
            sampled_max=self.sampled_max,
            stop=stop,
        )

    def _topology(self, stop: int) -> Octree:
        depth = self.head.geometry.depth
        if self._is_modelled([CHILD_MASKS, LEAF_MASKS]):
            child_masks, leaf_masks = small_profile.decode_masks(
                self.stored[CHILD_MASKS].body,
                child_count=self.stored[CHILD_MASKS].raw_bytes,
                leaf_count=self.stored[LEAF_MASKS].raw_bytes,
                depth=depth,
                stop=stop,
            )
        else:
            # No depth above `stop` has more nodes than that together.
            most = (8**stop - 1) // 7 if stop < depth else RAW_BYTES_MAX
            child_masks, leaf_masks = (
                np.frombuffer(_prefix(self._stored(number), most), np.uint8) for number in (CHILD_MASKS, LEAF_MASKS)
            )
        return parse_octree(child_masks, leaf_masks, depth=depth, stop=stop)

    def _ground_of(self, octree: Octree) -> Ground:
        if self._ground is None:
            self._ground = small_profile.ground_of(octree, depth=self.head.geometry.depth)
        return self._ground

    def _stored(self, number: int) -> StoredStream:
        if number not in self.stored:
            raise DamagedDataError("bad_stream", f"stream {number} is missing")
        return self.stored[number]

    def _is_modelled(self, numbers: list[int]) -> bool:
        """Whether a group is; all of it, or none, and only the first says something."""
        group = [self._stored(number) for number in numbers]
        modelled = [stream for stream in group if stream.coding == MODELLED]
        if not modelled:
            return False
        if len(modelled) < len(group) or any(stream.body for stream in group[1:]) or self.head.signed:
            raise DamagedDataError("bad_stream", f"streams {numbers} are modelled in part, or in a signed cell")
        return True

    def _read(self, numbers: list[int]) -> None:
        for number in numbers:
            self.raw[number] = self._stored(number).raw()

    def _remake(self, streams: dict[int, bytes]) -> None:
        for number, raw in streams.items():
            if len(raw) != self.stored[number].raw_bytes:
                raise DamagedDataError("bad_stream", f"stream {number} is modelled, but not of the stated length")
            self.raw[number] = raw


def cell_reader(data: bytes, *, evidence_bytes_max: int = EVIDENCE_BYTES_MAX) -> CellReader:
    """A reader of one cell's bytes; the head and the sizes are checked.

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


def _between(rows: ChannelRows, first: int, stop: int) -> ChannelRows:
    """Of the leaves from one to before another, numbered from the first on."""
    part = slice(*np.searchsorted(rows.leaves, [first, stop]))
    return ChannelRows(rows.leaves[part] - first, rows.sums[part])


def _prefix(stream: StoredStream, most: int) -> bytes:
    """The first raw bytes of a stream, or all of them."""
    if stream.raw_bytes <= most or stream.coding not in (STORED, ZSTD):
        return stream.raw()
    return zstd_prefix(stream.body, size_bytes=most) if stream.coding == ZSTD else stream.body[:most]


def sampled_max_of(head: CellHead, evidence_bytes_max: int) -> int:
    """How many leaves of a cell may have samples, so that its evidence stays within a bound.

    Raises:
        BadInputError: kind `too_large`: its voxels alone are too many.
    """
    sampled_max = (evidence_bytes_max - VOXEL_BYTES * head.voxels) // (4 + 8 * head.geometry.plane_count)
    if sampled_max < 0:
        raise BadInputError("too_large", f"{head.voxels} voxels are more than {evidence_bytes_max} bytes of evidence")
    return sampled_max


def check_efforts(head: CellHead, stored: dict[int, StoredStream]) -> None:
    """Refuse modelled groups of too few bytes on the head's word, before a leaf is looked for.

    Raises:
        BadInputError: kind `too_large`.
    """
    if all(stream.coding != MODELLED for stream in stored.values()):
        return
    masks = sum(stored[number].raw_bytes for number in (CHILD_MASKS, LEAF_MASKS) if number in stored)
    firsts = [HITS, *(stream_of_channel(c) for c in range(len(head.geometry.channels)))]
    for first, numbers in {CHILD_MASKS: masks, **dict.fromkeys(firsts, head.leaves)}.items():
        if first in stored and stored[first].coding == MODELLED:
            check_effort(numbers, stored[first].body)
