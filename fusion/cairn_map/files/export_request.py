"""Export of part of a map: the request, and the nodes of a cell that it selects.

A request is the query of `GET .../main/export`, and the options of `cairn map export`: a box, a least probability, a
band of temperatures, an octree depth, and a file format. Probability and temperatures select occupied nodes; of free
ones, which are in octrees alone, all in the box are there.
"""

from dataclasses import dataclass
from typing import Annotated, Literal, Self

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field, model_validator

from cairn_map.arrays import Floats
from cairn_map.epochs.moment import TimeText
from cairn_map.errors import BadInputError
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.grid import CellKey, Geometry, cell_of_key, centres_of_voxels, check_cubes, voxels_in_cell
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_map.evidence.view import Chance, Colours, View, ViewStyle, view_of

TEMPERATURE_STEP_K = 0.01
"""Resolution of exported temperatures."""
SLACK_M = 1e-7
"""Rounding of coordinates, metres: a centre on the border of a box is in it, also where 3 * 0.025 is above 0.075."""

Kelvin = Annotated[float, Field(ge=0, le=1e5)]
Height = Annotated[float, Field(ge=-1e7, le=1e7)]
BOX_CHARS_MAX = 160
EXPORT_TYPES = {
    "ply": "application/vnd.cairn.ply",
    "pcd": "application/vnd.cairn.pcd",
    "laz": "application/vnd.laszip",
    "npz": "application/x-npz",
    "ot": "application/octet-stream",
    "bt": "application/octet-stream",
}
"""Media type of each format."""


class ExportRequest(BaseModel):
    """Selection of nodes, and the format of the file that holds them."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    format: Literal["ply", "pcd", "laz", "npz", "ot", "bt"] = "ply"
    """Points of occupied nodes; or occupied and free nodes as an octree of OctoMap's, `ot` with log-odds and colour."""
    box: Annotated[str, Field(max_length=BOX_CHARS_MAX)] | None = None
    """x0,y0,z0,x1,y1,z1: metres, map frame, ends included; None: everywhere."""
    floor_m: Height | None = None
    """Least height of a node's centre, metres; None: any."""
    ceiling_m: Height | None = None
    """Greatest height of a node's centre, metres; None: any."""
    p: Annotated[float, Field(ge=0, le=1)] = 0.0
    """Least probability of occupied nodes, compared in steps of 1/255 as on the console."""
    hotter_k: Kelvin | None = None
    """Least temperature of a node's hottest voxel, kelvin; it excludes nodes without a temperature."""
    colder_k: Kelvin | None = None
    """Greatest mean temperature of a node, kelvin; it excludes nodes without a temperature."""
    depth: Annotated[int, Field(ge=1, le=64)] | None = None
    """Octree depth of the nodes; None: voxels."""
    unknown: Literal["free", "occupied"] | None = None
    """State that an octree gives to unknown space in the box, as if measured once; None: it stays unknown."""
    at: TimeText | None = None
    """Time at which the map is read; None: now."""

    @model_validator(mode="after")
    def _fills_a_box_of_an_octree(self) -> Self:
        if self.unknown is not None and self.format not in ("ot", "bt"):
            raise ValueError("unknown space is filled in OctoMap's octrees only, format ot or bt")
        if self.unknown is not None and self.box is None:
            raise ValueError("unknown space has no end: give the box in which it is filled")
        return self

    def bounds_m(self) -> tuple[Floats, Floats]:
        """(3,) lowest and highest place of a node's centre, metres, map frame; infinite where there is no bound.

        Raises:
            BadInputError: kind `bad_box`: not six finite numbers, or the lower corner is not the first.
        """
        low, high = np.full(3, -np.inf), np.full(3, np.inf)
        if self.box is not None:
            low, high = _corners(self.box)
        low[2] = max(low[2], -np.inf if self.floor_m is None else self.floor_m)
        high[2] = min(high[2], np.inf if self.ceiling_m is None else self.ceiling_m)
        return low, high

    @property
    def is_of_some_temperatures(self) -> bool:
        """True if only nodes with a temperature are selected."""
        return self.hotter_k is not None or self.colder_k is not None

    def band_k(self) -> tuple[float, float]:
        """Least temperature of a node's hottest voxel, and highest mean of a node; kelvin."""
        return self.hotter_k or 0.0, np.inf if self.colder_k is None else self.colder_k

    def depth_in(self, geometry: Geometry) -> int:
        """The nodes' octree depth.

        Raises:
            BadInputError: kind `bad_style`: deeper than the map's cells; `level_layer`: an octree of flat voxels.
        """
        if self.format in ("ot", "bt"):
            check_cubes(geometry)
        if self.depth is not None and self.depth > geometry.depth:
            raise BadInputError("bad_style", f"depth must be 1 to {geometry.depth} on this map, got {self.depth}")
        return geometry.depth if self.depth is None else self.depth


class TicketedExport(ExportRequest):
    """Query of an export, authorised by a token or by a ticket."""

    ticket: Annotated[str, Field(pattern=r"^[0-9a-f]{32}$")] | None = None

    @property
    def request(self) -> ExportRequest:
        """The request, without its ticket."""
        return ExportRequest.model_validate(self.model_dump(exclude={"ticket"}))


