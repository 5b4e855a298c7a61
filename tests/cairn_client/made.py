"""Tiny maps, evidence and frames for the client's tests."""

import hashlib
from pathlib import Path

import numpy as np

from cairn_client.replica.replica import Replica
from cairn_client.replica.replica_store import ReplicaStore
from cairn_client.sync.applying import Exchange
from cairn_map.codec.cell_code import encode_cell
from cairn_map.commits.commit import Commit
from cairn_map.commits.cursor import Cursor
from cairn_map.commits.ids import Author, CommitId, RobotName
from cairn_map.commits.version_vector import EMPTY, VersionVector
from cairn_map.evidence.brick_cell import sum_evidence
from cairn_map.evidence.channels import TEMPERATURE
from cairn_map.evidence.evidence import Evidence, empty_evidence, packed_evidence
from cairn_map.evidence.evidence_map import EvidenceMap
from cairn_map.evidence.fingerprint import fingerprint
from cairn_map.evidence.grid import CellKey, Geometry, cell_key
from cairn_map.wire.frames import CellFrame, Frame, FrameKind
from cairn_map.wire.messages import Done, ReplyHeader

MAP = "lab"
GEOMETRY = Geometry(voxel_edge_um=50_000, depth=3, channels=(TEMPERATURE,))
"""One brick a cell, one channel."""
A, B = cell_key((0, 0, 0)), cell_key((-1, 0, 2))
NOTHING = empty_evidence(GEOMETRY)
LOG = bytes(range(16))


def seen(*places: int, kelvin_steps: int = 0) -> Evidence:
    """Voxels that one scan saw: occupied, with a temperature sample each, if one is given; else seen through."""
    count = [1, 0] if kelvin_steps else [0, 1]
    samples = np.array([[kelvin_steps, kelvin_steps**2, int(kelvin_steps > 0)]])
    voxels = np.array(places, np.uint32)
    return packed_evidence(voxels, np.tile([count], (len(voxels), 1)), np.tile(samples, (len(voxels), 1)), GEOMETRY)


def random_diff(seed: int) -> dict[CellKey, Evidence]:
    """A commit's evidence: a few voxels in one cell or both."""
    rng = np.random.default_rng(seed)
    cells = [[A], [B], [A, B]][seed % 3]
    return {cell: seen(*np.unique(rng.integers(0, 40, 6)).tolist(), kelvin_steps=seed % 5) for cell in cells}


def cells_of(view: EvidenceMap) -> dict[CellKey, tuple[bytes, str]]:
    """What two equal maps have in common: canonical digest and fingerprint of each cell that holds evidence."""
    return {
        key: (encode_cell(key, evidence, view.geometry).digest, fingerprint(evidence, key).hex())
        for key, evidence in view.packed().items()
    }


def opened(folder: Path, robot: str = "mole", *, map_name: str = MAP) -> Replica:
    """A replica in a folder."""
    store = ReplicaStore(folder)
    try:
        return Replica(store, robot=RobotName(robot), map_name=map_name, geometry=GEOMETRY)
    except BaseException:
        store.close()
        raise


def cursor(seq: int, *, branch: int = 0) -> Cursor:
    """A state of a made-up log; another branch has another history at the same number."""
    return Cursor(LOG, seq, hashlib.sha256(bytes([seq, branch])).digest()[:16])


def covering(*commits: CommitId) -> VersionVector:
    """A version vector of some commits."""
    return EMPTY.with_commits(commits)


def foreign(n: int) -> CommitId:
    """A commit of somebody else."""
    return CommitId(Author(RobotName("other"), "00000000000000ff"), n)  # type: ignore[arg-type]


def header(
    to: Cursor, coverage: VersionVector = EMPTY, *, stable: VersionVector = EMPTY, tip: tuple[int, bytes] | None = None
) -> ReplyHeader:
    """The first frame of a reply."""
    sha = (tip[0], tip[1].hex()) if tip else None
    return ReplyHeader(to=str(to), vector=coverage.to_json(), stable=stable.to_json(), tip=sha)


def cell_frame(
    kind: FrameKind,
    to: Cursor,
    evidence: Evidence,
    *,
    key: CellKey = A,
    start: Cursor | None = None,
    payload: Evidence | None = None,
    own_excluded: bool = False,
    blocks: list[int] | None = None,
) -> CellFrame:
    """A frame that leads a cell to some evidence."""
    body = b""
    if kind is not FrameKind.RESET:
        body = encode_cell(key, evidence if payload is None else payload, GEOMETRY).data
    return CellFrame(
        kind=kind,
        cell=key,
        from_cursor=start,
        to_cursor=to,
        fingerprint=fingerprint(evidence, key),
        own_excluded=own_excluded,
        blocks=None if blocks is None else np.array(blocks, np.uint32),
        payload=body,
    )


def done(to: Cursor, *rest: tuple[CellKey, Evidence]) -> Done:
    """The end of a reply, with the sum over the cells that got no frame."""
    total = fingerprint(NOTHING, A)
    for key, evidence in rest:
        total += fingerprint(evidence, key)
    return Done(to=str(to), rest=total.hex())


def exchanged(replica: Replica, *frames: Frame, compare: bool = False) -> Exchange:
    """One request, and this answer."""
    exchange = Exchange(replica, compare=compare)
    for frame in frames:
        exchange.take(frame)
    return exchange


def added(*evidence: Evidence) -> Evidence:
    """The sum of evidence of one cell."""
    return sum_evidence(evidence, GEOMETRY)


def committed(replica: Replica, evidence: Evidence, key: CellKey = A) -> Commit:
    """A commit of one cell."""
    return replica.commit({key: evidence})
