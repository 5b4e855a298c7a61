"""Integrate the kept scans of robots' folders again under a new rig, as each robot's own amends.

    $ cairn reprocess cairn-mole/ cairn-wren/ --rig recalibrated.json
    cairn-mole: 36 measurements of mole amended; 36 commits wait
    cairn-wren: 12 measurements of wren amended, 2 were done before, 1 was taken back; 14 commits wait
    took 41.2 s in 2 processes; push them: cairn robot sync cairn-mole; cairn robot sync cairn-wren

A robot keeps scans with --keep-scans MB (`cairn robot run`, `replay`). Once its rig is calibrated again, each of its
measurements is made again from them, at the same poses, and takes the place of the old one: as they sync, all maps
become the map that the new rig would have given from the start, byte for byte. It needs no link. Sync before, so that
the folder knows what operators took back, which stays out; and after it, which sends the amends.

RIG is that of the heads of all folders named; heads that differ are reprocessed one after the other. If the
measurements are of several rigs, --old-rig names those that RIG replaces: rig.json, or the digest in commits. Ranges
are limited as each measurement was, or as --min-range and --max-range say: with the same rig, another integrator.

The folders are shared out among --jobs processes; in each, one measurement after the other. Each amend is one
transaction: after ^C or a kill, the same command goes on, and once all is done it changes nothing. Measurements whose
scans are not kept any more stay as they are; they are listed, and the exit code is 3.
"""

import argparse
import os
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from pydantic import BaseModel, ConfigDict

from cairn_calib.rig.rig import load_rig
from cairn_client.cli.arguments import parser, say
from cairn_client.cli.maps.command import rig_digest
from cairn_client.cli.robots.left_measurements import (
    LeftMeasurements,
    check_note,
    raise_left,
    say_left,
    shown_measurements,
)
from cairn_client.folders.folder_workers import folder_workers
from cairn_client.folders.reprocessing import FolderPlan, FolderReport, Recipe
from cairn_client.folders.state_folder import check_state_folder
from cairn_map.codec.cell_code import Profile
from cairn_map.errors import BadInputError

NOTE = "reprocessed"
"""Note of the amends, unless --note says more."""


