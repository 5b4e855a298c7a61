"""Leaves of OctoMap's octrees: the occupied and the free nodes of a cell, and unknown space as a request fills it.

occupied   selected by the request; a coarser node if any voxel below is
free       in the box of the request; a coarser node only if all voxels below are known to be
filled     all else in the box, if the request says that unknown space is free or occupied: as if measured once
"""

from dataclasses import dataclass
from typing import Self

import numpy as np
import numpy.typing as npt

from cairn_map.arrays import Floats, Ints
from cairn_map.errors import BadInputError
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.grid import CellKey, Geometry
from cairn_map.evidence.inverse_sensor_model import LOG_ODDS_STEP, SensorModel, known, log_odds
from cairn_map.evidence.view import LOG_ODDS_ZERO
from cairn_map.files.export_request import SLACK_M, ExportRequest, chosen_in_cell, is_in_box
from cairn_map.files.octomap_nodes import FREE, LEVELS, OCCUPIED, UNCOLOURED, Codes, Nodes, leaves_of
from cairn_map.kernels.morton_kernels import deinterleave

ODDS_OF_BT = {FREE: -1.0, OCCUPIED: 1.0}
"""A .bt knows states only: nodes of the same state are alike."""


def leaves_in_cell(
    key: CellKey, evidence: Evidence, geometry: Geometry, model: SensorModel, asked: ExportRequest
) -> Nodes:
    """Selected occupied nodes of a cell, then the free ones; `code` counts within the cell, `level` from the root.

    Raises:
        BadInputError: kind `bad_box`, `bad_style`.
    """
    level = LEVELS - geometry.depth + asked.depth_in(geometry)
    # Occupied: log-odds in natural units, colours in which white is free for "none".
    chosen = chosen_in_cell(key, evidence, geometry, model, asked)
    view = chosen.view
    odds = np.maximum((view.chances[chosen.rows] - LOG_ODDS_ZERO) * LOG_ODDS_STEP, 0)
    occupied = leaves_of(view.nodes[chosen.rows].astype(np.uint64), level, OCCUPIED, odds)
    rgb = np.full((len(view), 3), UNCOLOURED, np.uint8)
    rgb[view.coloured] = view.colour
    rgb[view.coloured[(view.colour == UNCOLOURED).all(axis=1)]] -= 1
    occupied["rgb"] = rgb[chosen.rows]
    # Free: below zero after rounding too, since zero is occupied to OctoMap.
    nodes, odds = _free_nodes(evidence, model, up=3 * (geometry.depth - view.depth))
    odds = np.minimum(np.rint(odds / LOG_ODDS_STEP), -1) * LOG_ODDS_STEP
    rows = is_in_box(nodes, key, geometry, asked)
    free = leaves_of(nodes[rows].astype(np.uint64), level, FREE, odds[rows])
    leaves = np.concatenate([occupied, free])
    if asked.format == "bt":
        leaves["rgb"] = UNCOLOURED
        leaves["odds"] = np.where(leaves["kind"] == FREE, ODDS_OF_BT[FREE], ODDS_OF_BT[OCCUPIED])
    return leaves


def _free_nodes(evidence: Evidence, model: SensorModel, *, up: int) -> tuple[npt.NDArray[np.uint32], Floats]:
    """Nodes whose voxels are all known and unoccupied, and their highest log-odds."""
    rows = known(evidence.counts)
    voxels, odds = evidence.voxels[rows], evidence.log_odds(model, rows=rows)
    count = np.ones(len(voxels), np.int64)
    nodes = voxels >> np.uint32(up)
    if up and len(nodes):
        # Voxels of one node are one run.
        starts = np.nonzero(np.diff(nodes, prepend=~nodes[:1]))[0]
        nodes, odds = nodes[starts], np.maximum.reduceat(odds, starts)
        count = np.diff(starts, append=len(voxels))
    free = (odds <= log_odds(model.p_occupied)) & (count == 1 << up)
    return nodes[free], odds[free]


