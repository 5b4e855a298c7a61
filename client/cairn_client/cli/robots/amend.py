"""`cairn robot amend`: move a robot's past measurements to the poses that a SLAM found for them afterwards.

    $ cairn robot amend cairn-mole/ --trajectory optimised.tum
    poses: TUM (optimised.tum), T_map_rig, 812 poses
    cairn-mole: 36 measurements of mole amended, by up to 0.42 m, 2 were there before; 38 commits wait
    took 4.1 s; push them: cairn robot sync cairn-mole

A SLAM that closes a loop moves its past poses; save them as a trajectory (TUM's form: time tx ty tz qx qy qz qw, the
times those of the robot's scans), and give it here. Each measurement is integrated again from its kept scans at the new
poses, and takes the place of the old one: as they sync, all maps become the one that these poses would have given from
the start, byte for byte. A robot keeps scans with --keep-scans MB (`cairn robot run`, `replay`, `live`); amend needs no
link.

The folder of a `LayeredRobot` has one for each layer: those that it maps into are amended one after the other.

A scan's pose is interpolated between neighbours at most --max-pose-gap apart. If the trajectory does not cover all
scans, nothing is moved and the message says how many are outside and where; --skip-bad moves the measurements that are
covered whole, and leaves the others where they are. A map whose z axis was found with --up or --T-map-world needs the
same option here. The head is that of each measurement, which the folder keeps; for folders from before it did, --rig
names it.

Each amend is one transaction: after ^C or a kill the same command goes on, and once all is done it changes nothing.
Measurements whose scans are not kept any more stay as they are; they are listed, and the exit code is 3. A robot that
is at work has its folder for itself: its own program calls `Robot.amend_all`.
"""

import argparse
import time
from pathlib import Path

from pydantic import BaseModel, ConfigDict

from cairn_calib.rig.poses import Transform
from cairn_calib.rig.rig import Rig, load_rig
from cairn_client.cli.arguments import Subparsers, say
from cairn_client.cli.pose_arguments import add_trajectory_arguments, pose_options
from cairn_client.cli.robots.left_measurements import (
    LeftMeasurements,
    check_note,
    raise_left,
    say_left,
    shown_measurements,
)
from cairn_client.cli.source_arguments import add_up_arguments
from cairn_client.folders.kept_folder import KeptFolder, kept_folder
from cairn_client.folders.state_folder import layer_folders
from cairn_client.folders.trajectory_amends import (
    MovePlan,
    head_of,
    kept_measurements,
    move_all,
    plan_moves,
    trajectory_poses,
)
from cairn_fusion.recording.frame_poses import PoseOptions, read_frame_poses
from cairn_fusion.recording.turned_source import map_from_world
from cairn_map.codec.cell_code import Profile
from cairn_map.progress import with_progress

NOTE = "poses corrected"
"""Note of the amends, unless --note says more."""


