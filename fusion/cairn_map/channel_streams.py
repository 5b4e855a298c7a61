"""A cell's samples as streams: for each channel which leaves have some, their weights, and their sums.

    presence  one bit per leaf, lowest bit first      weight  like a count
    sum       residual against the previous voxel's mean times this voxel's weight
    square    residual against what it were if all samples were alike

Streams of channel c start at number 16 + 8 c: presence, weight, then the value planes in order.
"""

import numpy as np
import numpy.typing as npt

from cairn_map.errors import BadInputError, DamagedDataError
from cairn_map.evidence import SUM_MAX
from cairn_map.grid import Geometry
from cairn_map.octree_kernels import predict_sums, restore_sums, square_guesses
from cairn_map.streams import decode_column, encode_column

Ints = npt.NDArray[np.int64]
Words = npt.NDArray[np.uint64]

FIRST_STREAM = 16
STREAMS_PER_CHANNEL = 8


def encode_channels(
    leaf_rows: Ints, samples: Ints, geometry: Geometry, *, leaves: int, signed: bool
) -> dict[int, bytes]:
    """Streams of all channels; `leaf_rows` (S,) names the leaf of each row of `samples`."""
    streams: dict[int, bytes] = {}
    for c, channel in enumerate(geometry.channels):
        sums = samples[:, geometry.planes_of(channel.name)]
        present = (sums != 0).any(axis=1)
        sums = sums[present]
        bits = np.zeros(leaves, np.uint8)
        bits[leaf_rows[present]] = 1
        number = FIRST_STREAM + STREAMS_PER_CHANNEL * c
        weights = np.ascontiguousarray(sums[:, -1])
        streams[number] = np.packbits(bits, bitorder="little").tobytes()
        streams[number + 1] = encode_column(words(weights, signed))
        for p in range(channel.value_count):
            plane = np.ascontiguousarray(sums[:, p])
            streams[number + 2 + p] = encode_column(predict_sums(plane, weights))
        if "square_sum" in channel.planes:
            guesses = square_guesses(np.ascontiguousarray(sums[:, 0]), weights)
            streams[number + 3] = encode_column(_zigzag(sums[:, 1].astype(np.uint64) - guesses))
    return streams


def decode_channels(
    streams: dict[int, bytes], geometry: Geometry, *, leaves: int, signed: bool, sampled_max: int
) -> tuple[Ints, Ints]:
    """(S,) leaves that have samples, rising, and (S, P) samples; the mirror of `encode_channels`.

    Raises:
        DamagedDataError: a stream is missing, of the wrong length, or a sum is out of range.
        BadInputError: kind `too_large`: more than `sampled_max` leaves have samples.
    """
    presences = [_presence(streams, c, leaves) for c in range(len(geometry.channels))]
    any_present = np.zeros(leaves, np.bool_)
    for present in presences:
        any_present |= present
    places = np.nonzero(any_present)[0]
    if len(places) > sampled_max:
        raise BadInputError("too_large", f"{len(places)} voxels with samples, at most {sampled_max} are read")
    samples = np.zeros((len(places), geometry.plane_count), np.int64)
    for c, channel in enumerate(geometry.channels):
        rows = np.nonzero(presences[c][places])[0]
        number = FIRST_STREAM + STREAMS_PER_CHANNEL * c
        weights = numbers(_column(streams, number + 1, len(rows)), signed, limit=SUM_MAX)
        planes = [
            restore_sums(_column(streams, number + 2 + p, len(rows)), weights) for p in range(channel.value_count)
        ]
        if "square_sum" in channel.planes:
            residuals = _unzigzag(_column(streams, number + 3, len(rows)))
            planes.append((residuals + square_guesses(planes[0], weights)).astype(np.int64))
        sums = np.stack([*planes, weights], axis=1)
        low = -SUM_MAX if signed else 0
        if (sums < low).any() or (sums > SUM_MAX).any() or not (sums != 0).any(axis=1).all():
            raise DamagedDataError("bad_stream", f"channel {channel.name} holds a sum that is zero or out of range")
        samples[rows, geometry.planes_of(channel.name)] = sums
    if len(streams) != 4 + sum(2 + len(channel.planes) - 1 for channel in geometry.channels):
        raise DamagedDataError("bad_stream", "there are streams that no channel owns")
    return places, samples


def words(values: Ints, signed: bool) -> Words:
    """Counts and weights as words: as they are, or zigzag where differences may be negative."""
    raw = values.astype(np.uint64)
    return _zigzag(raw) if signed else raw


def numbers(raw: Words, signed: bool, *, limit: int) -> Ints:
    """The mirror of `words`.

    Raises:
        DamagedDataError: a magnitude above `limit`.
    """
    values = (_unzigzag(raw) if signed else raw).astype(np.int64)
    if (values > limit).any() or (values < (-limit if signed else 0)).any():
        raise DamagedDataError("bad_stream", f"a count or weight is beyond {limit}")
    return values


def required(streams: dict[int, bytes], number: int) -> bytes:
    """One stream.

    Raises:
        DamagedDataError: it is missing.
    """
    try:
        return streams[number]
    except KeyError:
        raise DamagedDataError("bad_stream", f"stream {number} is missing") from None


def _column(streams: dict[int, bytes], number: int, rows: int) -> Words:
    return decode_column(required(streams, number), rows=rows)


def _presence(streams: dict[int, bytes], c: int, leaves: int) -> npt.NDArray[np.bool_]:
    raw = required(streams, FIRST_STREAM + STREAMS_PER_CHANNEL * c)
    if len(raw) != (leaves + 7) // 8:
        raise DamagedDataError("bad_stream", f"presence of {leaves} leaves needs {(leaves + 7) // 8} bytes")
    bits = np.unpackbits(np.frombuffer(raw, np.uint8), bitorder="little")
    if bits[leaves:].any():
        raise DamagedDataError("bad_stream", "presence bits beyond the last leaf must be 0")
    return bits[:leaves].astype(np.bool_)


def _zigzag(raw: Words) -> Words:
    return (raw << np.uint64(1)) ^ (np.uint64(0) - (raw >> np.uint64(63)))


def _unzigzag(raw: Words) -> Words:
    return (raw >> np.uint64(1)) ^ (np.uint64(0) - (raw & np.uint64(1)))
