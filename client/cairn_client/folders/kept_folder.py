"""Robot's folder opened to integrate its kept scans again: measurements in their newest form, and a writer of amends.

A measurement is taken in its newest form: its scans stand where its last amend put them, bit for bit.

The robot's map is not read, so a folder takes the memory of a few measurements, however large its map is; only a robot
whose disk is bounded reads it, to drop what makes room. The view changes when the robot opens the folder again.
"""

from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
import numpy.typing as npt

from cairn_calib.rig.poses import transform_from_quaternion
from cairn_client.folders.state_folder import check_state_folder
from cairn_client.replica.limits import STANDARD_LIMITS, Limits
from cairn_client.replica.outbox import CommitFacts, Outbox
from cairn_client.replica.replica import Replica
from cairn_client.replica.replica_state import AmendRecord, ReplicaState
from cairn_client.replica.replica_store import ReplicaStore
from cairn_client.robot.cell_budget import CellBudget
from cairn_client.robot.kept_scans import KeptScans
from cairn_client.robot.robot_events import Events
from cairn_fusion.mapping.measurement import scan_pose
from cairn_fusion.recording.scan import Scan
from cairn_fusion.recording.scan_bytes import move_scan
from cairn_map.codec.cell_code import Profile
from cairn_map.commits.commit import Commit, CommitMeta, split_commit
from cairn_map.commits.ids import CommitId, RobotName, robot_name
from cairn_map.epochs.layer import MapLayer
from cairn_map.errors import BadInputError
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.grid import CellKey


@dataclass(frozen=True, slots=True, kw_only=True)
class Form:
    """The newest form of a measurement: what its last commit states."""

    commit: CommitId
    rig: str | None
    """None: unknown, or without one."""
    integrator: str
    scans: int | None
    """Number of scans; None: unknown."""
    stated: CommitMeta | None
    """Facts of the commit, if its bytes are here."""
    record: AmendRecord | None


class AmendWriter(Protocol):
    """Function that keeps an amend."""

    def __call__(
        self,
        target: CommitId,
        diff: dict[CellKey, Evidence],
        facts: CommitFacts,
        *,
        profile: Profile,
        T_map_rig: npt.NDArray[np.float64] | None,
    ) -> Commit:
        """Keep it durably; as `Outbox.amend`."""
        ...


@dataclass(frozen=True, slots=True)
class KeptFolder:
    """A robot's folder, with its lock held."""

    folder: Path
    state: ReplicaState
    outbox: Outbox
    kept: KeptScans
    layer: MapLayer
    robot: RobotName
    write: AmendWriter


@contextmanager
def kept_folder(folder: Path) -> Iterator[KeptFolder]:
    """A robot's folder, open until the end of the block.

    Raises:
        BadInputError: kind `no_state_folder`: no robot keeps its map there; kind `viewer`: it is a copy, which makes no
            commits.
        ConflictError: kind `folder_in_use`: a robot has it open.
        DamagedDataError: it is broken.
    """
    check_state_folder(folder)
    with closing(ReplicaStore(folder)) as store:
        state = ReplicaState(store)
        known, map_name, layer = state.robot, state.map_name, state.layer
        if known is None or map_name is None or layer is None:
            raise BadInputError("no_state_folder", f"{folder} was never used by a robot, so no scans are kept there")
        if state.mode == "viewer":
            raise BadInputError("viewer", f"{folder} is a copy of a map, which makes no commits; name robots' folders")
        robot, limits = robot_name(known), state.limits or STANDARD_LIMITS
        kept = KeptScans(folder / "scans", bytes_max=0)
        if limits.keeps_commits:
            outbox, write = _unbounded(state, robot, layer, kept)
        else:
            outbox, write = _bounded(state, robot, map_name, layer, limits)
        yield KeptFolder(folder, state, outbox, kept, layer, robot, write)


def _unbounded(state: ReplicaState, robot: RobotName, layer: MapLayer, kept: KeptScans) -> tuple[Outbox, AmendWriter]:
    """The outbox of a robot whose disk is not bounded, without its map."""
    outbox = Outbox(state, robot, layer, make_room=lambda size_bytes: None, amendable=lambda: kept.commits)

    def write(
        target: CommitId,
        diff: dict[CellKey, Evidence],
        facts: CommitFacts,
        *,
        profile: Profile,
        T_map_rig: npt.NDArray[np.float64] | None,
    ) -> Commit:
        return outbox.amend(target, diff, facts, seen=state.default_cursor, profile=profile, T_map_rig=T_map_rig)

    return outbox, write


def _bounded(
    state: ReplicaState, robot: RobotName, map_name: str, layer: MapLayer, limits: Limits
) -> tuple[Outbox, AmendWriter]:
    """The outbox of a robot whose disk is bounded: amends drop what commits would."""
    replica = Replica(
        state.store,
        robot=robot,
        map_name=map_name,
        geometry=layer.geometry,
        epoch_s=layer.epoch_s,
        memory_bytes_max=limits.map_bytes_max,
        keep_acked_s=limits.keep_acked_s,
    )
    CellBudget(replica, limits, Events(), place=lambda: None, scope_box=None)
    return replica.outbox, replica.amend


def form_of(opened: KeptFolder, latest: CommitId) -> Form:
    """The form that a measurement's last commit states."""
    record, data = opened.outbox.amends.of(latest), opened.state.store.commit_data(latest)
    stated = split_commit(data)[0] if data else None
    facts = record or stated
    count = record.scans if record else len(stated.scans) if stated else None
    return Form(
        commit=latest,
        rig=facts.rig if facts else None,
        integrator=facts.integrator if facts else "",
        scans=count,
        stated=stated,
        record=record,
    )


def forms_without_scans(opened: KeptFolder) -> Iterator[Form]:
    """Newest forms of the measurements of which no scans are kept: own commits with evidence that nothing replaced."""
    latest = opened.outbox.successors.latest
    have = {latest(original) for original in opened.kept.commits}
    for commit in opened.state.store.commits():
        is_own = commit.id.author.robot == opened.robot and bool(commit.cells)
        if not is_own or commit.id in have or latest(commit.id) != commit.id:
            continue
        form = form_of(opened, commit.id)
        if form.record is not None or form.stated is None or form.rig is not None:
            yield form


def at_stated_place(scan: Scan, number: int, stated: CommitMeta | None) -> Scan:
    """A scan where its commit states it, as exact as a quaternion; itself if that is where it was observed.

    The commit is the first one, or an amend from before records were kept.
    """
    if stated is None or number >= len(stated.scans):
        return scan
    pose, observed = stated.scans[number], scan_pose(scan.time_s, scan.T_map_rig)
    if (observed.t_map_rig, observed.q_map_rig) == (pose.t_map_rig, pose.q_map_rig):
        return scan
    return move_scan(scan, transform_from_quaternion(pose.t_map_rig, pose.q_map_rig))
