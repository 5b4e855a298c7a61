"""OctoMap files (Hornung et al. 2013) of parts of a map, made cell by cell: `.ot` and `.bt`, for OctoMap's tools.

    .ot   ColorOcTree: log-odds of every node, and its colour; white where no colour camera looked
    .bt   OcTree: occupied or not, two bits a node

OctoMap's octree has 16 levels around the origin, and cairn's cells are its nodes at level 16 - depth: so a cell is one
subtree, and files are written depth first, as OctoMap reads them. Inner nodes have the highest log-odds and the mean
colour of their children, as OctoMap's `updateInnerOccupancy` makes them. A file begins with the number of its nodes,
and the nodes above the cells come before them: so all subtrees are made before the first byte is sent.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cairn_map.errors import BadInputError
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.grid import CellKey, Geometry, cell_of_key
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_map.evidence.view import LOG_ODDS_STEP, LOG_ODDS_ZERO
from cairn_map.files.export_request import ExportRequest, chosen_in_cell
from cairn_map.kernels.morton_kernels import interleave

Nodes = npt.NDArray[np.void]

TREE_FORMATS = ("ot", "bt")
LEVELS = 16
UNCOLOURED = 255
"""White, which OctoMap takes for no colour; a node that is white is written one step darker."""
LEAF, BRANCH = 2, 3
"""Kinds of a child in a .bt, two bits: an occupied leaf, or a node with children."""
NODE = np.dtype(
    [("code", "<u8"), ("level", "u1"), ("odds", "<f4"), ("rgb", "u1", 3), ("children", "u1"), ("kinds", "<u2")]
)
OT_NODE = np.dtype([("odds", "<f4"), ("rgb", "u1", 3), ("children", "u1")])
IDS = {"ot": ("OcTree file", "ColorOcTree"), "bt": ("OcTree binary file", "OcTree")}


@dataclass(frozen=True, slots=True)
class Subtree:
    """One cell as a subtree: its key, log-odds and colour of its root, and its numbers of nodes and leaves."""

    key: CellKey
    odds: float
    rgb: tuple[int, int, int]
    nodes: int
    leaves: int


def branch_of_cell(
    key: CellKey, evidence: Evidence, geometry: Geometry, model: SensorModel, asked: ExportRequest
) -> tuple[Subtree, bytes] | None:
    """Subtree of a cell's selected occupied nodes, and its bytes in a file; None if no node is selected.

    Raises:
        BadInputError: kind `bad_box`: the cell is beyond an octree of 16 levels; `bad_style`.
    """
    # The nodes, and a check that OctoMap can number the cell.
    chosen = chosen_in_cell(key, evidence, geometry, model, asked)
    if not chosen.rows.any():
        return None
    _code_of_cells([key], geometry)
    # Leaves: colours in which white is free for "none", log-odds in natural units.
    view = chosen.view
    rgb = np.full((len(view), 3), UNCOLOURED, np.uint8)
    rgb[view.coloured] = view.colour
    rgb[view.coloured[(view.colour == UNCOLOURED).all(axis=1)]] -= 1
    leaves = np.zeros(int(chosen.rows.sum()), NODE)
    leaves["code"], leaves["rgb"] = view.nodes[chosen.rows], rgb[chosen.rows]
    leaves["odds"] = (view.chances[chosen.rows] - LOG_ODDS_ZERO) * LOG_ODDS_STEP
    leaves["level"] = view.depth
    # All nodes above them up to the cell.
    nodes = _depth_first(leaves, LEAF)
    r, g, b = nodes[0]["rgb"].tolist()
    return Subtree(key, float(nodes[0]["odds"]), (r, g, b), len(nodes), len(leaves)), _bytes_of(nodes, asked.format)


def tree_file(
    form: str, branches: Sequence[Subtree], bodies: Iterable[bytes], geometry: Geometry, about: str
) -> Iterator[bytes]:
    """Parts of a file of a tree; `branches`, the cells' subtrees, and their bytes rise in cell number."""
    # The nodes above the cells, in the order of the file, with each cell's root as a placeholder.
    nodes = _above(branches, geometry)
    is_cell = nodes["level"] == LEVELS - geometry.depth
    size = sum(branch.nodes for branch in branches) + int((~is_cell).sum())
    kind, name = IDS[form]
    head = [
        f"# Octomap {kind}",
        "# (feel free to add / change comments, but leave the first line as it is!)",
        f"# cairn; {about}",
        f"id {name}",
        f"size {size}",
        f"res {geometry.voxel_edge_m:.9g}",
        "data",
        "",
    ]
    # Head; then nodes up to the next cell and that cell's bytes, in turns.
    begun = "\n".join(head).encode()
    start, cells = 0, np.nonzero(is_cell)[0]
    for at, body in zip(cells.tolist(), bodies, strict=True):
        yield begun + _bytes_of(nodes[start:at], form) + body
        begun, start = b"", at + 1
    if begun:
        yield begun


