"""Reprocessing: the kept scans of a robot's folder integrated again under another rig, as the robot's own amends.

    plan_of      measurements to amend, those that are amended already, those whose scans are gone; nothing is written
    reprocess    one amend for each of them; each is one transaction, and what is done stays done

A measurement is taken in its newest form: its scans stand where its last amend put them, bit for bit. It is done if
that form states the wanted rig and integrator. So a second run finds nothing to do, and one after a kill goes on.

The robot's map is not read, so a folder takes the memory of one measurement, however large its map is; only a robot
whose disk is bounded reads it, to drop what makes room. The view changes when the robot opens the folder again.
"""

from collections import Counter
from collections.abc import Collection, Generator, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol

import numpy as np
import numpy.typing as npt

from cairn_calib.rig.poses import transform_from_quaternion
from cairn_calib.rig.rig import Rig
from cairn_client.folders.state_folder import check_state_folder
from cairn_client.replica.limits import STANDARD_LIMITS, Limits
from cairn_client.replica.outbox import CommitFacts, Outbox
from cairn_client.replica.replica import Replica
from cairn_client.replica.replica_state import AmendRecord, ReplicaState
from cairn_client.replica.replica_store import ReplicaStore
from cairn_client.robot.amending import facts_of_measurement
from cairn_client.robot.cell_budget import CellBudget
from cairn_client.robot.kept_scans import KeptScans
from cairn_client.robot.robot_events import Events
from cairn_fusion.mapping.integrate import Integrator, integrator_from_text
from cairn_fusion.mapping.measurement import Measurement, scan_pose
from cairn_fusion.recording.scan import Scan, check_scan
from cairn_fusion.recording.scan_bytes import move_scan, place_scan
from cairn_map.codec.cell_code import Profile
from cairn_map.commits.commit import Commit, CommitMeta, split_commit
from cairn_map.commits.ids import CommitId, RobotName, commit_id_from_text, robot_name
from cairn_map.epochs.layer import MapLayer
from cairn_map.errors import BadInputError, CairnError, ConflictError, DamagedDataError, UnreachableError
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.grid import CellKey


@dataclass(frozen=True, slots=True, kw_only=True)
class Recipe:
    """Rig and limits under which kept scans are integrated again, and which measurements are."""

    rig: Rig
    old_rigs: frozenset[str] = frozenset()
    """Digests of the rigs to replace; empty: any."""
    min_range_m: float | None = None
    """None: the limit that each measurement states."""
    max_range_m: float | None = None
    """None: the limit that each measurement states."""
    profile: Profile = Profile.FAST
    note: str = ""

    def integrator(self, stated: str) -> Integrator:
        """The integrator of a measurement that states this one."""
        known = integrator_from_text(stated) or Integrator()
        return replace(
            known,
            min_range_m=known.min_range_m if self.min_range_m is None else self.min_range_m,
            max_range_m=known.max_range_m if self.max_range_m is None else self.max_range_m,
        )


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

    def is_done(self, recipe: Recipe) -> bool:
        """True if its evidence is that of the wanted rig and integrator."""
        return self.rig == recipe.rig.digest() and self.integrator == str(recipe.integrator(self.integrator))


@dataclass(slots=True, kw_only=True)
class FolderPlan:
    """Measurements of one folder, by what is to become of them."""

    folder: Path
    robot: str
    url: str | None
    to_amend: list[CommitId] = field(default_factory=list)
    """Commits under which their scans are kept."""
    rigs: Counter[str] = field(default_factory=Counter)
    """Number of measurements to amend by the rig that they state now; without those whose rig is not known any more."""
    done: int = 0
    """Measurements that are of the wanted rig and integrator already."""
    taken_back: int = 0
    other_rig: int = 0
    """Measurements of rigs that are not to be replaced."""
    lost: list[CommitId] = field(default_factory=list)
    """Measurements whose scans are not kept any more."""
    failed: dict[CommitId, CairnError] = field(default_factory=dict)
    """Measurements that cannot be integrated again, and why."""


@dataclass(slots=True, kw_only=True)
class FolderReport:
    """Outcome for one folder."""

    plan: FolderPlan
    tried: int = 0
    """Measurements that were amended or failed."""
    amended: int = 0
    waiting: int = 0
    """Commits that the server has not acknowledged."""
    stopped: CairnError | None = None
    """Error that ended it before its end; None: there was none."""


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
class _Opened:
    """A robot's folder, with its lock held."""

    folder: Path
    state: ReplicaState
    outbox: Outbox
    kept: KeptScans
    layer: MapLayer
    robot: RobotName
    write: AmendWriter


def plan_of(folder: Path, recipe: Recipe) -> FolderPlan:
    """Plan of the measurements in a folder; nothing is written.

    Raises:
        BadInputError: kind `no_state_folder`: no robot keeps its map there; kind `viewer`: it is a copy, which makes no
            commits; or a scan that is to be integrated does not fit the rig.
        ConflictError: kind `folder_in_use`: a robot has it open.
        DamagedDataError: it is broken.
    """
    with _opened(folder) as opened:
        return _plan(opened, recipe)


def reprocess(folder: Path, recipe: Recipe) -> Generator[FolderReport, None, None]:
    """Amend what `plan_of` names; the report so far, before the first measurement and after each.

    It may be ended at any point, and begun again.

    Raises:
        CairnError: as `plan_of`; nothing was written.
    """
    with _opened(folder) as opened:
        report = FolderReport(plan=_plan(opened, recipe))
        for original in report.plan.to_amend:
            yield report
            try:
                _amend(opened, original, recipe)
                report.amended += 1
            except UnreachableError as exc:  # no room: the next one would find none either
                report.stopped = exc
                break
            except (BadInputError, DamagedDataError) as exc:
                report.plan.failed[original] = exc
            report.tried += 1
        report.waiting = len(opened.outbox.push_set(opened.state.header))
        yield report


