"""Point clouds of parts of a map, cell by cell: PLY, PCD, LAZ or NPZ, with the memory of one cell.

A file begins with the number of its points, so its writer counts them first. Values are those of a view (`view.py`):
the highest probability, the mean colour and the mean temperature of all voxels below a node, and the hottest voxel.
"""

import zipfile
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Self

import numpy as np
import numpy.typing as npt

from cairn_map.arrays import Floats
from cairn_map.evidence.channels import ChannelKind
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.grid import CellKey, Geometry
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_map.evidence.voxels import reading_of_sums
from cairn_map.files.cell_files import GREY
from cairn_map.files.export_request import ExportRequest, chosen_in_cell, chosen_places
from cairn_map.files.forward_only_file import ForwardOnlyFile

Table = npt.NDArray[np.void]

POINT = np.dtype(
    [
        ("x", "<f4"),
        ("y", "<f4"),
        ("z", "<f4"),
        ("red", "u1"),
        ("green", "u1"),
        ("blue", "u1"),
        ("probability", "<f4"),
        ("temperature", "<f4"),
        ("hottest", "<f4"),
    ]
)
"""Centre of a node, metres, map frame; 8-bit sRGB, grey where no colour camera looked; kelvin, NaN where unknown."""
POINT_NAMES = frozenset(POINT.names or ())
TIMES = {"colour_measured_s": ChannelKind.COLOUR, "temperature_measured_s": ChannelKind.TEMPERATURE}
"""Fields of a map with epochs, and channels whose newest samples below a node they date."""
DATED_POINT = np.dtype([*POINT.descr, *((name, "<f8") for name in TIMES)])
"""`POINT`, and first instants of epochs, UTC seconds since 1970; NaN where unknown."""
CLASS_FIELDS = ("class", "unsure")
"""Fields of a map with classes: number of the class with the most votes below a node, NaN without votes, and 1 where it
leads by less than two, else 0."""
PCD_POINT = np.dtype([(name, "<f4") for name in ("x", "y", "z", "rgb", "probability", "temperature", "hottest")])
"""Row of a PCD file: the Point Cloud Library stores colours as 0x00RRGGBB in the bits of a float."""
DATED_PCD_POINT = np.dtype([*PCD_POINT.descr, *((name, "<f8") for name in TIMES)])
NPZ_MEMBER = "points.npy"


def point_type(plain: np.dtype[np.void], classes: tuple[str, ...]) -> np.dtype[np.void]:
    """Rows of a table, with the fields of classes if the map has any."""
    return np.dtype([*plain.descr, *((name, "<f4") for name in CLASS_FIELDS)]) if classes else plain


@dataclass(frozen=True, slots=True, eq=False)
class PointBounds:
    """Number of points, and their bounding box: the facts that a file of points begins with."""

    count: int = 0
    low_m: Floats = field(default_factory=lambda: np.full(3, np.inf))
    """(3,) lowest and highest centre, metres, map frame; infinite without points."""
    high_m: Floats = field(default_factory=lambda: np.full(3, -np.inf))

    def joined(self, other: Self) -> Self:
        """Bounds of both sets of points together."""
        low_m, high_m = np.minimum(self.low_m, other.low_m), np.maximum(self.high_m, other.high_m)
        return type(self)(self.count + other.count, low_m, high_m)


@dataclass(frozen=True, slots=True)
class About:
    """Source of a file's points, as its comment states it."""

    map_name: str
    node_edges_m: tuple[float, float, float]
    """Edges of a node along x, y and z, metres; of a level layer the last one is its height."""
    has_times: bool = False
    """True of a map with epochs: the points have `TIMES`."""
    classes: tuple[str, ...] = ()
    """Names of the classes by their numbers, of a map that has such: the points have `CLASS_FIELDS`."""

    def __str__(self) -> str:
        times = "; UTC seconds since 1970" if self.has_times else ""
        edge_m, _, height_m = self.node_edges_m
        height = f" and {height_m:g} m height" if height_m != edge_m else ""
        return f"map {self.map_name}, nodes of {edge_m:g} m{height}; metres, map frame; kelvin{times}"

    @property
    def point(self) -> np.dtype[np.void]:
        """Rows of the tables."""
        return point_type(DATED_POINT if self.has_times else POINT, self.classes)

    @property
    def pcd_point(self) -> np.dtype[np.void]:
        """Rows of a PCD file."""
        return point_type(DATED_PCD_POINT if self.has_times else PCD_POINT, self.classes)

    @property
    def comments(self) -> list[str]:
        """Comments of a file's head: the source, and the name of each class."""
        return [f"cairn; {self}", *(f"class {number} {name}" for number, name in enumerate(self.classes))]


def found_in_cell(
    key: CellKey, evidence: Evidence, geometry: Geometry, model: SensorModel, asked: ExportRequest
) -> PointBounds:
    """Number and bounds of the points of `points_of_cell`; faster, because no colour is computed."""
    places = chosen_places(key, evidence, geometry, model, asked)
    return PointBounds(len(places), places.min(axis=0), places.max(axis=0)) if len(places) else PointBounds()


