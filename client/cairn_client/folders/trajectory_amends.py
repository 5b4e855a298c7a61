"""Amends by a trajectory: the kept scans of a robot's folder integrated again at the poses that a SLAM found for them.

    kept_measurements   their newest forms
    plan_moves          which of them the trajectory moves, by how much, and which it cannot; nothing is written
    move_all            one amend for each of them; each is one transaction, and what is done stays done

Rig and integrator stay those of each measurement's newest form. A measurement is done if the poses of that form are the
trajectory's, bit for bit: so a second run finds nothing to do, and one after a kill goes on.
"""

import os
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

from cairn_calib.rig.poses import Transform, check_transform
from cairn_calib.rig.rig import Rig
from cairn_client.folders.kept_folder import Form, KeptFolder, form_of, forms_without_scans
from cairn_client.replica.outbox import CommitFacts
from cairn_client.robot.amending import facts_of_measurement
from cairn_fusion.mapping.integrate import Integrator, integrator_from_text
from cairn_fusion.mapping.measurement import Measurement, scan_pose
from cairn_fusion.recording.frame_poses import RIG, FrameKey, FramePoses
from cairn_fusion.recording.scan_bytes import place_scan
from cairn_map.codec.cell_code import Profile
from cairn_map.commits.commit import ScanPose
from cairn_map.commits.ids import CommitId
from cairn_map.errors import BadInputError, CairnError, ConflictError, DamagedDataError, NotFoundError, UnreachableError
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.grid import CellKey

PosesOf = Callable[[Sequence[FrameKey]], "list[Transform | None]"]
"""Poses of the scans of these times in the map's frame; None for scans that stay as they are, with all of theirs."""
Poses = npt.NDArray[np.float64]
Diff = dict[CellKey, Evidence]
Integrated = Callable[[], tuple[Diff, CommitFacts]]
"""The evidence of a measurement and its facts, once they are computed; raises why they cannot be."""
THREADS = min(os.cpu_count() or 1, 4)
"""Threads that integrate, each with the memory of one measurement."""


@dataclass(frozen=True, slots=True)
class Move:
    """A measurement and the poses that its scans get."""

    original: CommitId
    """Commit under which its scans are kept."""
    T_map_rig: Poses
    """(N, 4, 4)"""
    step_m: float | None
    """Largest distance by which a scan moves; None: unknown, as its present poses went with the commit's bytes."""


@dataclass(slots=True, kw_only=True)
class MovePlan:
    """Measurements of one folder, by what a trajectory does to them."""

    folder: Path
    robot: str
    forms: dict[CommitId, tuple[Form, list[float]]] = field(default_factory=dict)
    """Newest form of each measurement whose scans are kept, and the times of these."""
    moves: list[Move] = field(default_factory=list)
    there: int = 0
    """Measurements that are where the trajectory has them."""
    taken_back: int = 0
    uncovered: list[CommitId] = field(default_factory=list)
    """Measurements of which a scan has no pose: they stay where they are."""
    lost: list[CommitId] = field(default_factory=list)
    """Measurements elsewhere whose scans are not kept any more."""
    failed: dict[CommitId, CairnError] = field(default_factory=dict)
    """Measurements that cannot be integrated again, and why."""
    amended: int = 0
    stopped: CairnError | None = None
    """Error that ended the work before its end; None: there was none."""


def trajectory_poses(found: FramePoses, T_map_world: Transform | None) -> PosesOf:
    """The poses of a file with poses by time, turned into the map's frame.

    Raises:
        BadInputError: kind `bad_option`: its poses are not by time, and kept scans have nothing else.
    """
    if not found.is_by_time:
        raise BadInputError(
            "bad_option",
            f"the poses of {found.file.path} are by {found.file.key.value}, and kept scans have times alone: give them "
            "by time, in TUM's form (time tx ty tz qx qy qz qw)",
        )

    def of(keys: Sequence[FrameKey]) -> "list[Transform | None]":
        try:
            poses = found.of_frames(keys)
        except BadInputError as exc:
            raise BadInputError(exc.kind, f"{exc.message} (their measurements stay); nothing was moved") from exc
        return [None if T is None else _turned(T, T_map_world) for T in poses]

    return of


def _turned(T_world_rig: Transform, T_map_world: Transform | None) -> Transform:
    """A pose as a replay gives it to its scan, bit for bit."""
    T = check_transform(T_world_rig, name="T_map_rig")
    return T if T_map_world is None else check_transform(T_map_world @ T, name="T_map_rig")


