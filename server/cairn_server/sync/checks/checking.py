"""Check of all of a commit before it is kept: pure, in a thread or in a worker process.

Bytes go in, and a small result comes out: the commit's SHA-256 and the largest number of each plane. Everything else
that is stored of a commit is in its bytes.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cairn_map.commits.commit import Commit, commit_sha
from cairn_map.commits.commit_reading import CommitReader
from cairn_map.evidence.evidence import largest
from cairn_map.evidence.grid import CellKey
from cairn_server.store.shares import region_of
from cairn_server.store.store_rows import NewCommit
from cairn_server.sync.checks.push_policy import check_evidence


@dataclass(frozen=True, slots=True)
class Checked:
    """Result for a commit that decodes, is canonical, and has possible evidence."""

    sha: bytes
    tops: Mapping[int, tuple[int, ...]]
    """Largest number of each plane in each region (`shares.region_of`)."""
    bricks: int
    """Count of the bricks of 8^3 voxels that it touches."""


def check_commit(reader: CommitReader) -> Checked:
    """Decode a commit and check all of it.

    Raises:
        DamagedDataError, BadInputError: as `CommitReader.read` and `push_policy.check_evidence`.
    """
    tops: dict[CellKey, npt.NDArray[np.int64]] = {}
    digests: list[bytes] = []
    bricks = 0
    # Cell by cell, and none is kept: the memory is that of the largest one.
    for cell in reader.canonical_cells():
        tops[cell.key] = largest(cell.content.counts, cell.content.samples)
        check_evidence(reader.meta, cell, tops[cell.key])
        digests.append(cell.digest)
        bricks += cell.content.octree.brick_count
    return Checked(commit_sha(reader.text, digests, version=reader.meta.version), _by_region(tops), bricks)


def new_commit(commit: Commit, tops: Mapping[int, tuple[int, ...]], *, bricks: int = 0) -> NewCommit:
    """Checked commit as a store keeps it."""
    return NewCommit(
        id=commit.id,
        sha=commit.sha,
        size_bytes=len(commit.data),
        text=commit.text,
        captured_s=commit.meta.captured_s,
        retracts=commit.meta.retracted_ids,
        diff=commit.cells,
        tops=tops,
        bricks=bricks,
        rig=bytes.fromhex(commit.meta.rig) if commit.meta.rig else None,
        epoch=commit.meta.row,
        marks=commit.meta.marks,
        layer=commit.meta.layer,
    )


def _by_region(tops: Mapping[CellKey, npt.NDArray[np.int64]]) -> dict[int, tuple[int, ...]]:
    """Largest numbers of all cells of each region."""
    found: dict[int, npt.NDArray[np.int64]] = {}
    for key, top in tops.items():
        region = region_of(key)
        found[region] = np.maximum(found[region], top) if region in found else top
    return {region: tuple(top.tolist()) for region, top in found.items()}
