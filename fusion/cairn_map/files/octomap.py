"""OctoMap files (Hornung et al. 2013) of parts of a map, made cell by cell: `.ot` and `.bt`, for OctoMap's tools.

    .ot   log-odds of every node, and its colour (ColorOcTree) if anything is coloured, else a plain OcTree
    .bt   OcTree: occupied, free or unknown, two bits a node

OctoMap's octree has 16 levels around the origin, and cairn's cells are its nodes at level 16 - depth: so a cell is one
subtree, and files are written depth first, as OctoMap reads them. A file begins with the number of its nodes, and the
nodes above the cells come before them: so all subtrees are made before the first byte is sent. A cell is made block by
block, so that the rows of its voxels are never all in memory.
"""

from collections.abc import Iterable, Iterator, Sequence
from itertools import pairwise

import numpy as np

from cairn_map.errors import BadInputError
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.grid import Cell, CellKey, Geometry, cell_key, cell_of_key
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_map.files.export_request import ExportRequest
from cairn_map.files.octomap_leaves import Filling, beyond_octree, leaves_in_cell
from cairn_map.files.octomap_nodes import (
    BRANCH,
    LEVELS,
    NODE,
    UNCOLOURED,
    Nodes,
    grown,
    parts_of_file,
    placeholder,
    without_colours,
)
from cairn_map.kernels.morton_kernels import deinterleave, interleave

TREE_FORMATS = ("ot", "bt")
BLOCK_DEPTH = 6
"""A block is 64^3 voxels: some 50 MB while its nodes are made."""
BORDER_CELLS_MAX = 1 << 15
"""Most cells at the border of a box whose unknown space is filled: of cells of 5.12 m, a box of 370 m along an edge."""
NO_CODES = np.empty(0, np.uint64)


def branch_of_cell(
    key: CellKey, evidence: Evidence, geometry: Geometry, model: SensorModel, asked: ExportRequest
) -> tuple[Nodes, bytes] | None:
    """Root of a cell's subtree as a placeholder, and its bytes in a file, none if it is a leaf; None: all is unknown.

    Raises:
        BadInputError: kind `bad_box`: the cell is beyond an octree of 16 levels; `bad_style`.
    """
    # Levels: the cell's is `top`, its blocks' `top + down`, and that of the request's nodes `top + depth`.
    filling = Filling.of_request(asked, geometry, model)
    depth, top = asked.depth_in(geometry), LEVELS - geometry.depth
    down = min(depth, max(0, geometry.depth - BLOCK_DEPTH))
    cell = _code_of_cell(key, geometry)
    # Blocks with evidence, and those that the border of the filling divides.
    pieces: dict[int, Evidence | None] = dict(_blocks(evidence, geometry.depth, down))
    if filling is not None and cell is not None:
        _, divided = filling.holes(cell, top, NO_CODES, top + down)
        for number in (divided - np.uint64(cell << 3 * down)).tolist():
            pieces.setdefault(number, None)
    # Each a subtree of the cell's.
    roots, bodies = [np.empty(0, NODE)], list[bytes]()
    for number in sorted(pieces):
        piece = pieces[number]
        leaves = roots[0] if piece is None else leaves_in_cell(key, piece, geometry, model, asked)
        # A cell beyond the tree is no fault as long as the request selects nothing in it.
        if cell is None:
            if len(leaves):
                raise beyond_octree(geometry)
            continue
        leaves["code"] += np.uint64(cell << 3 * depth)
        # Unknown space is all that is neither selected nor free.
        if filling is not None:
            block = (cell << 3 * down) + number
            holes, _ = filling.holes(block, top + down, np.sort(leaves["code"]), filling.level)
            leaves = np.concatenate([leaves, holes])
        if len(leaves):
            root, body = _branch(leaves, [], top + down, asked.format)
            roots.append(root)
            bodies += [body] if body else []
    # The cell from its blocks, and the space between them.
    joined = np.concatenate(roots)
    if filling is not None and cell is not None:
        joined = np.concatenate([joined, filling.holes(cell, top, joined["code"], top + down)[0]])
    return _branch(joined, bodies, top, asked.format) if len(joined) else None