@dataclass(frozen=True, slots=True, eq=False)
class Filling:
    """Unknown space in a box as a request fills it: the nodes at the request's depth whose centres are in the box."""

    low: Ints
    """(3,) lowest and highest number of a node in the box, counted from the corner of OctoMap's octree."""
    high: Ints
    level: int
    kind: int
    odds: float

    @classmethod
    def of_request(cls, asked: ExportRequest, geometry: Geometry, model: SensorModel) -> Self | None:
        """Filling that a request asks for; None: unknown space stays unknown.

        Raises:
            BadInputError: kind `bad_box`: it reaches beyond OctoMap's octree.
        """
        if asked.unknown is None:
            return None
        depth = asked.depth_in(geometry)
        edge_m = geometry.cell_edge_m / (1 << depth)
        level = LEVELS - geometry.depth + depth
        half = 1 << (level - 1)
        low_m, high_m = asked.bounds_m()
        if max(-low_m.min(), high_m.max()) > half * edge_m:
            raise beyond_octree(geometry)
        low, high = np.ceil((low_m - SLACK_M) / edge_m - 0.5), np.floor((high_m + SLACK_M) / edge_m - 0.5)
        kind, p = (FREE, model.p_miss) if asked.unknown == "free" else (OCCUPIED, model.p_hit)
        odds = ODDS_OF_BT[kind] if asked.format == "bt" else round(log_odds(p) / LOG_ODDS_STEP) * LOG_ODDS_STEP
        return cls(low.astype(np.int64) + half, high.astype(np.int64) + half, level, kind, odds)

    def holes(self, root: int, level: int, known: Codes, known_level: int) -> tuple[Nodes, Codes]:
        """Unknown space below a node as the largest leaves that fill it, down to a level.

        Args:
            root: number of the node at `level`.
            level: of the root.
            known: numbers at `known_level` of nodes that are not filled, rising.
            known_level: the level to which nodes are divided.

        Returns:
            The leaves, and the numbers at `known_level` of nodes that the border of the box divides further.
        """
        found = list[Nodes]()
        nodes = np.array([root], np.uint64)
        for at in range(level, known_level + 1):
            # Nodes in the box, wholly or in part, and those that hold something known.
            side = 1 << (self.level - at)
            corner = deinterleave(nodes) * side
            is_near = ((corner <= self.high) & (corner + side > self.low)).all(axis=1)
            nodes, corner = nodes[is_near], corner[is_near]
            is_inside = ((corner >= self.low) & (corner + side - 1 <= self.high)).all(axis=1)
            down = np.uint64(3 * (known_level - at))
            ends = np.searchsorted(known, np.concatenate([nodes << down, (nodes + np.uint64(1)) << down]))
            is_empty = ends[: len(nodes)] == ends[len(nodes) :]
            found.append(leaves_of(nodes[is_inside & is_empty], at, self.kind, self.odds))
            # The others are divided.
            if at < known_level:
                nodes = nodes[~(is_inside & is_empty)]
                nodes = (nodes[:, None] << np.uint64(3) | np.arange(8, dtype=np.uint64)).ravel()
            else:
                nodes = nodes[~is_inside & is_empty]
        return np.concatenate(found), nodes


def beyond_octree(geometry: Geometry) -> BadInputError:
    """Refusal of a map or box that OctoMap's octree cannot hold: kind `bad_box`."""
    reach_m = geometry.voxel_edge_m * (1 << (LEVELS - 1))
    box = ",".join([f"{-reach_m:g}"] * 3 + [f"{reach_m:g}"] * 3)
    return BadInputError(
        "bad_box",
        f"an octree of OctoMap's ends {reach_m:g} m from the map's origin, 2^15 voxels, and this reaches further; "
        f"cut it: --box={box}, or a smaller one",
    )