class ReprocessedFolder(BaseModel):
    """A folder in the output of `cairn reprocess --json`, a line each; names are added, never changed."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    folder: str
    robot: str
    to_amend: int
    """Measurements that were to be amended."""
    amended: int
    """Measurements that were; 0 with --dry-run."""
    done_before: int
    taken_back: int
    other_rig: int
    """Measurements of rigs that are not to be replaced."""
    lost: list[str]
    """Commits of measurements whose scans are not kept any more."""
    failed: dict[str, str]
    """Commits of measurements that could not be integrated, and why."""
    stopped: str
    """Error that ended it before its end; empty: there was none."""
    waiting: int | None
    """Commits that the server has not acknowledged; None with --dry-run."""


def main(argv: list[str]) -> int:
    """Run the command."""
    options = parser("cairn reprocess", __doc__)
    options.add_argument("folders", nargs="+", type=Path, metavar="STATE", help="robots' folders")
    options.add_argument("--rig", required=True, type=Path, metavar="RIG", help="the new rig.json")
    options.add_argument(
        "--old-rig", action="append", default=[], metavar="RIG", help="only measurements of this rig; may be repeated"
    )
    for name, what in (("min", "nearer"), ("max", "farther")):
        options.add_argument(
            f"--{name}-range", type=float, metavar="METRES", help=f"ignore {what} ranges (as each measurement did)"
        )
    options.add_argument(
        "--profile", choices=list(Profile), default=Profile.FAST, help="small: fewer bytes, more work (fast)"
    )
    options.add_argument("--note", default=NOTE, help=f"the reason; kept in the map's log ({NOTE})")
    options.add_argument("--jobs", type=int, metavar="N", help="processes, of a folder each (the machine's cores)")
    options.add_argument("--dry-run", action="store_true", help="say what would be done, and change nothing")
    options.add_argument("--json", action="store_true", help="print JSON: a line for each folder")
    return _reprocess(options.parse_args(argv))


def _reprocess(args: argparse.Namespace) -> int:
    # Everything that can be refused is, before anything is written.
    recipe = _recipe(args)
    folders = _folders(args.folders)
    jobs = min(_jobs(args.jobs), len(folders))
    start_s = time.monotonic()
    with folder_workers(folders, recipe, jobs=jobs) as workers:
        plans = workers.plans()
        _check_rigs(plans, recipe)
        reports = [FolderReport(plan=plan) for plan in plans] if args.dry_run else workers.reprocess(plans)
    _say(reports, as_json=args.json, is_dry=args.dry_run)
    if not args.json and not args.dry_run:
        processes = "1 process" if jobs == 1 else f"{jobs} processes"
        sync = "; ".join(f"cairn robot sync {report.plan.folder}" for report in reports if report.waiting)
        say(f"took {time.monotonic() - start_s:.1f} s in {processes}" + (f"; push them: {sync}" if sync else ""))
    raise_left([_left(report) for report in reports])
    return 0


def _recipe(args: argparse.Namespace) -> Recipe:
    recipe = Recipe(
        rig=load_rig(args.rig),
        old_rigs=frozenset(rig_digest(text) for text in args.old_rig),
        min_range_m=args.min_range,
        max_range_m=args.max_range,
        profile=Profile(args.profile),
        note=args.note,
    )
    recipe.integrator("")
    check_note(args.note)
    return recipe


def _folders(named: Sequence[Path]) -> list[Path]:
    """The folders, each once."""
    folders = list({folder.resolve(): folder for folder in named}.values())
    for folder in folders:
        check_state_folder(folder)
    return folders


def _jobs(asked: int | None) -> int:
    if asked is not None and asked < 1:
        raise BadInputError("bad_option", f"--jobs takes 1 or more, got {asked}")
    return asked or len(os.sched_getaffinity(0))


def _check_rigs(plans: Sequence[FolderPlan], recipe: Recipe) -> None:
    """Refuse to put one rig in the place of several, unless they are named: two heads have two calibrations.

    Raises:
        BadInputError: kind `several_rigs`.
    """
    rigs = Counter[str]()
    for plan in plans:
        rigs.update(plan.rigs)
    if len(rigs) > 1 and not recipe.old_rigs:
        listed = ", ".join(f"{count} of {rig}" for rig, count in rigs.most_common())
        raise BadInputError(
            "several_rigs",
            f"these measurements are of {len(rigs)} rigs ({listed}); nothing was written: name each one that "
            f"{recipe.rig.name} replaces with --old-rig, or the folders of one head alone",
        )


def _say(reports: Sequence[FolderReport], *, as_json: bool, is_dry: bool) -> None:
    for report in reports:
        if as_json:
            say(_model(report, is_dry=is_dry).model_dump_json())
        else:
            _say_folder(report, is_dry=is_dry)


def _model(report: FolderReport, *, is_dry: bool) -> ReprocessedFolder:
    plan = report.plan
    return ReprocessedFolder(
        folder=str(plan.folder),
        robot=plan.robot,
        to_amend=len(plan.to_amend),
        amended=report.amended,
        done_before=plan.done,
        taken_back=plan.taken_back,
        other_rig=plan.other_rig,
        lost=[str(commit) for commit in plan.lost],
        failed={str(commit): f"{exc.message} [{exc.kind}]" for commit, exc in plan.failed.items()},
        stopped="" if report.stopped is None else f"{report.stopped.message} [{report.stopped.kind}]",
        waiting=None if is_dry else report.waiting,
    )


def _say_folder(report: FolderReport, *, is_dry: bool) -> None:
    plan = report.plan
    count = len(plan.to_amend) if is_dry else report.amended
    line = f"{plan.folder}: {shown_measurements(count)} of {plan.robot} {'would be ' * is_dry}amended"
    left = (plan.done, "done before"), (plan.taken_back, "taken back"), (plan.other_rig, "of other rigs")
    for number, text in left:
        line += f", {number} {text}" if number else ""
    say(line if is_dry else f"{line}; {report.waiting} commits wait")
    say_left(_left(report))


def _left(report: FolderReport) -> LeftMeasurements:
    return LeftMeasurements(lost=report.plan.lost, failed=report.plan.failed, stopped=report.stopped)