def points_of_cell(
    key: CellKey, evidence: Evidence, geometry: Geometry, model: SensorModel, asked: ExportRequest
) -> Table:
    """(N,) of `POINT`, or of a dated reading `DATED_POINT`: the selected occupied nodes of one cell, in Morton order.

    Raises:
        BadInputError: kind `bad_box`, `bad_style`.
    """
    chosen = chosen_in_cell(key, evidence, geometry, model, asked)
    view, measured_s = chosen.view, evidence.measured_s
    named = next((channel for channel in geometry.channels if channel.classes), None)
    table = np.zeros(
        len(view), point_type(POINT if measured_s is None else DATED_POINT, named.classes if named else ())
    )
    for axis, name in enumerate("xyz"):
        table[name] = chosen.centres_m[:, axis]
    for c, name in enumerate(("red", "green", "blue")):
        table[name] = GREY
        table[name][view.coloured] = view.colour[:, c]
    table["probability"] = view.probability
    table["temperature"] = table["hottest"] = np.nan
    table["temperature"][view.scalar_rows] = view.scalars[:, 0]
    table["hottest"][view.scalar_rows] = view.scalars[:, -1]
    if measured_s is None and named is None:
        return table[chosen.rows]
    rows = view.rows_of(evidence.voxels[evidence.sampled] >> np.uint32(3 * (geometry.depth - view.depth)))
    if named is not None:
        votes = np.zeros((len(view), len(named.planes)), np.int64)
        np.add.at(votes, rows[rows >= 0], evidence.samples[rows >= 0, geometry.planes_of(named.name)])
        reading = reading_of_sums(named, votes)
        table["class"], table["unsure"] = reading.mean, reading.unsure
    if measured_s is not None:
        for name, kind in TIMES.items():
            newest = np.full(len(view), np.nan)
            for column in [n for n, channel in enumerate(geometry.channels) if channel.kind is kind][:1]:
                np.fmax.at(newest, rows[rows >= 0], measured_s[rows >= 0, column])
            table[name] = newest
    return table[chosen.rows]


def point_file(form: str, found: PointBounds, tables: Iterable[Table], about: About) -> Iterator[bytes]:
    """Parts of a file of points: PLY, PCD (both binary), LAZ, or NPZ with one array `points`."""
    if form == "npz":
        return _npz_parts(found.count, tables, about)
    if form == "laz":
        from cairn_map.files.laz import LazHead, laz_parts  # its libraries are a server's

        low_m, high_m = (found.low_m, found.high_m) if found.count else (np.zeros(3), np.zeros(3))
        times, numbers = tuple(TIMES) if about.has_times else (), CLASS_FIELDS if about.classes else ()
        head = LazHead(found.count, low_m, high_m, about.node_edges_m, f"map {about.map_name}", times, numbers)
        return laz_parts(head, tables)
    return _plain_parts(form, found.count, tables, about)


def size_of_file(form: str, found: PointBounds, about: About) -> int | None:
    """Size of a PLY or PCD file, bytes; None for NPZ and LAZ, whose size is unknown before they are made."""
    if form not in ("ply", "pcd"):
        return None
    head, point = (_ply_head, about.point) if form == "ply" else (_pcd_head, about.pcd_point)
    return len(head(found.count, about)) + found.count * point.itemsize


def _plain_parts(form: str, count: int, tables: Iterable[Table], about: About) -> Iterator[bytes]:
    head, row = (_ply_head, _plain) if form == "ply" else (_pcd_head, _pcd_rows)
    yield head(count, about)
    yield from (row(table) for table in tables)


def _plain(table: Table) -> bytes:
    return table.tobytes()


def _ply_head(count: int, about: About) -> bytes:
    words = {"<f4": "float", "<f8": "double", "|u1": "uchar"}
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        *(f"comment {line}" for line in about.comments),
        f"element vertex {count}",
    ]
    lines += [f"property {words[about.point[name].str]} {name}" for name in about.point.names or ()]
    return "\n".join([*lines, "end_header", ""]).encode()


def _pcd_head(count: int, about: About) -> bytes:
    point = about.pcd_point
    names = point.names or ()
    lines = [
        *(f"# {line}" for line in about.comments),
        "VERSION 0.7",
        f"FIELDS {' '.join(names)}",
        f"SIZE {' '.join(str(point[name].itemsize) for name in names)}",
        f"TYPE {' '.join('F' for _ in names)}",
        f"COUNT {' '.join('1' for _ in names)}",
        f"WIDTH {count}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {count}",
        "DATA binary",
        "",
    ]
    return "\n".join(lines).encode()


def _pcd_rows(table: Table) -> bytes:
    others = [field for field in table.dtype.descr if field[0] not in POINT_NAMES]
    rows = np.empty(len(table), np.dtype([*PCD_POINT.descr, *others]))
    for name in set(rows.dtype.names or ()) - {"rgb"}:
        rows[name] = table[name]
    red, green, blue = (table[name].astype(np.uint32) for name in ("red", "green", "blue"))
    rows["rgb"] = (red << 16 | green << 8 | blue).view(np.float32)
    return rows.tobytes()


def _npz_parts(count: int, tables: Iterable[Table], about: About) -> Iterator[bytes]:
    sink = ForwardOnlyFile()
    description = {"descr": np.lib.format.dtype_to_descr(about.point), "fortran_order": False, "shape": (count,)}
    with (
        zipfile.ZipFile(sink, "w", zipfile.ZIP_STORED) as archive,
        archive.open(NPZ_MEMBER, "w", force_zip64=True) as member,
    ):
        np.lib.format.write_array_header_1_0(member, description)
        yield sink.taken()
        for table in tables:
            member.write(table.tobytes())
            yield sink.taken()
    yield sink.taken()