def _above(branches: Sequence[Subtree], geometry: Geometry) -> Nodes:
    """The nodes from the root down to the cells."""
    cells = np.zeros(len(branches), NODE)
    if not branches:
        return cells
    cells["code"] = _code_of_cells([branch.key for branch in branches], geometry)
    cells["odds"] = [branch.odds for branch in branches]
    cells["rgb"] = [branch.rgb for branch in branches]
    cells["level"] = LEVELS - geometry.depth
    return _depth_first(cells, BRANCH)


def _code_of_cells(keys: Sequence[CellKey], geometry: Geometry) -> npt.NDArray[np.uint64]:
    """Morton numbers of cells among the nodes of their level, in the order of the cells' numbers."""
    # OctoMap's numbers are not negative: the origin is in the middle of the tree.
    half = 1 << (LEVELS - 1 - geometry.depth)
    cells = np.array([cell_of_key(key) for key in keys], np.int64) + half
    if (cells < 0).any() or (cells >= 2 * half).any():
        reach_m = half * geometry.cell_edge_m
        raise BadInputError(
            "bad_box", f"an octree of OctoMap's ends {reach_m:g} m from the origin; ask for a box within"
        )
    return interleave(cells)


def _depth_first(leaves: Nodes, kind: int) -> Nodes:
    """Leaves, rising in number, and all nodes above them, in the order of a file; `kind` is that of the leaves."""
    # Layer by layer up to the root.
    layers, layer = [leaves], leaves
    deepest = int(leaves["level"][0])
    while layer["level"][0]:
        layer, kind = _parents(layer, kind), BRANCH
        layers.append(layer)
    # Depth first: by the first deepest node below, and of nodes that share it the highest first.
    nodes = np.concatenate(layers)
    first = nodes["code"] << (3 * (deepest - nodes["level"].astype(np.uint64)))
    return nodes[np.lexsort((nodes["level"], first))]


def _parents(layer: Nodes, kind: int) -> Nodes:
    # Runs of children with the same parent; `child` is 0 to 7.
    above, child = layer["code"] >> np.uint64(3), (layer["code"] & np.uint64(7)).astype(np.uint16)
    starts = np.nonzero(np.diff(above, prepend=~above[:1]))[0]
    parents = np.zeros(len(starts), NODE)
    parents["code"], parents["level"] = above[starts], layer["level"][0] - 1
    parents["odds"] = np.maximum.reduceat(layer["odds"], starts)
    parents["children"] = np.bitwise_or.reduceat(np.uint16(1) << child, starts)
    parents["kinds"] = np.bitwise_or.reduceat(np.uint16(kind) << (2 * child), starts)
    # The mean colour of the children that have one, rounded down as OctoMap does.
    coloured = (layer["rgb"] != UNCOLOURED).any(axis=1)
    count = np.add.reduceat(coloured.astype(np.int64), starts)
    sums = np.add.reduceat(layer["rgb"].astype(np.int64) * coloured[:, None], starts, axis=0)
    parents["rgb"] = np.where(count[:, None] > 0, sums // np.maximum(count, 1)[:, None], UNCOLOURED)
    return parents


def _bytes_of(nodes: Nodes, form: str) -> bytes:
    if form == "bt":
        return nodes["kinds"][nodes["children"] > 0].tobytes()
    rows = np.empty(len(nodes), OT_NODE)
    for name in ("odds", "rgb", "children"):
        rows[name] = nodes[name]
    return rows.tobytes()
