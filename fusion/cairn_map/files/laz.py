"""LAZ files of points: LAS 1.4 (ASPRS), compressed by LASzip, made part by part with the memory of one chunk.

Coordinates are whole numbers of half a node's edge, of each axis its own, so they are exact. Point format 7: colours
have 16 bits (8-bit sRGB times 256). Values for which LAS has no field are its extra bytes, each a float with its unit
in the description:

    probability        0 to 1
    temperature        kelvin, mean below the node; NaN where no thermal camera looked
    hottest            kelvin, the hottest voxel below the node
    times              UTC seconds since 1970 as a double, of a map with epochs; NaN where unknown

LASzip writes the offset of its chunk table into the file's head at the end. A head that is sent already cannot be
changed, and LASzip provides for that: the offset there is -1, and the file's last eight bytes hold it.
"""

import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import laspy
import lazrs as untyped_lazrs
import numpy as np
import numpy.typing as npt
from laspy.vlrs.known import LasZipVlr, WktCoordinateSystemVlr

from cairn_map.arrays import Floats
from cairn_map.files.forward_only_file import ForwardOnlyFile

Table = npt.NDArray[np.void]

lazrs: Any = untyped_lazrs
POINT_FORMAT = 7
EXTRA = {
    "probability": "0 to 1",
    "temperature": "kelvin, mean; NaN: not seen",
    "hottest": "kelvin, maximum; NaN: not seen",
}
"""Descriptions of the extra bytes, at most 31 letters each."""
TIME = "UTC s since 1970; NaN: unknown"
"""Description of a time."""
RETURN = 0x11
"""Bit field of a point: return number 1 of 1 return."""
COLOUR_STEP = 256
"""Factor from 8-bit to 16-bit colours."""


@dataclass(frozen=True, slots=True, eq=False)
class LazHead:
    """Facts of the file's head, which must be known before the first point is written."""

    count: int
    low_m: Floats
    """(3,) lowest and highest centre, metres, map frame; zeros without points."""
    high_m: Floats
    node_edges_m: tuple[float, float, float]
    """Edges of a node along x, y and z, metres; of a level layer the last one is its height."""
    frame: str
    """Name of the coordinate system."""
    times: tuple[str, ...] = ()
    """Names of the tables' fields that are times."""
    numbers: tuple[str, ...] = ()
    """Names of further fields, single precision."""


def laz_parts(head: LazHead, tables: Iterable[Table]) -> Iterator[bytes]:
    """Parts of a LAZ file; `tables` are (N,) of `point_clouds.POINT` and the times, `count` points."""
    sink, header = _Uncorrected(), _header(head)
    vlr = lazrs.LazVlr.new_for_compression(POINT_FORMAT, header.point_format.num_extra_bytes)
    header.vlrs.append(LasZipVlr(vlr.record_data()))
    header.write_to(sink)
    yield sink.taken()
    compressor = lazrs.LasZipCompressor(sink, vlr)
    for table in tables:
        rows = _rows(table, header.point_format.dtype(), head)
        compressor.compress_many(rows.view(np.uint8))
        yield sink.taken()
    compressor.done()
    yield sink.taken() + struct.pack("<q", sink.corrected if head.count else -1)


def _header(head: LazHead) -> Any:
    header = laspy.LasHeader(version="1.4", point_format=POINT_FORMAT)
    header.scales, header.offsets = np.array(head.node_edges_m) / 2, np.zeros(3)
    header.add_extra_dims([laspy.ExtraBytesParams(name, np.dtype("<f4"), description=EXTRA[name]) for name in EXTRA])
    header.add_extra_dims([laspy.ExtraBytesParams(name, np.dtype("<f8"), description=TIME) for name in head.times])
    header.add_extra_dims([laspy.ExtraBytesParams(name, np.dtype("<f4"), description=name) for name in head.numbers])
    header.vlrs.append(WktCoordinateSystemVlr(f'LOCAL_CS["{head.frame}",LOCAL_DATUM["local",32767],UNIT["metre",1]]'))
    header.global_encoding.wkt = True
    header.generating_software = "cairn"
    header.are_points_compressed = True
    header.point_count = head.count
    header.number_of_points_by_return = np.array([head.count] + [0] * 14)
    header.mins, header.maxs = head.low_m, head.high_m
    return header


def _rows(table: Table, dtype: np.dtype[np.void], head: LazHead) -> Table:
    rows = np.zeros(len(table), dtype)
    for name, edge_m in zip("xyz", head.node_edges_m, strict=True):
        # Centres are odd numbers of half an edge: so single precision, which tables have, is enough.
        rows[name.upper()] = 2 * np.floor(table[name].astype(np.float64) / edge_m).astype(np.int32) + 1
    for name in ("red", "green", "blue"):
        rows[name] = table[name].astype(np.uint16) * COLOUR_STEP
    for name in (*EXTRA, *head.times, *head.numbers):
        rows[name] = table[name]
    rows["bit_fields"] = RETURN
    return rows


class _Uncorrected(ForwardOnlyFile):
    """File with offsets. A write to a part that is sent already, the offset of the chunk table, is only remembered."""

    def __init__(self) -> None:
        super().__init__()
        self._at = self._end = 0
        self.corrected = -1
        """Offset of the chunk table in the file; -1 until LASzip writes it."""

    def seekable(self) -> bool:
        """True: LASzip may go to an offset, although the bytes there are gone."""
        return True

    def tell(self) -> int:
        """Offset of the next byte."""
        return self._at

    def seek(self, offset: int, whence: int = 0) -> int:
        """Go to an offset."""
        self._at = offset + (0, self._at, self._end)[whence]
        return self._at

    def write(self, data: object) -> int:
        """Add bytes at the end; anywhere else, remember the offset that LASzip writes there."""
        if self._at < self._end:
            (self.corrected,) = struct.unpack("<q", bytes(data))  # type: ignore[call-overload]
            self._at += 8
            return 8
        written = super().write(data)
        self._at = self._end = self._end + written
        return written
