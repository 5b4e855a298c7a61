"""The head of a cell's file: its cell number, its grid, its channels, and the sizes of the rest (FORMAT.md section 6).

It is read first, and by its claims alone a reader refuses cells that would be too large: `CellHead` bounds the voxels,
the leaves and the raw bytes of all streams together.
"""

import struct
from dataclasses import dataclass
from functools import lru_cache

from pydantic import ValidationError

from cairn_map.errors import BadInputError, DamagedDataError
from cairn_map.evidence.channels import CODE_OF_KIND, Channel, ChannelKind
from cairn_map.evidence.grid import CELL_LIMIT, CellKey, Geometry, cell_key, cell_of_key

MAGIC = b"CRNC"
VERSION = 1
KIND_EVIDENCE = 1
KIND_LEVEL = 3
"""Kind of a cell of evidence with flat voxels: their height follows the fixed part."""
HEIGHT_STEP = struct.Struct("<I")
KNOWN_KINDS = (KIND_EVIDENCE, KIND_LEVEL)
FLAG_SIGNED = 1
FIXED_PART = struct.Struct("<4sBBBBIiiiIIBB")
INDICES_AT = struct.calcsize("<4sBBBBI")
"""Offset of the three indices of the cell, bytes."""
CHANNEL_SIZES = struct.Struct("<BBB")
CHANNEL_SCALE = struct.Struct("<dd")
LENGTH = struct.Struct("<B")
KIND_OF_CODE = {code: kind for kind, code in CODE_OF_KIND.items()}


