"""Parts of a map as point clouds, cell by cell: PLY, PCD or NPZ, none of which needs more memory than one cell.

A file begins with the number of its points, so whoever writes one counts them first. Values are those of a view
(`view.py`): the highest probability, the mean colour and temperature of all below a node, and the hottest voxel.
"""

import io
import zipfile
from collections.abc import Iterable, Iterator

import numpy as np
import numpy.typing as npt

from cairn_map.cell_files import GREY
from cairn_map.evidence import Evidence
from cairn_map.export_request import ExportRequest
from cairn_map.grid import CellKey, Geometry, cell_of_key, voxels_in_cell
from cairn_map.sensor_model import SensorModel
from cairn_map.view import Chance, Colours, View, ViewStyle, view_of

Floats = npt.NDArray[np.float64]
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
PCD_POINT = np.dtype([(name, "<f4") for name in ("x", "y", "z", "rgb", "probability", "temperature", "hottest")])
"""The Point Cloud Library has colours as 0x00RRGGBB in the bits of a float."""
EXPORT_TYPES = {"ply": "application/vnd.cairn.ply", "pcd": "application/vnd.cairn.pcd", "npz": "application/x-npz"}
NPZ_MEMBER = "points.npy"


def count_of_cell(
    key: CellKey, evidence: Evidence, geometry: Geometry, model: SensorModel, asked: ExportRequest
) -> int:
    """How many points `points_of_cell` gives, without its colours and temperatures."""
    style = ViewStyle(asked.depth_in(geometry), colours=Colours.NONE, temperature_step_k=None, chance=Chance.LOG_ODDS)
    view = view_of(evidence, geometry, model, style)
    return int(_asked_for(view, _centres_m(view, key, geometry), asked).sum())


def points_of_cell(
    key: CellKey, evidence: Evidence, geometry: Geometry, model: SensorModel, asked: ExportRequest
) -> Table:
    """(N,) of `POINT`: the occupied nodes of one cell that are asked for, rising in Morton number.

    Raises:
        BadInputError: kind `bad_box`, `bad_style`.
    """
    style = ViewStyle(asked.depth_in(geometry), chance=Chance.LOG_ODDS, temperature_step_k=0.01)
    view = view_of(evidence, geometry, model, style)
    centres_m = _centres_m(view, key, geometry)
    table = np.zeros(len(view), POINT)
    for axis, name in enumerate("xyz"):
        table[name] = centres_m[:, axis]
    for c, name in enumerate(("red", "green", "blue")):
        table[name] = GREY
        table[name][view.coloured] = view.colour[:, c]
    table["probability"] = view.probability
    table["temperature"] = table["hottest"] = np.nan
    table["temperature"][view.warm] = view.temperature_k[:, 0]
    table["hottest"][view.warm] = view.temperature_k[:, -1]
    return table[_asked_for(view, centres_m, asked)]


def cell_may_have(key: CellKey, geometry: Geometry, asked: ExportRequest) -> bool:
    """Whether a cell reaches into what is asked for."""
    low, high = asked.bounds_m()
    corner = np.array(cell_of_key(key)) * geometry.cell_edge_m
    return bool((corner <= high).all() and (corner + geometry.cell_edge_m >= low).all())


def point_file(form: str, count: int, tables: Iterable[Table], about: str) -> Iterator[bytes]:
    """A file of `count` points, part by part: PLY, PCD (both binary), or NPZ with one array `points`."""
    if form == "npz":
        yield from _npz_parts(count, tables)
        return
    head, row = (_ply_head, _plain) if form == "ply" else (_pcd_head, _pcd_rows)
    yield head(count, about)
    yield from (row(table) for table in tables)


def size_of_file(form: str, count: int, about: str) -> int | None:
    """Of a PLY or PCD, bytes; None: not known before an NPZ is made."""
    if form == "npz":
        return None
    head, point = (_ply_head, POINT) if form == "ply" else (_pcd_head, PCD_POINT)
    return len(head(count, about)) + count * point.itemsize


def _centres_m(view: View, key: CellKey, geometry: Geometry) -> Floats:
    nodes = geometry.model_copy(
        update={"depth": view.depth, "voxel_edge_um": geometry.voxel_edge_um << (geometry.depth - view.depth)}
    )
    numbers = voxels_in_cell(view.nodes, key, nodes)
    return np.asarray((numbers + 0.5) * nodes.voxel_edge_m, np.float64)


def _asked_for(view: View, centres_m: Floats, asked: ExportRequest) -> npt.NDArray[np.bool_]:
    low, high = asked.bounds_m()
    inside = (centres_m >= low).all(axis=1) & (centres_m <= high).all(axis=1)
    return np.asarray(inside & (np.rint(view.probability * 255) >= asked.p * 255 - 1e-6))


def _plain(table: Table) -> bytes:
    return table.tobytes()


def _ply_head(count: int, about: str) -> bytes:
    words = {"f": "float", "u": "uchar"}
    lines = ["ply", "format binary_little_endian 1.0", f"comment cairn; {about}", f"element vertex {count}"]
    lines += [f"property {words[POINT[name].kind]} {name}" for name in POINT.names or ()]
    return "\n".join([*lines, "end_header", ""]).encode()


def _pcd_head(count: int, about: str) -> bytes:
    names = PCD_POINT.names or ()
    lines = [
        f"# cairn; {about}",
        "VERSION 0.7",
        f"FIELDS {' '.join(names)}",
        f"SIZE {' '.join('4' for _ in names)}",
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
    rows = np.empty(len(table), PCD_POINT)
    for name in ("x", "y", "z", "probability", "temperature", "hottest"):
        rows[name] = table[name]
    red, green, blue = (table[name].astype(np.uint32) for name in ("red", "green", "blue"))
    rows["rgb"] = (red << 16 | green << 8 | blue).view(np.float32)
    return rows.tobytes()


class _Sink(io.RawIOBase):
    """What was written since it was last asked for; has no way back, so that a zip is written in one go."""

    def __init__(self) -> None:
        self._parts: list[bytes] = []

    def writable(self) -> bool:
        return True

    def write(self, data: object) -> int:
        part = bytes(data)  # type: ignore[call-overload]
        self._parts.append(part)
        return len(part)

    def taken(self) -> bytes:
        """And forget it."""
        data = b"".join(self._parts)
        self._parts.clear()
        return data


def _npz_parts(count: int, tables: Iterable[Table]) -> Iterator[bytes]:
    sink = _Sink()
    description = {"descr": np.lib.format.dtype_to_descr(POINT), "fortran_order": False, "shape": (count,)}
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
