"""What a robot shows of a cell: the server's evidence, and what its own commits change of it (SYNC.md rule 7).

A retract changes what is shown as soon as it is made, with or without a link: what it names is left out where the
server does not have it yet, and subtracted where the server has it and not yet the retract.
"""

import logging
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from cairn_client.replica.outbox import Outbox
from cairn_client.replica.replica_store import KeptCommit
from cairn_map.commits.commit import Commit
from cairn_map.commits.ids import CommitId
from cairn_map.commits.version_vector import VersionVector
from cairn_map.errors import DamagedDataError
from cairn_map.evidence.brick_cell import brick_cell
from cairn_map.evidence.evidence import Evidence, empty_evidence
from cairn_map.evidence.grid import CellKey, Geometry, cell_of_key

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Changes:
    """Where what a robot shows of a cell differs from its base: commits to add and to take out, oldest first."""

    added: tuple[CommitId, ...]
    taken: tuple[CommitId, ...]


def changes(outbox: Outbox, key: CellKey, coverage: VersionVector) -> Changes:
    """What the commits in the outbox change of a cell whose base has this coverage."""
    lacking = [kept for kept in outbox.touching(key) if kept.id not in coverage]
    return Changes(
        added=tuple(kept.id for kept in lacking if not _is_taken_out(outbox, kept, coverage)),
        taken=tuple(kept.id for kept in outbox.touching(key) if _is_due(outbox, kept, coverage)),
    )


def shown_evidence(
    outbox: Outbox, key: CellKey, base: Evidence, geometry: Geometry, *, coverage: VersionVector
) -> Evidence:
    """A cell's base with its coverage, as changed by the commits in the outbox."""
    found = changes(outbox, key, coverage)
    if not found.added and not found.taken:
        return base
    cell = brick_cell(geometry, [base])
    for commit in found.added:
        cell.merge(_sound_evidence(outbox, commit, key, geometry))
    for commit in found.taken:
        cell.unmerge(_sound_evidence(outbox, commit, key, geometry))
    return cell.packed()


def taken_back(
    outbox: Outbox, by: Commit, geometry: Geometry, *, coverage_of: Callable[[CellKey], VersionVector]
) -> Iterator[dict[CellKey, Evidence]]:
    """What is not shown any more once a commit is in the outbox: the evidence of each one that it takes out."""
    for target in by.meta.retracted_ids:
        kept = outbox.kept(target)
        if kept is not None and outbox.successors.of(target) == by.id:
            shown = [key for key in kept.cells if kept.acked or target not in coverage_of(key)]
            yield {key: _sound_evidence(outbox, target, key, geometry) for key in shown}


def is_to_be_taken(outbox: Outbox, commit: CommitId, *, coverage_of: Callable[[CellKey], VersionVector]) -> bool:
    """Whether a kept commit is subtracted in some cell."""
    kept = outbox.kept(commit)
    return kept is not None and any(_is_due(outbox, kept, coverage_of(key)) for key in kept.cells)


def _is_taken_out(outbox: Outbox, kept: KeptCommit, coverage: VersionVector) -> bool:
    """Whether a commit that a base lacks will not be in it, because of one that is here, or is in it already."""
    by = outbox.successors.of(kept.id)
    return by is not None and (by in coverage or outbox.kept(by) is not None)


def _is_due(outbox: Outbox, kept: KeptCommit, coverage: VersionVector) -> bool:
    """Whether a base has a commit, and lacks what takes it out.

    Only if the server acknowledged its very bytes: else the base may have others under its id (rule 13).
    """
    by = outbox.successors.of(kept.id)
    is_there = kept.id in coverage and kept.acked
    return is_there and by is not None and by not in coverage and outbox.kept(by) is not None


def _sound_evidence(outbox: Outbox, commit: CommitId, key: CellKey, geometry: Geometry) -> Evidence:
    """What a kept commit says about a cell; nothing, and a complaint, if the disk damaged it."""
    try:
        return outbox.evidence(commit, key)
    except DamagedDataError as exc:
        log.error("commit %s at rest is damaged and left out of cell %s: %s", commit, cell_of_key(key), exc.message)
        return empty_evidence(geometry)