@contextmanager
def _opened(folder: Path) -> Iterator[_Opened]:
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
        yield _Opened(folder, state, outbox, kept, layer, robot, write)


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


def _plan(opened: _Opened, recipe: Recipe) -> FolderPlan:
    plan = FolderPlan(folder=opened.folder, robot=opened.robot, url=opened.state.url)
    forms = {}
    for original in opened.kept.commits:
        try:
            opened.outbox.original_of(original, [original])
            forms[original] = _form(opened, opened.outbox.successors.latest(original))
        except ConflictError:
            plan.taken_back += 1
        except DamagedDataError as exc:
            plan.failed[original] = exc
    unknown = _unrecorded_amends(opened)
    for original, form in forms.items():
        if form.is_done(recipe):
            plan.done += 1
        elif recipe.old_rigs and form.rig is not None and form.rig not in recipe.old_rigs:
            plan.other_rig += 1
        elif form.record is None and form.stated is None and (recipe.old_rigs or form.commit in unknown):
            plan.failed[original] = BadInputError(
                "no_bytes",
                f"its rig and poses are not known any more: the bytes of {form.commit} went for the folder's limits",
            )
        else:
            _check_scans(opened, original, form, recipe, plan)
    _find_lost(opened, recipe, plan)
    return plan


def _form(opened: _Opened, latest: CommitId) -> Form:
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


def _unrecorded_amends(opened: _Opened) -> Collection[CommitId]:
    """Commits that took another one's place: if no record says more, they may be amends from before there were any."""
    store = opened.state.store
    found = (store.get(key) for key in store.keys("successor:"))
    return {commit_id_from_text(text) for text in found if text}


def _check_scans(opened: _Opened, original: CommitId, form: Form, recipe: Recipe, plan: FolderPlan) -> None:
    """Plan one measurement, if its scans are sound.

    Raises:
        BadInputError: they do not fit the rig.
    """
    try:
        for scan in opened.kept.sample_scans(original):
            check_scan(scan, recipe.rig)
    except DamagedDataError as exc:
        plan.failed[original] = exc
    except BadInputError as exc:
        raise BadInputError(
            exc.kind,
            f"the scans of {original} in {opened.folder} do not fit the rig {recipe.rig.name}: {exc.message}; nothing "
            "was written. Give the rig of this robot's head, or --old-rig with the rig that it replaces",
        ) from exc
    else:
        plan.to_amend.append(original)
        if form.rig is not None:
            plan.rigs[form.rig] += 1


def _find_lost(opened: _Opened, recipe: Recipe, plan: FolderPlan) -> None:
    """Plan the measurements without scans: own commits with evidence that nothing replaced."""
    latest = opened.outbox.successors.latest
    have = {latest(original) for original in opened.kept.commits}
    for commit in opened.state.store.commits():
        if commit.id.author.robot != opened.robot or not commit.cells or commit.id in have:
            continue
        if latest(commit.id) != commit.id:
            continue
        form = _form(opened, commit.id)
        is_measured = form.record is not None or form.stated is None or form.rig is not None
        if not is_measured or form.is_done(recipe):
            continue
        if recipe.old_rigs and form.rig is not None and form.rig not in recipe.old_rigs:
            plan.other_rig += 1
        else:
            plan.lost.append(commit.id)


def _amend(opened: _Opened, original: CommitId, recipe: Recipe) -> None:
    """Integrate one measurement's scans again, and commit that in its place; in any case all of it or nothing."""
    form = _form(opened, opened.outbox.successors.latest(original))
    measurement = Measurement(recipe.rig, opened.layer.geometry, recipe.integrator(form.integrator))
    # Where its last form has them; the kept scans have the poses that were observed.
    recorded = form.record.T_map_rig if form.record else None
    poses, is_moved = [], False
    for number, scan in enumerate(opened.kept.scans(original)):
        if recorded is None or number >= len(recorded):
            there = scan if form.record else _at_stated_place(scan, number, form.stated)
        else:
            there = place_scan(scan, recorded[number])
        measurement.add(there)
        poses.append(there.T_map_rig)
        is_moved |= there is not scan
    if form.scans is not None and len(poses) != form.scans:
        raise DamagedDataError("damaged_scan", f"{len(poses)} scans are kept of the {form.scans} of {original}")
    commit = opened.write(
        original,
        measurement.diff(),
        facts_of_measurement(measurement, note=recipe.note),
        profile=recipe.profile,
        T_map_rig=np.array(poses) if is_moved else None,
    )
    # A kill before this line leaves the scans under the older id, from which the amend's record leads to the new one.
    opened.kept.rename(original, commit.id)


def _at_stated_place(scan: Scan, number: int, stated: CommitMeta | None) -> Scan:
    """A scan where its commit states it, as exact as a quaternion; itself if that is where it was observed.

    The commit is the first one, or an amend from before records were kept.
    """
    if stated is None or number >= len(stated.scans):
        return scan
    pose, observed = stated.scans[number], scan_pose(scan.time_s, scan.T_map_rig)
    if (observed.t_map_rig, observed.q_map_rig) == (pose.t_map_rig, pose.q_map_rig):
        return scan
    return move_scan(scan, transform_from_quaternion(pose.t_map_rig, pose.q_map_rig))
