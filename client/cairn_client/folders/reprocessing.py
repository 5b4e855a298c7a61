"""Reprocessing: the kept scans of a robot's folder integrated again under another rig, as the robot's own amends.

    plan_of      measurements to amend, those that are amended already, those whose scans are gone; nothing is written
    reprocess    one amend for each of them; each is one transaction, and what is done stays done

A measurement is done if its newest form (`kept_folder`) states the wanted rig and integrator. So a second run finds
nothing to do, and one after a kill goes on.
"""

from collections import Counter
from collections.abc import Collection, Generator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from cairn_calib.rig.rig import Rig
from cairn_client.folders.kept_folder import (
    Form,
    KeptFolder,
    at_stated_place,
    form_of,
    forms_without_scans,
    kept_folder,
)
from cairn_client.robot.amending import facts_of_measurement
from cairn_fusion.mapping.integrate import Integrator, integrator_from_text
from cairn_fusion.mapping.measurement import Measurement
from cairn_fusion.recording.scan import check_scan
from cairn_fusion.recording.scan_bytes import place_scan
from cairn_map.codec.cell_code import Profile
from cairn_map.commits.ids import CommitId, commit_id_from_text
from cairn_map.errors import BadInputError, CairnError, ConflictError, DamagedDataError, UnreachableError


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


def plan_of(folder: Path, recipe: Recipe) -> FolderPlan:
    """Plan of the measurements in a folder; nothing is written.

    Raises:
        BadInputError: kind `no_state_folder`: no robot keeps its map there; kind `viewer`: it is a copy, which makes no
            commits; or a scan that is to be integrated does not fit the rig.
        ConflictError: kind `folder_in_use`: a robot has it open.
        DamagedDataError: it is broken.
    """
    with kept_folder(folder) as opened:
        return _plan(opened, recipe)


def reprocess(folder: Path, recipe: Recipe) -> Generator[FolderReport, None, None]:
    """Amend what `plan_of` names; the report so far, before the first measurement and after each.

    It may be ended at any point, and begun again.

    Raises:
        CairnError: as `plan_of`; nothing was written.
    """
    with kept_folder(folder) as opened:
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


def _plan(opened: KeptFolder, recipe: Recipe) -> FolderPlan:
    plan = FolderPlan(folder=opened.folder, robot=opened.robot, url=opened.state.url)
    forms = {}
    for original in opened.kept.commits:
        try:
            opened.outbox.original_of(original, [original])
            forms[original] = form_of(opened, opened.outbox.successors.latest(original))
        except ConflictError:
            plan.taken_back += 1
        except DamagedDataError as exc:
            plan.failed[original] = exc
    unknown = _unrecorded_amends(opened)
    for original, form in forms.items():
        if _is_done(form, recipe):
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


def _is_done(form: Form, recipe: Recipe) -> bool:
    """True if its evidence is that of the wanted rig and integrator."""
    return form.rig == recipe.rig.digest() and form.integrator == str(recipe.integrator(form.integrator))


def _unrecorded_amends(opened: KeptFolder) -> Collection[CommitId]:
    """Commits that took another one's place: if no record says more, they may be amends from before there were any."""
    store = opened.state.store
    found = (store.get(key) for key in store.keys("successor:"))
    return {commit_id_from_text(text) for text in found if text}


def _check_scans(opened: KeptFolder, original: CommitId, form: Form, recipe: Recipe, plan: FolderPlan) -> None:
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


def _find_lost(opened: KeptFolder, recipe: Recipe, plan: FolderPlan) -> None:
    """Plan the measurements without scans that are not done yet."""
    for form in forms_without_scans(opened):
        if _is_done(form, recipe):
            continue
        if recipe.old_rigs and form.rig is not None and form.rig not in recipe.old_rigs:
            plan.other_rig += 1
        else:
            plan.lost.append(form.commit)


def _amend(opened: KeptFolder, original: CommitId, recipe: Recipe) -> None:
    """Integrate one measurement's scans again, and commit that in its place; in any case all of it or nothing."""
    form = form_of(opened, opened.outbox.successors.latest(original))
    with suppress(OSError):  # it can be named again, where the disk is full
        opened.kept.keep_rig(recipe.rig)
    measurement = Measurement(recipe.rig, opened.layer.geometry, recipe.integrator(form.integrator))
    # Where its last form has them; the kept scans have the poses that were observed.
    recorded = form.record.T_map_rig if form.record else None
    poses, is_moved = [], False
    for number, scan in enumerate(opened.kept.scans(original)):
        if recorded is None or number >= len(recorded):
            there = scan if form.record else at_stated_place(scan, number, form.stated)
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
