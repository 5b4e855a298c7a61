"""`cairn robot run`: map the recordings that a driver puts into a folder, and sync, until a signal ends it.

    $ cairn robot run spool/ --map http://base:8750/maps/lab --voxel 0.04 --name mole
    committed mole.5f0c2a9be1d3f607.0: 4 cells, 40.6 kB
    pushed mole.5f0c2a9be1d3f607.0
    ^Cmapped 12 scans as 3 commits, 120.5 kB up, 8.1 kB down; 0 commits wait

SPOOL holds recordings (RECORDING.md), a folder each, in the order of their names; one is taken when it has its
recording.json, which is written last. So a driver writes each stop as a recording of its own. Scans that the recording
does not group (measurements.txt) become commits of up to 50 scans, 5 s and 2 m. Each measurement is
mapped exactly once, whatever happens: the robot's folder records those that are done. --delete removes recordings that
are mapped whole. A measurement that makes no commit is left out; the log gives the reason.

Events are reported on standard error. Without a link it maps on. On ^C or SIGTERM waiting commits are pushed for some
seconds, and the robot leaves the map, if none is left and unless --stay is given; a measurement under way is mapped at
the next start. A second ^C ends it at once, and nothing is lost.
"""

import argparse
import logging
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from cairn_client.cli.arguments import Subparsers, say, shown_bytes
from cairn_client.cli.event_lines import Stopping, lines_on_stderr, until_signal
from cairn_client.cli.range_arguments import add_ranges, integrator_of, returns_line
from cairn_client.cli.robot_arguments import add_kept_scans, add_limits, add_map, kept_scans_bytes, limits_of, scope_of
from cairn_client.cli.robots.layer_option import add_layer_option, bring_keys, choose_layer
from cairn_client.cli.robots.replay import channels_of, default_name, ensure_map
from cairn_client.folders.spool import Spool, Stop, remember
from cairn_client.folders.state_folder import is_state_folder
from cairn_client.robot.robot import Robot
from cairn_map.codec.cell_code import Profile
from cairn_map.errors import BadInputError, DamagedDataError, UnreachableError

log = logging.getLogger(__name__)

LOOK_EVERY_S = 1.0
"""Pause between two looks for new recordings."""
COMMIT_AGAIN_S = 5.0
"""Pause before a commit is tried again after the disk or the outbox was full."""
FLUSH_S = 8.0
"""Longest push of waiting commits at the end: containers are killed ten seconds after they are asked to stop."""


@dataclass(slots=True)
class _Tally:
    """Counts of scans and commits."""

    scans: int = 0
    commits: int = 0


def add_parser(commands: Subparsers) -> None:
    """Add the subcommand."""
    run = commands.add_parser(
        "run", help="map the recordings that come into a folder, until a signal", description=__doc__
    )
    run.add_argument("spool", type=Path, metavar="SPOOL", help="the folder that recordings come into")
    add_map(run)
    add_layer_option(run)
    run.add_argument("--voxel", type=float, metavar="METRES", help="make the map with this voxel edge if needed")
    add_ranges(run)
    run.add_argument("--state", type=Path, metavar="DIR", help="the robot's folder (cairn-NAME)")
    run.add_argument("--mode", choices=("high-end", "low-end"), default="high-end")
    run.add_argument(
        "--profile", choices=list(Profile), default=Profile.FAST, help="small: fewer bytes, more work (fast)"
    )
    run.add_argument("--every", type=float, default=5.0, metavar="SECONDS", help="longest pause between syncs (5)")
    add_limits(run)
    add_kept_scans(run)
    run.add_argument(
        "--carry",
        type=float,
        default=0.0,
        metavar="MB",
        help="room for other robots' commits, taken along to the next server; needs a token of role relay (0)",
    )
    run.add_argument("--delete", action="store_true", help="delete recordings that are mapped")
    run.add_argument("--stay", action="store_true", help="stay on the map at the end")
    run.set_defaults(run=_run)