def cells_at_border(geometry: Geometry, model: SensorModel, asked: ExportRequest) -> list[CellKey]:
    """Cells, rising in number, that the border of a box divides in which unknown space is filled: also those unseen.

    Raises:
        BadInputError: kind `bad_box`: it reaches beyond OctoMap's octree; `too_large`: they are too many.
    """
    filling = Filling.of_request(asked, geometry, model)
    if filling is None:
        return []
    # Their number first, from the box alone: all of its cells less those inside.
    side = 1 << asked.depth_in(geometry)
    count = filling.high // side - filling.low // side + 1
    if int(np.prod(count) - np.prod(np.maximum(count - 2, 0))) > BORDER_CELLS_MAX:
        raise BadInputError(
            "too_large", f"more than {BORDER_CELLS_MAX} cells are at the border of this box; ask for a smaller one"
        )
    # As if nothing were known: cells that hold something at the border are among them.
    _, divided = filling.holes(0, 0, NO_CODES, LEVELS - geometry.depth)
    cells = deinterleave(np.sort(divided)) - _half(geometry)
    return [cell_key(Cell(*cell)) for cell in cells.tolist()]


def tree_of_cells(roots: Sequence[Nodes], geometry: Geometry, model: SensorModel, asked: ExportRequest) -> Nodes:
    """The nodes from the root down to the cells in the order of a file; `roots` are the cells' placeholders."""
    joined = np.concatenate([np.empty(0, NODE), *roots])
    filling = Filling.of_request(asked, geometry, model)
    # Unseen cells within the box are leaves of any size; those at its border are among the roots.
    if filling is not None:
        holes, _ = filling.holes(0, 0, np.sort(joined["code"]), LEVELS - geometry.depth)
        joined = np.concatenate([joined, holes])
    return grown(joined, 0) if len(joined) else joined


def tree_file(form: str, nodes: Nodes, bodies: Iterable[bytes], geometry: Geometry, about: str) -> Iterator[bytes]:
    """Parts of a file of a tree: `nodes` above its cells, and the bytes of its cells that are no leaves, in turn."""
    # The root's colour is the mean of all colours: white only where no leaf has one.
    is_plain = form == "bt" or not len(nodes) or bool((nodes["rgb"][0] == UNCOLOURED).all())
    head = [
        "# Octomap OcTree binary file" if form == "bt" else "# Octomap OcTree file",
        "# (feel free to add / change comments, but leave the first line as it is!)",
        f"# cairn; {about}",
        f"id {'OcTree' if is_plain else 'ColorOcTree'}",
        f"size {nodes['nodes'][0] if len(nodes) else 0}",
        f"res {geometry.voxel_edge_m:.9g}",
        "data",
        "",
    ]
    yield "\n".join(head).encode()
    for part in parts_of_file(nodes, bodies, form):
        yield without_colours(part) if is_plain and form == "ot" else part


def _branch(leaves: Nodes, bodies: Sequence[bytes], top: int, form: str) -> tuple[Nodes, bytes]:
    """Root at level `top` of a subtree as a placeholder, and its bytes; none if the root is a leaf."""
    nodes = grown(leaves, top)
    is_leaf = nodes["kind"][0] != BRANCH
    return placeholder(nodes), b"" if is_leaf else b"".join(parts_of_file(nodes, bodies, form))


def _blocks(evidence: Evidence, depth: int, down: int) -> Iterator[tuple[int, Evidence]]:
    """Blocks of a cell, `down` levels below it, that hold evidence: numbers, rising, and evidence."""
    # Voxels rise in Morton number, so that a block is one run of rows; samples name theirs by row.
    firsts = np.arange(8**down + 1, dtype=np.uint32) << np.uint32(3 * (depth - down))
    rows = np.searchsorted(evidence.voxels, firsts)
    for number, (start, end) in enumerate(pairwise(rows.tolist())):
        if start == end:
            continue
        first, last = np.searchsorted(evidence.sampled, np.array([start, end], np.uint32))
        sampled = evidence.sampled[first:last] - np.uint32(start)
        samples = evidence.samples[first:last]
        odds = None if evidence.odds is None else evidence.odds[start:end]
        yield number, Evidence(evidence.voxels[start:end], evidence.counts[start:end], sampled, samples, odds)


def _half(geometry: Geometry) -> int:
    """Cells to each side of the origin: OctoMap's numbers are not negative, the origin is in the middle of the tree."""
    return 1 << (LEVELS - 1 - geometry.depth)


def _code_of_cell(key: CellKey, geometry: Geometry) -> int | None:
    """Morton number of a cell among the nodes of its level; None: OctoMap's octree does not reach it."""
    half = _half(geometry)
    cell = np.array([cell_of_key(key)], np.int64) + half
    return int(interleave(cell)[0]) if ((cell >= 0) & (cell < 2 * half)).all() else None
