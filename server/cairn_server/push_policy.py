"""What a commit may claim, beyond being well-formed: whose it is, how much it can have seen, how it is numbered.

Evidence is refused before it can spoil a map: counts that no scan could give would outvote every honest robot,
and use up the range of the sums for everybody; ids full of gaps would grow every version vector without bound.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cairn_map.cell_code import CanonicalCell
from cairn_map.cell_content import CellContent
from cairn_map.channels import SAMPLE_MAX, planes_and_squares
from cairn_map.commit import CommitMeta
from cairn_map.errors import BadInputError, ConflictError, DamagedDataError, DeniedError
from cairn_map.evidence_kernels import bounds_of_counts, channel_above
from cairn_map.grid import CellKey, Geometry, cell_of_key
from cairn_map.ids import INITIAL, OPERATOR, CommitId
from cairn_map.version_vector import AUTHORS_MAX, INTERVALS_MAX
from cairn_server.auth import Caller
from cairn_server.store_rows import MapRow

WEIGHT_MAX = 1024
"""Of one scan's sample in one voxel; cairn's own integrator gives 1."""
AUTHOR_INTERVALS_MAX = 1000
"""Of one author's numbers. A robot pushes oldest first, so an honest one has a handful."""
AHEAD_MAX = 10_000
"""How far a number may run ahead of its author's highest. An author's first may be any: a robot that comes to a new
server does not keep its oldest commits."""
INCARNATIONS_MAX = 256
"""Of one robot: disks lost or rolled back."""
NAMED_MAX = 5
"""Ids that a complaint names."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Numbering:
    """What is known of an author's numbers, and of the map's vector, before one more commit."""

    top: int | None
    """The author's highest number; None before its first commit."""
    intervals: int
    neighbours: int
    """How many of n - 1 and n + 1 are there."""
    incarnations: int
    """Of the same robot, this one included if it is known."""
    authors_in_map: int
    intervals_in_map: int


def check_claims(row: MapRow, caller: Caller, id_text: str, meta: CommitMeta, *, cells: int) -> None:
    """Refuse by what a commit says of itself, before its evidence is decoded.

    Raises:
        BadInputError: kind `other_id` or `other_geometry`.
        DeniedError: kind `not_allowed`: made by, or retracting from, a robot that the caller is not.
        DamagedDataError: kind `empty_commit`.
    """
    if meta.id != id_text:
        raise BadInputError("other_id", f"the path names {id_text[:96]}, the commit calls itself {meta.id}")
    if meta.geometry != row.geometry.digest().hex():
        raise BadInputError("other_geometry", f"the commit was made for another grid than map {row.name} has")
    authors = {meta.commit_id.author.robot, *(target.author.robot for target in meta.retracted_ids)}
    foreign = sorted(author for author in authors if not caller.may_author(author))
    if foreign:
        raise DeniedError("not_allowed", f"this token stands for {caller.robot or caller.role}, not for {foreign[0]}")
    if not cells and not meta.retracts:
        raise DamagedDataError("empty_commit", "a commit must hold evidence or name commits to retract")


def check_evidence(
    meta: CommitMeta, cells: Mapping[CellKey, CanonicalCell], tops: Mapping[CellKey, npt.NDArray[np.int64]]
) -> None:
    """Refuse more evidence than the commit's scans can have given; prior data (author `initial`) had other scans.

    The largest number of each plane of each cell is known.

    Raises:
        BadInputError: kind `too_much_evidence`.
    """
    if meta.commit_id.author.robot == INITIAL:
        return
    scans = max(1, len(meta.scans))
    for key, cell in cells.items():
        complaint = _excess(cell.content, cell.geometry, tops[key], scans)
        if complaint:
            raise BadInputError("too_much_evidence", f"cell {cell_of_key(key)}: {complaint} from {scans} scans")


def check_number(commit: CommitId, numbering: Numbering) -> None:
    """Refuse a number that would tear the version vector apart.

    Raises:
        BadInputError: kind `number_gap` or `too_many_authors`.
    """
    known = numbering
    if known.top is not None and commit.n > known.top + AHEAD_MAX:
        raise BadInputError(
            "number_gap",
            f"{commit} runs more than {AHEAD_MAX} ahead of {known.top}, the highest of its author; push those before "
            "it first, or take a new incarnation",
        )
    if known.neighbours:
        return
    if known.intervals >= AUTHOR_INTERVALS_MAX:
        raise BadInputError(
            "number_gap",
            f"the numbers of {commit.author} have {known.intervals} gaps, {commit} would open another; fill some first",
        )
    is_new = known.top is None
    too_many = known.authors_in_map >= AUTHORS_MAX // 2 or known.intervals_in_map >= INTERVALS_MAX // 2
    # A server's own retracts have an incarnation for each of its starts.
    spent = is_new and known.incarnations >= INCARNATIONS_MAX and commit.author.robot != OPERATOR
    if too_many or spent:
        raise BadInputError(
            "too_many_authors",
            f"{commit.author} has {known.incarnations} incarnations (at most {INCARNATIONS_MAX}), the map "
            f"{known.authors_in_map} authors and {known.intervals_in_map} gaps",
        )


def _excess(content: CellContent, geometry: Geometry, tops: npt.NDArray[np.int64], scans: int) -> str | None:
    """What is too much, or None."""
    counts = bounds_of_counts(content.counts)[3]
    if counts > scans:
        return f"{counts} counts in one voxel"
    for channel in geometry.channels:
        weight = int(tops[1 + geometry.planes_of(channel.name).stop])
        if weight > WEIGHT_MAX * scans:
            return f"weight {weight} of {channel.name} in one voxel (at most {WEIGHT_MAX} a scan)"
    # Weights are below 2^22 here and a square below 2^40, so that the products fit.
    above = channel_above(content.samples, planes_and_squares(geometry.channels), SAMPLE_MAX)
    return None if above < 0 else f"samples of {geometry.channels[above].name} above {SAMPLE_MAX} steps"


AGAIN_KEPT_S = 3600.0
"""Evidence that was pushed again because a retract needs it is kept for this long, whatever the setting."""


class EvidenceGoneError(ConflictError):
    """What a store says to a retract of commits whose evidence it does not keep any more."""

    def __init__(self, commits: Sequence[CommitId]) -> None:
        names = ", ".join(map(str, commits[:NAMED_MAX])) + (" ..." if len(commits) > NAMED_MAX else "")
        super().__init__(
            "evidence_gone",
            f"the evidence of {len(commits)} of these commits is not kept any more ({names}); robots that have their "
            "bytes push them again when they sync, and then they can be retracted",
        )
        self.commits = tuple(commits)
