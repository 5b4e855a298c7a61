"""`cairn robot sync`: push the commits that wait in a robot's folder and fetch changes, once or repeatedly.

    $ cairn robot sync state/
    14 cells, 81233 known voxels in state/
    pushed 2 commits, 4 cells have news; 81.3 kB up, 40.2 kB down; 0 commits wait
    $ cairn robot sync state/ --every 60
    $ cairn robot sync mole/ --map http://base:8750/maps/lab --mode low-end --near 4,2,0 --radius 15

The folder remembers its robot, server, mode, and the limits of `cairn robot run`. With --map a new folder is made: a
viewer's, which pushes nothing, unless --mode says otherwise; --near and --box fetch a part of the map only. A robot
that is at work syncs by itself, and has its folder for itself. With --every it goes on through lost links until ^C or
SIGTERM, and reports events on standard error.

A copy of a whole map to look at is made by `cairn clone URL`, and brought up to date by `cairn pull DIR`.
"""

import argparse
from dataclasses import replace
from pathlib import Path
from typing import get_args

from pydantic import BaseModel, ConfigDict

from cairn_client.cli.arguments import Subparsers, api_of, say, shown_bytes
from cairn_client.cli.event_lines import lines_on_stderr, until_signal
from cairn_client.cli.robot_arguments import add_amount, place, scope_of
from cairn_client.folders.folder_status import folder_status
from cairn_client.folders.state_folder import robot_of
from cairn_client.robot.robot import Robot
from cairn_client.robot.robot_events import CellsChanged
from cairn_client.sync.near_cells import Wanted, within
from cairn_map.errors import BadInputError
from cairn_map.wire.messages import Mode

NEW_COPY: Mode = "viewer"
"""Name and mode of a new folder's robot, unless options say otherwise."""


class SyncReport(BaseModel):
    """Output of `cairn robot sync --json`; names are added, never changed."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    cells: int
    """Cells in the folder, with the evidence of commits that wait."""
    voxels: int
    """Known voxels in them."""
    pushed: int
    refused: dict[str, str]
    """Commits that the server will not take, and the reason of each."""
    cells_changed: int
    """Cells of which news came."""
    waiting: int
    """Commits that the server has not acknowledged."""
    up_bytes: int
    down_bytes: int


def add_parser(commands: Subparsers) -> None:
    """Add the subcommand."""
    sync = commands.add_parser("sync", help="push and fetch for a robot's folder", description=__doc__)
    sync.add_argument("folder", type=Path, metavar="DIR", help="the robot's folder; with --map, it may be new")
    sync.add_argument("--map", metavar="URL", help="http://HOST:PORT/maps/NAME (the folder's)")
    sync.add_argument("--name", help="a new folder's robot on the map (viewer)")
    sync.add_argument(
        "--mode",
        choices=get_args(Mode),
        help="high-end: differences; low-end: whole cells; viewer: pushes nothing (the folder's; viewer for a new one)",
    )
    sync.add_argument("--near", type=place, metavar="X,Y,Z", help="low-end: only cells around this place, metres")
    sync.add_argument("--radius", type=float, default=10.0, metavar="METRES", help="low-end: how far around (10)")
    sync.add_argument("--every", type=float, metavar="SECONDS", help="go on until ^C or SIGTERM (once)")
    sync.add_argument("--json", action="store_true", help="print JSON: sizes in bytes")
    add_amount(sync)
    sync.set_defaults(run=_sync)


def _sync(args: argparse.Namespace) -> int:
    if args.every is not None and (args.every <= 0 or args.json):
        raise BadInputError("bad_option", "--every takes seconds above 0, and goes without --json")
    with until_signal() as stopping, _robot(args) as robot:
        if args.every is None:
            _say(_synced(robot), args.folder, as_json=args.json)
        else:
            with lines_on_stderr(robot.events()):
                robot.start_sync(every_s=args.every)
                stopping.wait()
    return 0


def _robot(args: argparse.Namespace) -> Robot:
    """The folder's robot as it was set up, or a new one where nothing is there and --map is given."""
    known = folder_status(args.folder) if args.map is None or robot_of(args.folder) else None
    url = args.map or (known.url if known else None)
    if url is None:
        raise BadInputError("no_url", f"{args.folder} does not say where its server is; give --map URL")
    mode: Mode = args.mode or ((known.mode or "high-end") if known else NEW_COPY)
    return Robot(
        None,
        url,
        directory=args.folder,
        name=args.name or (known.robot if known else NEW_COPY),
        token=args.token.of(url),
        mode=mode,
        scope=replace(scope_of(args, mode), wanted=_wanted(args, url, mode)),
        link=args.link,
        stay=True,
    )


def _wanted(args: argparse.Namespace, url: str, mode: Mode) -> Wanted | None:
    """The cells around --near; None: all."""
    if args.near is None:
        return None
    if mode != "low-end":
        raise BadInputError("bad_option", "--near goes with --mode low-end; a high-end copy holds the whole map")
    api, name = api_of(url, args.token)
    with api:
        geometry = api.map_info(name).geometry
    return within(args.near, radius_m=args.radius, cell_edges_m=geometry.cell_edges_m)


def _synced(robot: Robot) -> SyncReport:
    """Rounds until there is nothing more to fetch, and one that says to the server where this robot stands now."""
    with robot.events() as events:
        rounds = [robot.sync()]
        while rounds[-1].has_more:
            rounds.append(robot.sync())
        rounds.append(robot.sync())
        changed = {cell for event in events.take() if isinstance(event, CellsChanged) for cell in event.cells}
    refused = {commit: exc for report in rounds for commit, exc in report.refused.items()}
    cells = robot.map.packed()
    return SyncReport(
        cells=len(cells),
        voxels=sum(len(evidence) for evidence in cells.values()),
        pushed=sum(report.pushed for report in rounds),
        refused={str(commit): f"{exc.message} [{exc.kind}]" for commit, exc in refused.items()},
        cells_changed=len(changed),
        waiting=robot.waiting,
        up_bytes=robot.traffic.up_bytes,
        down_bytes=robot.traffic.down_bytes,
    )


def _say(report: SyncReport, folder: Path, *, as_json: bool) -> None:
    if as_json:
        say(report.model_dump_json())
        return
    for commit, reason in report.refused.items():
        say(f"the server refuses {commit}: {reason}")
    say(f"{report.cells} cells, {report.voxels} known voxels in {folder}")
    say(
        f"pushed {report.pushed} commits, {report.cells_changed} cells have news; {shown_bytes(report.up_bytes)} up, "
        f"{shown_bytes(report.down_bytes)} down; {report.waiting} commits wait"
    )
