"""Which nodes of a cell are taken away: those of a view that lie where, and are as sure and as warm, as it is asked."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cairn_map.arrays import Floats
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.grid import CellKey, Geometry, cell_of_key, centres_of_voxels, voxels_in_cell
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_map.evidence.view import Chance, Colours, View, ViewStyle, view_of
from cairn_map.files.export_request import ExportRequest

TEMPERATURE_STEP_K = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class Chosen:
    """N nodes of one cell as a view has them, and which of them are asked for."""

    view: View
    centres_m: Floats
    """(N, 3) metres, map frame."""
    rows: npt.NDArray[np.bool_]
    """(N,)"""


def chosen_in_cell(
    key: CellKey, evidence: Evidence, geometry: Geometry, model: SensorModel, asked: ExportRequest
) -> Chosen:
    """The nodes that are asked for, with all that they hold.

    Raises:
        BadInputError: kind `bad_box`, `bad_style`.
    """
    return _chosen(key, evidence, geometry, model, asked, Colours.RGB_888, TEMPERATURE_STEP_K)


def chosen_places(
    key: CellKey, evidence: Evidence, geometry: Geometry, model: SensorModel, asked: ExportRequest
) -> Floats:
    """(N, 3) centres of the nodes that are asked for, metres, map frame: their colours are not looked at."""
    step_k = TEMPERATURE_STEP_K if asked.is_of_some_temperatures else None
    found = _chosen(key, evidence, geometry, model, asked, Colours.NONE, step_k)
    return found.centres_m[found.rows]


def cell_may_have(key: CellKey, geometry: Geometry, asked: ExportRequest) -> bool:
    """Whether a cell reaches into what is asked for."""
    low, high = asked.bounds_m()
    corner = np.array(cell_of_key(key)) * geometry.cell_edge_m
    return bool((corner <= high).all() and (corner + geometry.cell_edge_m >= low).all())


def node_geometry(geometry: Geometry, asked: ExportRequest) -> Geometry:
    """The map's geometry with the nodes that are asked for as its voxels."""
    depth = asked.depth_in(geometry)
    edge_um = geometry.voxel_edge_um << (geometry.depth - depth)
    return geometry.model_copy(update={"depth": depth, "voxel_edge_um": edge_um})


def _chosen(
    key: CellKey,
    evidence: Evidence,
    geometry: Geometry,
    model: SensorModel,
    asked: ExportRequest,
    colours: Colours,
    step_k: float | None,
) -> Chosen:
    style = ViewStyle(asked.depth_in(geometry), chance=Chance.LOG_ODDS, colours=colours, temperature_step_k=step_k)
    view, nodes = view_of(evidence, geometry, model, style), node_geometry(geometry, asked)
    centres_m = centres_of_voxels(voxels_in_cell(view.nodes, key, nodes), nodes)
    low, high = asked.bounds_m()
    rows = (centres_m >= low).all(axis=1) & (centres_m <= high).all(axis=1)
    rows &= np.rint(view.probability * 255) >= asked.p * 255 - 1e-6
    if asked.is_of_some_temperatures:
        rows &= _within_band(view, asked)
    return Chosen(view, centres_m, np.asarray(rows))


def _within_band(view: View, asked: ExportRequest) -> npt.NDArray[np.bool_]:
    """(N,) as on the console: whose hottest voxel is hot enough, and whose mean is cold enough."""
    least, most = asked.band_k()
    rows = np.zeros(len(view), np.bool_)
    kelvin = view.temperature_k
    slack = TEMPERATURE_STEP_K / 100
    rows[view.warm] = (kelvin[:, -1] >= least - slack) & (kelvin[:, 0] <= most + slack)
    return rows
