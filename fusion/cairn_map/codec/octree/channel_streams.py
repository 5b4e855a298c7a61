"""Streams of a cell's samples: for each channel the presence of samples by leaf, their weights, and their sums.

    presence  one bit per leaf, lowest bit first      weight  like a count
    sum       residual against the previous voxel's mean times this voxel's weight
    square    residual against the sum of squares of equal samples

Streams of channel c start at number 16 + 8 c: presence, weight, then the value planes in order (FORMAT.md section 6).
Votes for classes have streams of their own in place of the value planes (`vote_streams`).
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cairn_map.arrays import Ints
from cairn_map.codec.octree import vote_streams
from cairn_map.codec.octree.streams import column_planes, encode_column, required
from cairn_map.codec.octree.sum_kernels import (
    place_sums_into,
    predict_sums,
    restore_squares_into,
    restore_sums_into,
    square_guesses,
)
from cairn_map.codec.octree.word_columns import numbers_into, words, zigzag
from cairn_map.errors import BadInputError, DamagedDataError
from cairn_map.evidence.channels import Channel, ChannelKind
from cairn_map.evidence.evidence import SUM_MAX
from cairn_map.evidence.grid import Geometry

FIRST_STREAM = 16
STREAMS_PER_CHANNEL = 8


@dataclass(frozen=True, slots=True, eq=False)
class ChannelRows:
    """The samples of one channel: (S,) leaves that have some, rising, and their (S, planes) sums."""

    leaves: Ints
    sums: Ints


def stream_of_channel(c: int) -> int:
    """Number of the first stream of the channel number c."""
    return FIRST_STREAM + STREAMS_PER_CHANNEL * c


def stream_count(channel: Channel) -> int:
    """Number of a channel's streams."""
    return 2 + (vote_streams.STREAMS if channel.kind is ChannelKind.CLASSES else len(channel.planes) - 1)


def split_samples(sampled: Ints, samples: Ints, geometry: Geometry) -> list[ChannelRows]:
    """Rows of each channel, of the (S, P) samples of (S,) leaves."""
    found: list[ChannelRows] = []
    for channel in geometry.channels:
        sums = samples[:, geometry.planes_of(channel.name)]
        present = np.nonzero(_says_something(sums))[0]
        found.append(ChannelRows(sampled[present], sums[present]))
    return found


def join_samples(
    channels: list[ChannelRows], geometry: Geometry, *, leaves: int, signed: bool, sampled_max: int
) -> tuple[Ints, Ints]:
    """(S,) leaves that have samples, rising, and (S, P) samples; the mirror of `split_samples`.

    Raises:
        DamagedDataError: a row of zeros, or a sum out of range.
        BadInputError: kind `too_large`: more than `sampled_max` leaves have samples.
    """
    has_samples = np.zeros(leaves, np.bool_)
    for rows in channels:
        has_samples[rows.leaves] = True
    sampled = np.nonzero(has_samples)[0]
    check_count(len(sampled), sampled_max)
    samples = np.zeros((len(sampled), geometry.plane_count), np.int64)
    low = -SUM_MAX if signed else 0
    for channel, rows in zip(geometry.channels, channels, strict=True):
        own = samples[:, geometry.planes_of(channel.name)]
        if not place_sums_into(rows.leaves, rows.sums, sampled, own, low, SUM_MAX):
            raise DamagedDataError("bad_stream", f"channel {channel.name} holds a sum that is zero or out of range")
    return sampled, samples


def encode_channel(number: int, channel: Channel, rows: ChannelRows, *, leaves: int, signed: bool) -> dict[int, bytes]:
    """Raw streams of one channel; the first has this number."""
    bits = np.zeros(leaves, np.uint8)
    bits[rows.leaves] = 1
    planes = np.ascontiguousarray(rows.sums.T)
    weights = planes[-1]
    streams = {number: np.packbits(bits, bitorder="little").tobytes()}
    streams[number + 1] = encode_column(words(weights, signed))
    if channel.kind is ChannelKind.CLASSES:
        return streams | vote_streams.encode_votes(number + 2, rows.sums[:, :-1], signed=signed)
    for p in range(channel.value_count):
        streams[number + 2 + p] = encode_column(predict_sums(planes[p], weights))
    if "square_sum" in channel.planes:
        guesses = square_guesses(planes[0], weights)
        streams[number + 3] = encode_column(zigzag(planes[1].astype(np.uint64) - guesses))
    return streams


def decode_channel(
    number: int,
    channel: Channel,
    streams: dict[int, bytes],
    *,
    leaves: int,
    signed: bool,
    sampled_max: int,
    stop: int | None = None,
) -> ChannelRows:
    """Rows of one channel's streams; the mirror of `encode_channel`. Sums may be out of range: `join_samples` checks.

    With `stop`, only rows of the leaves before it: each row is a residual against the row before, so none before can
    be skipped.

    Raises:
        DamagedDataError: a stream is missing or of the wrong length.
        BadInputError: kind `too_large`: more than `sampled_max` leaves have samples.
    """
    present = np.nonzero(_presence(required(streams, number), leaves))[0]
    count = len(present)
    check_count(count, sampled_max)
    last = count if stop is None else int(np.searchsorted(present, stop))
    if channel.kind is ChannelKind.CLASSES:
        sums = np.zeros((last, len(channel.planes)), np.int64)
        weights = column_planes(required(streams, number + 1), rows=count)
        numbers_into(sums[:, -1], weights[:, :last], signed=signed, limit=SUM_MAX)
        vote_streams.decode_votes_into(sums[:, :-1], number + 2, streams, rows=count, signed=signed)
        return ChannelRows(present[:last], sums)
    sums = np.empty((last, len(channel.planes)), np.int64)
    columns = [column_planes(required(streams, number + 1 + p), rows=count) for p in range(len(channel.planes))]
    numbers_into(sums[:, -1], columns[0][:, :last], signed=signed, limit=SUM_MAX)
    for p in range(channel.value_count):
        restore_sums_into(sums, p, columns[1 + p])
    if "square_sum" in channel.planes:
        restore_squares_into(sums, columns[2])
    return ChannelRows(present[:last], sums)


def check_count(count: int, sampled_max: int) -> None:
    """Refuse more rows than a reader wants.

    Raises:
        BadInputError: kind `too_large`.
    """
    if count > sampled_max:
        raise BadInputError("too_large", f"{count} voxels with samples, at most {sampled_max} are read")


def _says_something(sums: Ints) -> npt.NDArray[np.bool_]:
    """(S,) True for rows that are not all zeros: nearly always those with a weight."""
    says = sums[:, -1] != 0
    return says if says.all() else np.asarray(says | sums.any(axis=1))


def _presence(raw: bytes, leaves: int) -> npt.NDArray[np.bool_]:
    if len(raw) != (leaves + 7) // 8:
        raise DamagedDataError("bad_stream", f"presence of {leaves} leaves needs {(leaves + 7) // 8} bytes")
    bits = np.unpackbits(np.frombuffer(raw, np.uint8), bitorder="little")
    if bits[leaves:].any():
        raise DamagedDataError("bad_stream", "presence bits beyond the last leaf must be 0")
    return bits[:leaves].view(np.bool_)
