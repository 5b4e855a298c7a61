"""Work of folding a commit: its estimate, made of heads and upper masks alone, and the bound of a retract's.

    40 ns for each voxel      it is decoded, added, packed, hashed and encoded      air of 2^24 voxels: 0.7 s
    2.4 us for each brick     its memory is allocated, cleared and packed           one voxel in each of 2^15: 80 ms
    0.6 ms for each cell      however little of it: decoded twice, encoded, a row   4096 cells of one voxel: 2.5 s
    0.1 ms for each name      of a retract: looked up some times, and noted         256 that are not there: 26 ms

Cells of the map count, too, where they have to be decoded for this fold alone (decision 016). All figures are of one
core at 2.5 GHz; only their ratio to `SLICE_S` matters.

A retract is folded in parts, each of bounded work:

    a commit that names 600    + itself  - 1 ... - 256  |  - 257 ... - 512  |  - 513 ... - 600
                               its fold                    a later fold        a later fold

The bound is here and not at the door: which of the commits that a retract names are in the map depends on the order of
arrival, so that a server would refuse for ever what another one, or the same one before a restore, has acknowledged
(decision 021). Any order of the same commits gives the same cells, and each entry of the log is all of one commit.
"""

from collections.abc import Callable, Container
from functools import cache
from typing import NamedTuple

from cairn_map.codec.cell_reading import cell_reader
from cairn_map.codec.history_code import is_history, split_history
from cairn_map.codec.octree.cell_head import head_sizes
from cairn_map.commits.commit import CELLS_MAX
from cairn_map.commits.ids import CommitId
from cairn_map.errors import CairnError
from cairn_map.evidence.compact_cell import HELD_PER_BYTE
from cairn_map.evidence.grid import BRICK_DEPTH, CellKey
from cairn_server.store.store import Snapshot
from cairn_server.store.store_rows import NamedCommit, StoredCommit

VOXEL_S, BRICK_S, CELL_S, NAME_S = 40e-9, 2.4e-6, 0.6e-3, 0.1e-3
BRICK_VOXELS = 8**BRICK_DEPTH
BRICK_BYTES = 2048
"""Memory of a brick's sums."""
SLICE_S = 0.1
"""Work that a commit of any size may take while others wait."""
SLICE_S_PER_BYTE, SLICE_MAX_S = 2e-6, 0.5
"""Work that it may take for its bytes, and at most. Scans of rooms have 0.5 us a byte, and take a fifth of it."""

PART_NAMES_MAX = 256
"""Most commits named in a part; what they are is looked up by the thread that folds: 20 ms."""
PART_CELLS_MAX = CELLS_MAX
"""Most cells of the commits of a part, each counted for each commit: as one commit may have. 2.5 s of work if tiny."""
PART_BRICKS_MAX = 1 << 17
"""Most bricks of them: as a small commit may touch (decision 019). 0.3 to 3 s of work; 3 large scans, 20 of a room."""


def slice_s(size_bytes: int) -> float:
    """Work that a commit and what it retracts, of so many bytes together, may take while others wait."""
    return min(max(SLICE_S, SLICE_S_PER_BYTE * size_bytes), SLICE_MAX_S)


def commit_work_s(commit: StoredCommit, decoding_s: Callable[[CellKey], float]) -> float:
    """Estimated work of folding a commit or taking it out; `decoding_s` is that of the map's cells (`decoding_of`)."""
    return sum(CELL_S + _diff_work_s(body) + decoding_s(key) for key, body in commit.diff.items())


def decoding_of(snapshot: Snapshot, cached: Container[CellKey]) -> Callable[[CellKey], float]:
    """Work of decoding a cell of the map for one fold alone, seconds; each is read once, none of those `cached`."""

    @cache
    def seconds(key: CellKey) -> float:
        stored = None if key in cached else snapshot.cell(key)
        if stored is None:
            return 0.0
        work_s, sums_bytes = _stored_work_s(stored.body)
        # Any other cell stays decoded after the fold.
        return work_s if sums_bytes > HELD_PER_BYTE * len(stored.body) else 0.0

    return seconds


def _diff_work_s(body: bytes) -> float:
    """Work of a diff; of most by their heads alone, since a bound says that they are worth their bytes."""
    try:
        depth, voxels, leaves = head_sizes(body)
    except CairnError:
        return 0.0
    # A leaf is in one brick, or is whole bricks.
    at_most_s = VOXEL_S * voxels + BRICK_S * min(leaves + voxels // BRICK_VOXELS, 8 ** max(0, depth - BRICK_DEPTH))
    return at_most_s if at_most_s <= SLICE_S_PER_BYTE * len(body) else _work_s(body)[0]


def _work_s(body: bytes) -> tuple[float, int]:
    """Work of a cell or diff, seconds, and the memory of its sums; none if it is damaged, which folding finds out."""
    try:
        reader = cell_reader(body)
        depth = reader.head.geometry.depth
        bricks = reader.topology(max(1, depth - BRICK_DEPTH)).brick_count
    except CairnError:
        return 0.0, 0
    return VOXEL_S * reader.head.voxels + BRICK_S * bricks, BRICK_BYTES * bricks


def _stored_work_s(body: bytes) -> tuple[float, int]:
    """Work of a cell of the map: each of its rows is decoded, and the newest stays so (`HistoryCell.rest`)."""
    if not is_history(body):
        return _work_s(body)
    try:
        rows = [_work_s(row) for row in split_history(body).rows.values()]
    except CairnError:
        return 0.0, 0
    return sum(work_s for work_s, _ in rows), rows[-1][1] if rows else 0


class RetractPart(NamedTuple):
    """Commits that a retract names and that one fold deals with."""

    named: tuple[NamedCommit, ...]
    cells: frozenset[CellKey]
    """Cells that change when they are taken out."""
    due_from: int | None
    """Index of the first commit of the next part; None: this is the last one."""

    @property
    def targets(self) -> tuple[CommitId, ...]:
        """Those that are in the map, to be taken out now."""
        return tuple(each.id for each in self.named if each.is_folded and not each.is_retracted)


def part_of(commit: StoredCommit, snapshot: Snapshot) -> RetractPart:
    """Next part of what a commit names: within the bounds, or one commit of any size."""
    if not commit.retracts:
        return RetractPart((), frozenset(), None)
    start = commit.due_from or 0
    named = snapshot.named(commit.retracts[start : start + PART_NAMES_MAX])
    count = cells = bricks = 0
    for each in named:
        # What is not in the map, or is out already, is only noted.
        if each.is_folded and not each.is_retracted:
            is_first, cells, bricks = cells == bricks == 0, cells + each.cells, bricks + each.bricks
            if not is_first and (cells > PART_CELLS_MAX or bricks > PART_BRICKS_MAX):
                break
        count += 1
    end = start + count
    part = RetractPart(tuple(named[:count]), frozenset(), end if end < len(commit.retracts) else None)
    return part._replace(cells=snapshot.touched_cells(part.targets))