def _run(args: argparse.Namespace) -> int:
    if args.every <= 0:
        raise BadInputError("bad_option", f"--every takes seconds above 0, got {args.every:g}")
    if args.carry < 0:
        raise BadInputError("bad_option", "--carry takes megabytes of 0 or more")
    # Before it waits for the first recording.
    limits_of(args)
    kept_scans_bytes(args)
    spool, tally = Spool(args.spool), _Tally()
    with until_signal() as stopping:
        robot = _robot(args, spool, stopping)
        if robot is None:
            return 0
        try:
            with lines_on_stderr(robot.events()):
                robot.start_sync(every_s=args.every)
                while not stopping.is_set():
                    _map_what_came(robot, spool, args, tally, stopping)
                    stopping.wait(LOOK_EVERY_S)
                robot.close(flush_s=FLUSH_S)
        finally:
            robot.close(flush_s=FLUSH_S)
    traffic = robot.traffic
    say(
        f"mapped {tally.scans} scans as {tally.commits} commits, {shown_bytes(traffic.up_bytes)} up, "
        f"{shown_bytes(traffic.down_bytes)} down; {robot.waiting} commits wait"
    )
    say(returns_line(robot.returns))
    return 0


def _robot(args: argparse.Namespace, spool: Spool, stopping: Stopping) -> Robot | None:
    """The robot; one that knows no map yet waits for the first recording, whose channels the map needs."""
    name = args.name or default_name(args.spool.resolve().name)
    choose_layer(args, name)
    state: Path = args.state
    source = spool.next_recording()
    while source is None and not is_state_folder(state):
        if stopping.wait(LOOK_EVERY_S):
            return None
        source = spool.next_recording()
    layer = ensure_map(args, partial(channels_of, source)) if source else None
    bring_keys(state, name, args.map)
    return Robot(
        source.rig if source else None,
        args.map,
        directory=state,
        name=name,
        token=args.token.of(args.map),
        mode=args.mode,
        geometry=layer,
        integrator=integrator_of(args),
        scope=scope_of(args, args.mode),
        limits=limits_of(args),
        link=args.link,
        stay=args.stay,
        keep_scans_bytes=kept_scans_bytes(args),
        carry_bytes_max=round(args.carry * 1e6),
    )


def _map_what_came(robot: Robot, spool: Spool, args: argparse.Namespace, tally: _Tally, stopping: Stopping) -> None:
    for stop in spool.stops(robot.replica):
        robot.mount(stop.source.rig)
        for index in stop.scans:
            if stopping.is_set():
                break
            try:
                robot.observe(stop.source.scan(index))
                tally.scans += 1
            except (BadInputError, DamagedDataError) as exc:
                log.error("scan %d of %s is left out: %s", index, stop.folder, exc.message)
        try:
            if not _commit(robot, stop, Profile(args.profile), tally, stopping):
                return
        except BadInputError as exc:  # it would be refused at every start
            _leave_out(robot, stop, exc)
    if args.delete:
        spool.delete_done(robot.replica)


def _leave_out(robot: Robot, stop: Stop, exc: BadInputError) -> None:
    """Nothing can be made of a measurement: go on without it."""
    log.error(
        "%s are left out: %s; put them into the spool again, under a new name and in smaller measurements",
        stop.name,
        exc.message,
    )
    robot.discard()
    remember(robot.replica, stop.mark_left_out())


def _commit(robot: Robot, stop: Stop, profile: Profile, tally: _Tally, stopping: Stopping) -> bool:
    """Keep a measurement together with the mark that it is done; False, and nothing is kept, if it is to stop first."""
    while not stopping.is_set():
        try:
            commit = robot.commit(note=stop.source.name, profile=profile, remember=stop.mark())
        except UnreachableError as exc:  # a full disk or outbox: there may be room later
            log.error("%s; trying again in %.0f s", exc.message, COMMIT_AGAIN_S)
            stopping.wait(COMMIT_AGAIN_S)
            continue
        if commit is None:
            remember(robot.replica, stop.mark())
        tally.commits += commit is not None
        return True
    robot.discard()
    return False
