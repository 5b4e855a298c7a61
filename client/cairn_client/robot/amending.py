"""Amends: measurements integrated again when a pose graph corrects the poses of their scans; and marks.

    C  the measurement's commit             scans kept under C
    M  names C, with the new evidence       scans kept under M from here on: the next amend names M

The map is then the one that the corrected poses would have given from the start, byte for byte.
"""

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import numpy as np
import numpy.typing as npt

from cairn_calib.rig.poses import check_transform
from cairn_client.http.attachment_copy import attachment_bytes
from cairn_client.replica.outbox import CommitFacts
from cairn_client.replica.replica import Replica
from cairn_client.robot.kept_scans import KeptScans
from cairn_client.robot.map_marks import check_has_marks
from cairn_fusion.mapping.measurement import Measurement
from cairn_fusion.recording.scan import Scan
from cairn_fusion.recording.scan_bytes import move_scan
from cairn_map.codec.cell_code import Profile
from cairn_map.commits.attachment import attachment_of
from cairn_map.commits.commit import Commit
from cairn_map.commits.ids import CommitId, commit_id_from_text
from cairn_map.commits.mark import Mark, check_place
from cairn_map.errors import BadInputError, NotFoundError

AnyCommit = Commit | CommitId | str
"""A commit, its id, or that as text."""
Move = Callable[[Iterator[Scan]], Iterator[Scan]]
"""A change of the poses of a measurement's scans."""
FactsOf = Callable[[Measurement, str], CommitFacts]
"""Facts of a measurement's commit, with its note."""


def facts_of_measurement(
    measurement: Measurement, *, note: str = "", retracts: tuple[CommitId, ...] = ()
) -> CommitFacts:
    """Statements of a measurement's commit about itself."""
    # By its rig and its times an operator finds the commit again, to retract what a bad calibration made.
    return CommitFacts(
        captured_s=measurement.captured_s,
        scans=tuple(measurement.poses),
        sensors=tuple(measurement.rig.cameras),
        rig=measurement.rig.digest(),
        integrator=str(measurement.integrator),
        retracts=retracts,
        note=note,
    )


class Amending:
    """Amends of one robot's commits, by the thread that observes; documented at `Robot.amend`."""

    def __init__(
        self,
        replica: Replica,
        kept: KeptScans,
        *,
        new_measurement: Callable[[], Measurement | None],
        facts_of: FactsOf,
        on_commit: Callable[[Commit], None],
    ) -> None:
        """Args: new_measurement: returns an empty measurement; None without a rig."""
        self._replica = replica
        self._kept = kept
        self._new_measurement = new_measurement
        self._facts_of = facts_of
        self._on_commit = on_commit

    def amend(
        self,
        measurement: AnyCommit,
        T_map_rig: npt.ArrayLike | None,
        *,
        T_map_observed: npt.ArrayLike | None,
        note: str,
        profile: Profile,
    ) -> Commit:
        """Commit one measurement again from other poses, in the place of its commit; as `Robot.amend`."""
        found = self._scans_of(measurement)
        return self._amend(found, _move(T_map_rig, T_map_observed), note=note, profile=profile)

    def amend_all(
        self, T_map_rig: Mapping[CommitId | str, npt.ArrayLike], *, note: str, profile: Profile
    ) -> list[Commit]:
        """Amend many measurements, none if the scans of one are not kept; as `Robot.amend_all`."""
        found = [(self._scans_of(measurement), _move(poses, None)) for measurement, poses in T_map_rig.items()]
        return [self._amend(commit, move, note=note, profile=profile) for commit, move in found]

    def retract(self, measurement: AnyCommit, *, note: str) -> Commit:
        """Take one measurement back; as `Robot.retract`."""
        commit = self._replica.retract(commit_id_of(measurement), CommitFacts(note=note))
        self._on_commit(commit)
        return commit

    def mark(self, mark: Mark, *, instead_of: AnyCommit | None, attachment: Path | bytes | None) -> Commit:
        """Commit a mark, perhaps in the place of an own one; as `Robot.mark`."""
        check_has_marks(self._replica.state.map_name or "")
        check_place(mark, self._replica.geometry)
        attached = attachment_bytes(attachment)
        if attached:
            mark = mark.model_copy(update={"attachment": attachment_of(attached)})
        target = None if instead_of is None else commit_id_of(instead_of)
        commit = self._replica.mark(mark, instead_of=target, attached=attached)
        self._on_commit(commit)
        return commit

    def _amend(self, found: CommitId, move: Move, *, note: str, profile: Profile) -> Commit:
        measurement = self._new_measurement()
        if measurement is None:
            raise BadInputError("no_rig", "this robot was opened without a rig, so it cannot read scans")
        # The measurement again, from the same scans at their corrected poses.
        poses = []
        for scan in move(self._kept.scans(found)):
            measurement.add(scan)
            poses.append(scan.T_map_rig)
        diff, facts = measurement.diff(), self._facts_of(measurement, note)
        commit = self._replica.amend(found, diff, facts, profile=profile, T_map_rig=np.array(poses))
        # The scans are kept under the amend from here on: the next amend names it.
        self._kept.rename(found, commit.id)
        self._on_commit(commit)
        return commit

    def _scans_of(self, measurement: AnyCommit) -> CommitId:
        """Commit under which a measurement's scans are kept."""
        commit = commit_id_of(measurement)
        found = self._replica.original_of(commit, self._kept.commits)
        if found is None:
            raise NotFoundError("no_scans", f"{commit} cannot be amended: {self._why_not(commit)}")
        return found

    def _why_not(self, commit: CommitId) -> str:
        """Reason why a commit's scans are not here."""
        own = self._replica.author.robot
        if commit.author.robot != own:
            return f"it is {commit.author.robot}'s, and this robot, {own}, amends its own alone"
        if not self._replica.has_made(commit):
            return "this folder knows no such commit; `cairn robot queue DIR` lists those it has"
        return f"its scans are not kept: {self._kept.why_gone(commit)}"


def commit_id_of(commit: AnyCommit) -> CommitId:
    """Id of a commit."""
    if isinstance(commit, Commit):
        return commit.id
    return commit_id_from_text(commit) if isinstance(commit, str) else commit


def _move(T_map_rig: npt.ArrayLike | None, T_map_observed: npt.ArrayLike | None) -> Move:
    """Move of scans to where they were taken: to given poses, or from the observed ones by a correction.

    Raises:
        BadInputError: not exactly one of both, or another shape.
    """
    if (T_map_rig is None) == (T_map_observed is None):
        raise BadInputError("bad_option", "amend needs either T_map_rig, a pose for each scan, or T_map_observed")
    if T_map_observed is not None:
        correction = check_transform(T_map_observed, name="T_map_observed")
        return lambda scans: (move_scan(scan, correction @ scan.T_map_rig) for scan in scans)
    poses = np.asarray(T_map_rig, np.float64)
    if poses.ndim != 3 or poses.shape[1:] != (4, 4):
        raise BadInputError("bad_transform", f"T_map_rig must be (N, 4, 4), a pose for each scan, got {poses.shape}")

    def moved(scans: Iterator[Scan]) -> Iterator[Scan]:
        count = 0
        for count, scan in enumerate(scans, 1):
            if count <= len(poses):
                yield move_scan(scan, poses[count - 1])
        if count != len(poses):
            raise BadInputError("bad_transform", f"the measurement has {count} scans, got {len(poses)} poses for them")

    return moved
