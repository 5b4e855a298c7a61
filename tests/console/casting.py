"""What a pixel must show: the first node of the server's voxels that its ray meets, found by looking at all of them."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pytest
from tests.console.browsing import Console
from tests.console.room import Room

from cairn_client.cli.maps.map_export import fetch_map
from cairn_map.epochs.present import shown_evidence
from cairn_map.evidence.grid import Geometry
from cairn_map.evidence.voxels import joined_voxels, voxels_of_evidence

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
HEAT_ZERO_K, HEAT_STEP_K = 150, 0.02
"""Of decode/pack.ts."""
PICKED = """a[0].map(([x, y]) => {
  const p = c.picker.at(x, y);
  return p && [p.cell.cell, p.node, p.depth, [...p.cell.bytes.subarray(12 * p.row, 12 * p.row + 12)]];
})"""


@dataclass(frozen=True)
class Occupied:
    """The map's occupied voxels, from the cells that the server has."""

    numbers: Ints
    """(V, 3) on the lattice."""
    counts: Ints
    """(V, 2) hits and misses."""
    probability: Floats
    temperature_k: Floats
    """NaN: none."""
    rgb: Floats
    """(V, 3); NaN: none."""


def occupied(room: Room) -> Occupied:
    with room.api as api:
        info = api.map_info(room.name)
        cells = [cell for _, cell in fetch_map(api, info)]
    model = info.sensor_model
    shown = {cell.key: shown_evidence(cell.history, info.layer, model) for cell in cells}
    parts = [voxels_of_evidence(key, seen, info.geometry, model, occupied_only=True) for key, seen in shown.items()]
    found = joined_voxels(parts)
    heat, colour = (found.readings[name].mean for name in ("temperature", "colour"))
    return Occupied(found.numbers, found.counts, found.probability, heat, colour)


def first_met(boxes: Floats, edges_m: Floats, eye: Floats, ray: Floats) -> tuple[int | None, float]:
    """The box that a ray meets first, and how much nearer it is than the next, in ray lengths.

    (V, 3) lower corners, (V, 1) edges.
    """
    with np.errstate(divide="ignore"):
        a, b = (boxes - eye) / ray, (boxes + edges_m - eye) / ray
    enter, leave = np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)
    met = np.nonzero((enter <= leave) & (enter > 0))[0]
    if not len(met):
        return None, np.inf
    order = met[np.argsort(enter[met])]
    gap = enter[order[1]] - enter[order[0]] if len(order) > 1 else np.inf
    return int(order[0]), float(gap)


def picks_met_first(console: Console, voxels: Occupied, geometry: Geometry, places: Ints) -> int:
    """Ask the page what is at places (N, 2) of its canvas, and a ray through each of the nodes that it shows.

    Both must find the same, with the server's values where it is a voxel; returns how many voxels were.
    """
    nodes, depths, rows = _shown(console, voxels, geometry)
    edges_m = geometry.voxel_edge_m * 2.0 ** (geometry.depth - depths)[:, None]
    size = np.array(console.tell("[c.stage.canvas.clientWidth, c.stage.canvas.clientHeight]"))
    lens = console.tell(
        "(c.stage.camera.updateMatrixWorld(), [c.stage.camera.matrixWorld.elements, "
        "c.stage.camera.projectionMatrix.elements])"
    )
    T_map_eye, projection = (np.array(part).reshape(4, 4).T for part in lens)
    met = 0
    for place, picked in zip(places, console.tell(PICKED, places.tolist()), strict=True):
        at = (place + 0.5) / size * 2 - 1
        ray = T_map_eye[:3, :3] @ [at[0] / projection[0, 0], -at[1] / projection[1, 1], -1.0]
        n, gap_m = first_met(nodes * edges_m, edges_m, T_map_eye[:3, 3], ray)
        if gap_m < 1e-4:
            continue  # an edge that two nodes share: either is right
        assert (n is None) == (picked is None), place
        if n is not None:
            cell, node, depth, told = picked
            assert [*(np.array(node) + (np.array(cell) << depth)), depth] == [*nodes[n], depths[n]], place
            if depth == geometry.depth:
                _assert_values_are_the_servers(told, voxels, rows[n])
                met += 1
    return met


def _shown(console: Console, voxels: Occupied, geometry: Geometry) -> tuple[Ints, Ints, Ints]:
    """Nodes (V, 3) of all cells at the depths that the page shows them at, these depths, and a voxel in each."""
    nodes, depths, rows = [], [], []
    cells = voxels.numbers >> geometry.depth
    for cell, depth in console.tell("[...c.cells.all.values()].map(({ cell, depth }) => [cell, depth])"):
        (inside,) = np.nonzero((cells == cell).all(axis=1))
        if depth and len(inside):
            found, first = np.unique(voxels.numbers[inside] >> geometry.depth - depth, axis=0, return_index=True)
            nodes.append(found)
            depths.append(np.full(len(found), depth))
            rows.append(inside[first])
    return np.concatenate(nodes), np.concatenate(depths), np.concatenate(rows)


def _assert_values_are_the_servers(told: list[int], voxels: Occupied, row: int) -> None:
    """The 12 bytes of a voxel on the graphics card, against the server's numbers."""
    assert told[3] == pytest.approx(255 * voxels.probability[row], abs=0.51)
    is_coloured, is_warm = bool(told[7] & 1), bool(told[7] & 2)
    assert is_coloured == bool(np.isfinite(voxels.rgb[row]).all())
    assert is_warm == bool(np.isfinite(voxels.temperature_k[row]))
    if is_coloured:
        assert told[4:7] == pytest.approx(voxels.rgb[row], abs=0.51)
    if is_warm:
        mean_k = HEAT_ZERO_K + HEAT_STEP_K * (told[8] + 256 * told[9])
        assert mean_k == pytest.approx(voxels.temperature_k[row], abs=0.051 + HEAT_STEP_K)