def head_of(opened: KeptFolder, plan: MovePlan, given: Rig | None, *, of: str | None) -> Rig:
    """The head that a trajectory's poses are of, or are turned to.

    Args:
        opened: the robot's folder.
        plan: its measurements.
        given: head of measurements whose head is not kept in the folder.
        of: camera of the head that the poses are of; None: the head itself.

    Raises:
        NotFoundError: kind `no_scans`: no scans are kept.
        BadInputError: kind `no_rig`: the head is not kept, and none was given; kind `several_rigs`: the poses are of a
            camera, and heads carry it in different places.
    """
    if not plan.forms:
        raise NotFoundError(
            "no_scans",
            f"{opened.folder} keeps no scans, so no measurement of {opened.robot} can be moved: give --keep-scans MB "
            "to `cairn robot run`, `replay` or `live` before they are mapped",
        )
    heads = {form.rig: _rig_of(opened, form, given) for form, _ in plan.forms.values()}
    if of not in (None, RIG) and len(heads) > 1:
        raise BadInputError(
            "several_rigs",
            f"the measurements in {opened.folder} are of {len(heads)} heads: give poses of the rig, not of {of}",
        )
    return list(heads.values())[-1]


def kept_measurements(opened: KeptFolder) -> MovePlan:
    """Measurements whose scans are kept, none of which moves yet."""
    plan = MovePlan(folder=opened.folder, robot=opened.robot)
    for original in opened.kept.commits:
        try:
            opened.outbox.original_of(original, [original])
            form = form_of(opened, opened.outbox.successors.latest(original))
            times_s = opened.kept.times_s(original)
            if form.scans is not None and len(times_s) != form.scans:
                raise DamagedDataError("damaged_scan", f"{len(times_s)} scans are kept of the {form.scans}")
            plan.forms[original] = form, times_s
        except ConflictError:
            plan.taken_back += 1
        except DamagedDataError as exc:
            plan.failed[original] = exc
    return plan


def plan_moves(opened: KeptFolder, plan: MovePlan, poses_of: PosesOf, given: Rig | None = None) -> None:
    """Plan the moves of these measurements; nothing is written.

    Args:
        opened: the robot's folder.
        plan: its measurements; what becomes of them is noted in it.
        poses_of: the trajectory.
        given: head of measurements whose head is not kept in the folder.

    Raises:
        BadInputError: no scan has a pose, or one has none and that was not allowed; kind `no_rig`: a head is not kept.
    """
    # Stage 1: the poses of all scans at once, so that one sentence says how many have none.
    keys = [
        FrameKey(label=f"scan {n} of {original} at {time_s:.6f} s", time_s=time_s)
        for original, (_, times_s) in plan.forms.items()
        for n, time_s in enumerate(times_s)
    ]
    found = iter(poses_of(keys) if keys else [])
    # Stage 2: what moves.
    for original, (form, times_s) in plan.forms.items():
        poses = [pose for _, pose in zip(times_s, found, strict=False)]
        known = [pose for pose in poses if pose is not None]
        if len(known) < len(poses):
            plan.uncovered.append(original)
            continue
        T_map_rig = np.array(known).reshape(-1, 4, 4)
        try:
            if _is_there(opened, original, form, T_map_rig):
                plan.there += 1
                continue
        except DamagedDataError as exc:
            plan.failed[original] = exc
            continue
        _rig_of(opened, form, given)
        plan.moves.append(Move(original, T_map_rig, _step_m(form, T_map_rig)))
    # Stage 3: what would move if its scans were here.
    _find_lost(opened, poses_of, plan)


def move_all(opened: KeptFolder, plan: MovePlan, given: Rig | None, *, profile: Profile, note: str) -> Iterator[Move]:
    """Amend what the plan names; each move once it is done, or failed. It may be ended at any point, and begun again.

    Args:
        opened: the folder of the plan.
        plan: what was done, and what failed, is noted in it.
        given: as for `plan_moves`.
        profile: coding of the commits.
        note: the reason, for the map's log.
    """
    for move, integrated in _integrated_ahead(opened, plan.moves, given, note):
        try:
            diff, facts = integrated()
            commit = opened.write(move.original, diff, facts, profile=profile, T_map_rig=move.T_map_rig)
            # A kill here leaves the scans under the older id, from which the amend's record leads to the new one.
            opened.kept.rename(move.original, commit.id)
            plan.amended += 1
        except UnreachableError as exc:  # no room: the next one would find none either
            plan.stopped = exc
            return
        except (BadInputError, DamagedDataError) as exc:
            plan.failed[move.original] = exc
        yield move