class ExportTicket(BaseModel):
    """Ticket for an export: it replaces a token once, for one file."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    ticket: str
    ends_s: float
    """End of its validity, UTC seconds since 1970."""
    points: int
    """Points of the file."""
    size_bytes: int | None
    """Size of the file; None: known only once it is made."""


def _corners(text: str) -> tuple[Floats, Floats]:
    try:
        numbers = np.array([float(part) for part in text.split(",")])
    except ValueError:
        numbers = np.empty(0)
    low, high = numbers[:3], numbers[3:]
    if len(numbers) != 6 or not np.isfinite(numbers).all() or (low > high).any():
        raise BadInputError(
            "bad_box", f"a box is x0,y0,z0,x1,y1,z1 in metres with the lower corner first, got {text[:80]!r}"
        )
    return low, high


@dataclass(frozen=True, slots=True, eq=False)
class Chosen:
    """N nodes of one cell as a view holds them, and the selection."""

    view: View
    centres_m: Floats
    """(N, 3) metres, map frame."""
    rows: npt.NDArray[np.bool_]
    """(N,) True for selected nodes."""


def chosen_in_cell(
    key: CellKey, evidence: Evidence, geometry: Geometry, model: SensorModel, asked: ExportRequest
) -> Chosen:
    """Selected nodes of a cell, with colours and temperatures.

    Raises:
        BadInputError: kind `bad_box`, `bad_style`.
    """
    return _chosen(key, evidence, geometry, model, asked, Colours.RGB_888, TEMPERATURE_STEP_K)


def chosen_places(
    key: CellKey, evidence: Evidence, geometry: Geometry, model: SensorModel, asked: ExportRequest
) -> Floats:
    """(N, 3) centres of the selected nodes of a cell, metres, map frame; faster, because no colour is computed."""
    step_k = TEMPERATURE_STEP_K if asked.is_of_some_temperatures else None
    found = _chosen(key, evidence, geometry, model, asked, Colours.NONE, step_k)
    return found.centres_m[found.rows]


def cell_may_have(key: CellKey, geometry: Geometry, asked: ExportRequest) -> bool:
    """True if a cell reaches into the box of a request."""
    low, high = asked.bounds_m()
    corner, edges_m = np.array(cell_of_key(key)) * geometry.cell_edges_m, np.array(geometry.cell_edges_m)
    return bool((corner <= high).all() and (corner + edges_m >= low).all())


def node_geometry(geometry: Geometry, asked: ExportRequest) -> Geometry:
    """The map's geometry with the nodes of the requested depth as its voxels."""
    depth = asked.depth_in(geometry)
    coarser = geometry.depth - depth
    step_um = None if geometry.height_step_um is None else geometry.height_step_um << coarser
    edges = {"voxel_edge_um": geometry.voxel_edge_um << coarser, "height_step_um": step_um}
    return geometry.model_copy(update={"depth": depth, **edges})


def _chosen(
    key: CellKey,
    evidence: Evidence,
    geometry: Geometry,
    model: SensorModel,
    asked: ExportRequest,
    colours: Colours,
    step_k: float | None,
) -> Chosen:
    style = ViewStyle(asked.depth_in(geometry), chance=Chance.LOG_ODDS, colours=colours, scalar_step=step_k)
    view = view_of(evidence, geometry, model, style)
    centres_m = _centres(view.nodes, key, geometry, asked)
    rows = _within_bounds(centres_m, asked)
    rows &= np.rint(view.probability * 255) >= asked.p * 255 - 1e-6
    if asked.is_of_some_temperatures:
        rows &= _within_band(view, asked)
    return Chosen(view, centres_m, np.asarray(rows))


def is_in_box(
    nodes: npt.NDArray[np.uint32], key: CellKey, geometry: Geometry, asked: ExportRequest
) -> npt.NDArray[np.bool_]:
    """(N,) True for nodes of a cell, at the request's depth, with their centres in the box of a request."""
    return _within_bounds(_centres(nodes, key, geometry, asked), asked)


def _centres(nodes: npt.NDArray[np.uint32], key: CellKey, geometry: Geometry, asked: ExportRequest) -> Floats:
    finer = node_geometry(geometry, asked)
    return centres_of_voxels(voxels_in_cell(nodes, key, finer), finer)


def _within_bounds(centres_m: Floats, asked: ExportRequest) -> npt.NDArray[np.bool_]:
    low, high = asked.bounds_m()
    return np.asarray((centres_m >= low - SLACK_M).all(axis=1) & (centres_m <= high + SLACK_M).all(axis=1))


def _within_band(view: View, asked: ExportRequest) -> npt.NDArray[np.bool_]:
    """(N,) True where the hottest voxel is hot enough and the mean is cold enough, as on the console."""
    least, most = asked.band_k()
    rows = np.zeros(len(view), np.bool_)
    kelvin = view.scalars
    slack = TEMPERATURE_STEP_K / 100
    rows[view.scalar_rows] = (kelvin[:, -1] >= least - slack) & (kelvin[:, 0] <= most + slack)
    return rows