@dataclass(frozen=True, slots=True, kw_only=True)
class CellHead:
    """Fields of a cell's head."""

    key: CellKey
    geometry: Geometry
    voxels: int
    leaves: int
    streams: int
    signed: bool

    @property
    def raw_bytes_max(self) -> int:
        """Largest size of all raw streams together of a cell with so many leaves (FORMAT.md section 11).

        Every inner node has a leaf of its own below it at each depth, so no depth has more inner nodes than leaves.
        """
        # Votes for classes have a column of classes more, and one of how many there are in a row.
        columns = 2 + self.geometry.plane_count
        columns += sum(channel.value_count + 1 for channel in self.geometry.channels if channel.classes)
        masks = (2 * self.geometry.depth - 1) * self.leaves
        presence = len(self.geometry.channels) * ((self.leaves + 7) // 8)
        return masks + presence + columns * (1 + 8 * self.leaves)


def encode_head(head: CellHead) -> bytes:
    """Bytes of a head."""
    data = FIXED_PART.pack(
        MAGIC,
        VERSION,
        kind_of(head.geometry),
        head.geometry.depth,
        FLAG_SIGNED if head.signed else 0,
        head.geometry.voxel_edge_um,
        *cell_of_key(head.key),
        head.voxels,
        head.leaves,
        len(head.geometry.channels),
        head.streams,
    )
    return data + height_to_bytes(head.geometry) + channels_to_bytes(head.geometry)


def kind_of(geometry: Geometry) -> int:
    """Kind byte of a geometry's cells."""
    return KIND_LEVEL if geometry.is_flat else KIND_EVIDENCE


def height_to_bytes(geometry: Geometry) -> bytes:
    """Height of flat voxels, as it stands in a head before the channels; nothing of cubes."""
    return b"" if geometry.height_step_um is None else HEIGHT_STEP.pack(geometry.height_step_um)


def height_from_bytes(data: bytes, at: int, kind: int) -> tuple[int | None, int]:
    """Height of a voxel of a cell of this kind, micrometres, None of a cube, and the offset behind it.

    Raises:
        struct.error: cut off.
    """
    if kind != KIND_LEVEL:
        return None, at
    return int(HEIGHT_STEP.unpack_from(data, at)[0]), at + HEIGHT_STEP.size


def channels_to_bytes(geometry: Geometry) -> bytes:
    """Descriptors of a geometry's channels, as they stand in a head."""
    data = b""
    for channel in geometry.channels:
        name, unit = channel.name.encode(), channel.unit.encode()
        data += CHANNEL_SIZES.pack(CODE_OF_KIND[channel.kind], len(name), len(unit)) + name + unit
        data += CHANNEL_SCALE.pack(channel.step, channel.zero)
        if channel.kind is ChannelKind.CLASSES:
            texts = [one.encode() for one in channel.classes]
            data += bytes([len(texts)]) + b"".join(bytes([len(text)]) + text for text in texts)
    return data


def head_sizes(data: bytes) -> tuple[int, int, int]:
    """Depth, voxels and leaves that a head claims, from its fixed part alone, of bytes that `decode_head` reads.

    Raises:
        DamagedDataError: cut off.
    """
    if len(data) < FIXED_PART.size or data[:4] != MAGIC:
        raise DamagedDataError("bad_cell", "not a cairn cell: it must begin with CRNC and a whole head")
    _, _, _, depth, _, _, _, _, _, voxels, leaves, _, _ = FIXED_PART.unpack_from(data)
    return depth, voxels, leaves


def decode_head(data: bytes) -> tuple[CellHead, bytes]:
    """Head at the start of a cell's bytes, and the bytes of the head alone.

    Raises:
        DamagedDataError: cut off, contradictory or out of range.
        BadInputError: a version or kind of cell that this reader does not know.
    """
    if len(data) < FIXED_PART.size or data[:4] != MAGIC:
        raise DamagedDataError("bad_cell", "not a cairn cell: it must begin with CRNC and a whole head")
    _, version, kind, depth, flags, edge_um, i, j, k, voxels, leaves, channel_count, streams = FIXED_PART.unpack_from(
        data
    )
    # The fixed part; then the channels, whose lengths are in their own heads.
    if version != VERSION or kind not in KNOWN_KINDS:
        raise BadInputError(
            "unknown_version", f"this reader knows cells of version 1, kind 1 and 3; got {version}, {kind}"
        )
    if flags & ~FLAG_SIGNED or not all(-CELL_LIMIT <= v < CELL_LIMIT for v in (i, j, k)):
        raise DamagedDataError("bad_cell", "unknown flags, or a cell number out of range")
    try:
        step_um, start = height_from_bytes(data, FIXED_PART.size, kind)
        at = end_of_channels(data, start, channel_count)
        geometry = _geometry(edge_um, step_um, depth, channel_count, data[start:at])
    except (struct.error, UnicodeDecodeError, ValidationError) as exc:
        raise DamagedDataError("bad_cell", f"the cell's head is damaged: {str(exc).splitlines()[0]}") from exc
    if not leaves <= voxels <= 8**depth:
        raise DamagedDataError("bad_cell", f"{voxels} voxels in {leaves} leaves do not fit a cell of depth {depth}")
    head = CellHead(
        key=cell_key((i, j, k)),
        geometry=geometry,
        voxels=voxels,
        leaves=leaves,
        streams=streams,
        signed=bool(flags & FLAG_SIGNED),
    )
    return head, data[:at]


def end_of_channels(data: bytes, at: int, count: int) -> int:
    """Offset behind so many descriptors of channels.

    Raises:
        struct.error: cut off.
    """
    for _ in range(count):
        code, name_bytes, unit_bytes = CHANNEL_SIZES.unpack_from(data, at)
        at += CHANNEL_SIZES.size + name_bytes + unit_bytes + CHANNEL_SCALE.size
        if code == CODE_OF_KIND[ChannelKind.CLASSES]:
            _, at = _classes(data, at)
    return at


def channels_from_bytes(data: bytes, count: int) -> tuple[Channel, ...]:
    """Channels of their descriptors; the mirror of `channels_to_bytes`.

    Raises:
        struct.error, UnicodeDecodeError, ValidationError: cut off, or not channels.
    """
    channels: list[Channel] = []
    at = 0
    for _ in range(count):
        channel, at = _channel(data, at)
        channels.append(channel)
    return tuple(channels)


def is_canonical_head(head: CellHead, data: bytes) -> bool:
    """True if a head's own bytes, as `decode_head` gave them, are those that `encode_head` makes of it."""
    start = FIXED_PART.size + len(height_to_bytes(head.geometry))
    return _is_canonical(head.geometry, data[start:])  # pyright: ignore[reportArgumentType]


@lru_cache(maxsize=16)
def _is_canonical(geometry: Geometry, data: bytes) -> bool:
    """True for canonical channels; the numbers before them have one form only."""
    return channels_to_bytes(geometry) == data


@lru_cache(maxsize=16)
def _geometry(edge_um: int, step_um: int | None, depth: int, channel_count: int, data: bytes) -> Geometry:
    """Geometry of a head; cached, because all cells of a map have the same one."""
    channels = channels_from_bytes(data, channel_count)
    return Geometry(voxel_edge_um=edge_um, height_step_um=step_um, depth=depth, channels=channels)


def _channel(data: bytes, at: int) -> tuple[Channel, int]:
    code, name_bytes, unit_bytes = CHANNEL_SIZES.unpack_from(data, at)
    at += CHANNEL_SIZES.size
    name, unit = data[at : at + name_bytes], data[at + name_bytes : at + name_bytes + unit_bytes]
    at += name_bytes + unit_bytes
    step, zero = CHANNEL_SCALE.unpack_from(data, at)
    at += CHANNEL_SCALE.size
    classes: list[str] = []
    if code == CODE_OF_KIND[ChannelKind.CLASSES]:
        classes, at = _classes(data, at)
    fields = {"kind": KIND_OF_CODE.get(code), "name": name.decode(), "unit": unit.decode(), "step": step, "zero": zero}
    return Channel.model_validate(fields | {"classes": classes}), at


def _classes(data: bytes, at: int) -> tuple[list[str], int]:
    """Names of a channel's classes, and the offset behind them; each has its length before it."""
    (count,) = LENGTH.unpack_from(data, at)
    at += LENGTH.size
    names: list[str] = []
    for _ in range(count):
        (length,) = LENGTH.unpack_from(data, at)
        at += LENGTH.size + length
        if at > len(data):
            raise struct.error("the names of classes are cut off")
        names.append(data[at - length : at].decode())
    return names, at
