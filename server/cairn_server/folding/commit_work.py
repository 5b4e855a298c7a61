"""Work of folding a commit, estimated before anything of it is decoded but heads and the upper masks.

    40 ns for each voxel      it is decoded, added, packed, hashed and encoded      air of 2^24 voxels: 0.7 s
    2.4 us for each brick     its memory is allocated, cleared and packed           one voxel in each of 2^15: 80 ms

Cells of the map count, too, where they have to be decoded for this fold alone (decision 016). All figures are of one
core at 2.5 GHz; only their ratio to `SLICE_S` matters.
"""

from collections.abc import Container, Iterable

from cairn_map.codec.cell_reading import cell_reader
from cairn_map.errors import CairnError
from cairn_map.evidence.compact_cell import HELD_PER_BYTE
from cairn_map.evidence.grid import BRICK_DEPTH, CellKey
from cairn_server.store.store import Snapshot
from cairn_server.store.store_rows import StoredCommit

VOXEL_S, BRICK_S = 40e-9, 2.4e-6
BRICK_BYTES = 2048
"""Memory of a brick's sums."""
SLICE_S = 0.1
"""Work that a commit of any size may take while others wait."""
SLICE_S_PER_BYTE, SLICE_MAX_S = 2e-6, 0.5
"""Work that it may take for its bytes, and at most. Scans of rooms have 0.5 us a byte, and take a fifth of it."""


def slice_s(commits: Iterable[StoredCommit]) -> float:
    """Work that these commits, a commit and what it retracts, may take while others wait."""
    size_bytes = sum(len(body) for commit in commits for body in commit.diff.values())
    return min(max(SLICE_S, SLICE_S_PER_BYTE * size_bytes), SLICE_MAX_S)


def commits_work_s(commits: Iterable[StoredCommit], snapshot: Snapshot, cached: Container[CellKey]) -> float:
    """Estimated work of folding commits or taking them out; `cached` are the cells that need not be decoded."""
    seconds = 0.0
    for commit in commits:
        for key, body in commit.diff.items():
            seconds += _work_s(body)[0]
            stored = None if key in cached else snapshot.cell(key)
            if stored is not None:
                work_s, sums_bytes = _work_s(stored.body)
                # Any other cell stays decoded after the fold.
                seconds += work_s if sums_bytes > HELD_PER_BYTE * len(stored.body) else 0.0
    return seconds


def _work_s(body: bytes) -> tuple[float, int]:
    """Work of a cell or diff, seconds, and the memory of its sums; none if it is damaged, which folding finds out."""
    try:
        reader = cell_reader(body)
        depth = reader.head.geometry.depth
        bricks = reader.topology(max(1, depth - BRICK_DEPTH)).brick_count
    except CairnError:
        return 0.0, 0
    return VOXEL_S * reader.head.voxels + BRICK_S * bricks, BRICK_BYTES * bricks