def _integrated_ahead(
    opened: KeptFolder, moves: Sequence[Move], given: Rig | None, note: str
) -> Iterator[tuple[Move, Integrated]]:
    """Moves in their order, each with its evidence, which threads compute ahead of the caller, who writes.

    The evidence is the same in whatever order they are done: all of it is integers, and none depends on the map.
    """
    with ThreadPoolExecutor(THREADS) as pool:
        waiting: deque[tuple[Move, Integrated]] = deque()
        try:
            for move in moves:
                waiting.append((move, _start(pool, opened, move, given, note)))
                if len(waiting) > THREADS:
                    yield waiting.popleft()
            while waiting:
                yield waiting.popleft()
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


def _start(pool: ThreadPoolExecutor, opened: KeptFolder, move: Move, given: Rig | None, note: str) -> Integrated:
    """Have a thread integrate one measurement's scans at their new poses; the result raises what that did."""
    try:
        # Read here: the folder's state belongs to the caller's thread.
        form = form_of(opened, opened.outbox.successors.latest(move.original))
        rig, integrator = _rig_of(opened, form, given), integrator_from_text(form.integrator) or Integrator()
    except (BadInputError, DamagedDataError) as exc:
        failed: Future[tuple[Diff, CommitFacts]] = Future()
        failed.set_exception(exc)
        return failed.result

    def integrate() -> tuple[Diff, CommitFacts]:
        measurement = Measurement(rig, opened.layer.geometry, integrator)
        for scan, T_map_rig in zip(opened.kept.scans(move.original), move.T_map_rig, strict=True):
            measurement.add(place_scan(scan, T_map_rig))
        return measurement.diff(), facts_of_measurement(measurement, note=note)

    return pool.submit(integrate).result


def _rig_of(opened: KeptFolder, form: Form, given: Rig | None) -> Rig:
    """The head of a measurement.

    Raises:
        BadInputError: kind `no_rig`: it is not kept, and none of its digest was given.
    """
    if given is not None and form.rig in (None, given.digest()):
        return given
    kept = None if form.rig is None else opened.kept.rig(form.rig)
    if kept is None:
        raise BadInputError(
            "no_rig",
            f"the head of {form.commit} ({form.rig or 'unknown'}) is not kept in {opened.folder}; give its rig.json "
            "with --rig. Nothing was moved",
        )
    return kept


def _is_there(opened: KeptFolder, original: CommitId, form: Form, T_map_rig: Poses) -> bool:
    """True if the poses of a measurement's newest form are these, bit for bit."""
    recorded = form.record.T_map_rig if form.record else None
    if recorded is not None:
        return np.array_equal(recorded, T_map_rig)
    # Observed poses are exact in the kept scans alone, and quaternions tell first whether it is worth reading them.
    if form.stated is not None and not _states(form.stated.scans, T_map_rig):
        return False
    observed = (scan.T_map_rig for scan in opened.kept.scans(original))
    return all(np.array_equal(T, new) for T, new in zip(observed, T_map_rig, strict=True))


def _states(scans: Sequence[ScanPose], T_map_rig: Poses) -> bool:
    """True if a commit states these poses, as exact as a quaternion."""
    return len(scans) == len(T_map_rig) and all(
        scan_pose(stated.time_s, T) == stated for stated, T in zip(scans, T_map_rig, strict=True)
    )


def _step_m(form: Form, T_map_rig: Poses) -> float | None:
    recorded = form.record.T_map_rig if form.record else None
    if recorded is not None:
        before = recorded[:, :3, 3]
    elif form.stated is not None and len(form.stated.scans) == len(T_map_rig):
        before = np.array([scan.t_map_rig for scan in form.stated.scans])
    else:
        return None
    return float(np.linalg.norm(T_map_rig[:, :3, 3] - before, axis=1).max(initial=0.0))


def _find_lost(opened: KeptFolder, poses_of: PosesOf, plan: MovePlan) -> None:
    """Plan the measurements without scans that are elsewhere."""
    for form in forms_without_scans(opened):
        if not _are_there(form.stated.scans if form.stated else (), poses_of):
            plan.lost.append(form.commit)


def _are_there(scans: Sequence[ScanPose], poses_of: PosesOf) -> bool:
    """True if a commit states its scans where the trajectory has them."""
    keys = [FrameKey(label=f"the scan at {scan.time_s:.6f} s", time_s=scan.time_s) for scan in scans]
    try:
        poses = [T for T in poses_of(keys) if T is not None] if keys else []
    except BadInputError:  # without poses for them
        return False
    return bool(scans) and len(poses) == len(scans) and _states(scans, np.array(poses))
