"""Commits as robots push them, and the map that they stand for as plain dictionaries."""

from collections.abc import Iterable, Mapping

from tests import naive
from tests.cairn_map.made import SMALL, as_dict, random_evidence

from cairn_map.codec.cell_code import decode_cell
from cairn_map.commits.commit import Commit, CommitMeta, ScanPose, make_commit
from cairn_map.commits.ids import Author, CommitId, Incarnation, RobotName, commit_id_from_text
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.grid import CellKey, Geometry, cell_key

MOLE = Author(RobotName("mole"), Incarnation("0123456789abcdef"))
WREN = Author(RobotName("wren"), Incarnation("00000000000000aa"))
KEYS = [cell_key(cell) for cell in ((0, 0, 0), (-1, 0, 2), (1, 0, 0))]
SCANS = 8
"""Enough for the counts of `random_evidence`."""

Cells = dict[CellKey, naive.Evidence]


def pushed(
    n: int,
    seed: int,
    author: Author = MOLE,
    *,
    geometry: Geometry = SMALL,
    retracts: Iterable[Commit] = (),
    cells: Mapping[CellKey, Evidence] | None = None,
    scans: int = SCANS,
    rig: str | None = None,
) -> Commit:
    """The n-th commit of an author; the seed says what it saw, in two of three cells."""
    pose = ScanPose(time_s=1.5e9, t_map_rig=(0.0, 0.0, 0.4), q_map_rig=(0.0, 0.0, 0.0, 1.0))
    meta = CommitMeta(
        id=str(CommitId(author, n)),
        geometry=geometry.digest().hex(),
        scans=(pose,) * scans,
        captured_s=(1.5e9, 1.5e9 + n),
        retracts=tuple(str(commit.id) for commit in retracts),
        rig=rig,
    )
    if cells is None:
        keys = [KEYS[seed % 3], KEYS[(seed + 1) % 3]]
        cells = {key: random_evidence(seed + key % 7, geometry, voxels=6, air=1) for key in keys}
    return make_commit(meta, cells, geometry)


def sum_of(commits: Iterable[Commit]) -> Cells:
    """What a map of these commits must hold: everything that no other of them retracts, cells without evidence
    left out."""
    pushed_commits = list(commits)
    retracted = {commit_id_from_text(text) for commit in pushed_commits for text in commit.meta.retracts}
    total: Cells = {}
    for commit in pushed_commits:
        if commit.id not in retracted:
            for key, body in commit.cells.items():
                total[key] = naive.merged(total.get(key, {}), as_dict(decode_cell(body).evidence))
    return {key: evidence for key, evidence in total.items() if evidence}


def read(cells: Mapping[int, bytes]) -> Cells:
    """Cells' bytes as plain dictionaries."""
    return {CellKey(key): as_dict(decode_cell(body).evidence) for key, body in cells.items()}