class AmendReport(BaseModel):
    """Output of `cairn robot amend --json`; names are added, never changed."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    folder: str
    robot: str
    to_amend: int
    """Measurements that were to be moved."""
    amended: int
    """Measurements that were; 0 with --dry-run."""
    step_m: float | None
    """Largest distance by which a scan moves, metres; None: nothing moves, or the distance is unknown."""
    there_before: int
    taken_back: int
    uncovered: list[str]
    """Commits of measurements that stay, because the trajectory lacks a pose of theirs."""
    lost: list[str]
    """Commits of measurements that stay, because their scans are not kept any more."""
    failed: dict[str, str]
    """Commits of measurements that could not be integrated, and why."""
    stopped: str
    """Error that ended it before its end; empty: there was none."""
    waiting: int | None
    """Commits that the server has not acknowledged; None with --dry-run."""


def add_parser(commands: Subparsers) -> None:
    """Add the subcommand."""
    amend = commands.add_parser(
        "amend", help="move past measurements to the corrected poses of a trajectory", description=__doc__
    )
    amend.add_argument("folder", type=Path, metavar="STATE", help="the robot's folder")
    add_trajectory_arguments(amend)
    add_up_arguments(amend)
    amend.add_argument("--rig", type=Path, metavar="RIG", help="rig.json of the head (the one kept in the folder)")
    amend.add_argument(
        "--profile", choices=list(Profile), default=Profile.FAST, help="small: fewer bytes, more work (fast)"
    )
    amend.add_argument("--note", default=NOTE, help=f"the reason; kept in the map's log ({NOTE})")
    amend.add_argument("--dry-run", action="store_true", help="say what would be moved, and change nothing")
    amend.add_argument("--json", action="store_true", help="print JSON")
    amend.set_defaults(run=_amend)


def _amend(args: argparse.Namespace) -> int:
    check_note(args.note)
    given = None if args.rig is None else load_rig(args.rig)
    turn = map_from_world(up=args.up, T_map_world=args.T_map_world)
    options = pose_options(args)
    assert options is not None  # noqa: S101 - the option is required
    T_map_world = None if turn is None else turn[0]
    raise_left([_amend_folder(args, folder, options, given, T_map_world) for folder in layer_folders(args.folder)])
    return 0


def _amend_folder(
    args: argparse.Namespace, folder: Path, options: PoseOptions, given: Rig | None, T_map_world: Transform | None
) -> LeftMeasurements:
    """Amend the measurements of one folder; those that stay as they are."""
    start_s = time.monotonic()
    with kept_folder(folder) as opened:
        # Everything that can be refused is, before anything is written.
        plan = kept_measurements(opened)
        found = read_frame_poses(options, head_of(opened, plan, given, of=options.of))
        plan_moves(opened, plan, trajectory_poses(found, T_map_world), given)
        if not args.json:
            for note in dict.fromkeys(found.report()):
                say(note)
        if not args.dry_run:
            done = move_all(opened, plan, given, profile=Profile(args.profile), note=args.note)
            for _ in with_progress(done, "amend", total=len(plan.moves)) if plan.moves else done:
                pass
        report = _report(opened, plan, is_dry=args.dry_run)
    _say(plan, report, as_json=args.json, is_dry=args.dry_run)
    if not args.json and not args.dry_run:
        sync = f"; push them: cairn robot sync {folder}" if report.waiting else ""
        say(f"took {time.monotonic() - start_s:.1f} s{sync}")
    return _left(plan)


def _report(opened: KeptFolder, plan: MovePlan, *, is_dry: bool) -> AmendReport:
    steps_m = [move.step_m for move in plan.moves if move.step_m is not None]
    return AmendReport(
        folder=str(plan.folder),
        robot=plan.robot,
        to_amend=len(plan.moves),
        amended=plan.amended,
        step_m=max(steps_m, default=None),
        there_before=plan.there,
        taken_back=plan.taken_back,
        uncovered=[str(commit) for commit in plan.uncovered],
        lost=[str(commit) for commit in plan.lost],
        failed={str(commit): f"{exc.message} [{exc.kind}]" for commit, exc in plan.failed.items()},
        stopped="" if plan.stopped is None else f"{plan.stopped.message} [{plan.stopped.kind}]",
        waiting=None if is_dry else len(opened.outbox.push_set(opened.state.header)),
    )


def _say(plan: MovePlan, report: AmendReport, *, as_json: bool, is_dry: bool) -> None:
    if as_json:
        say(report.model_dump_json())
        return
    count = len(plan.moves) if is_dry else plan.amended
    line = f"{plan.folder}: {shown_measurements(count)} of {plan.robot} {'would be ' * is_dry}amended"
    line += f", by up to {report.step_m:.2f} m" if count and report.step_m is not None else ""
    left = (plan.there, "were there before"), (plan.taken_back, "taken back")
    for number, text in left:
        line += f", {number} {text}" if number else ""
    say(line if is_dry else f"{line}; {report.waiting} commits wait")
    if plan.uncovered:
        say(f"  {shown_measurements(len(plan.uncovered))} stay: the trajectory does not cover all of their scans")
    say_left(_left(plan))


def _left(plan: MovePlan) -> LeftMeasurements:
    return LeftMeasurements(lost=plan.lost, failed=plan.failed, stopped=plan.stopped)
