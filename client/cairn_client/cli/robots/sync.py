"""`cairn robot sync`: push what waits in a robot's folder and fetch what it misses, once or again and again.

    $ cairn robot sync state/
    pushed 2 commits, 4 cells have news; 81.3 kB up, 40.2 kB down; 0 commits wait
    $ cairn robot sync state/ --every 60

The folder remembers its robot, server, mode, and the limits of `cairn robot run`. A robot that is at work syncs by
itself, and has its folder for itself. With --every it goes on through lost links until ^C or SIGTERM, and tells what
happens on standard error.
"""

import argparse
from pathlib import Path
from typing import get_args

from pydantic import BaseModel, ConfigDict

from cairn_client.cli.arguments import say, shown_bytes
from cairn_client.cli.event_lines import lines_on_stderr, until_signal
from cairn_client.cli.robot_arguments import add_amount, scope_of
from cairn_client.folders.folder_status import folder_status
from cairn_client.robot.robot import Robot
from cairn_client.robot.robot_events import CellsChanged
from cairn_map.errors import BadInputError
from cairn_map.wire.messages import Mode


class SyncReport(BaseModel):
    """What `cairn robot sync --json` prints; names are added, never changed."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    pushed: int
    refused: dict[str, str]
    """Commits that the server will not take, and why."""
    cells_changed: int
    waiting: int
    """Commits that the server has not acknowledged."""
    up_bytes: int
    down_bytes: int


def add_parser(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the subcommand."""
    sync = commands.add_parser("sync", help="push and fetch for a robot's folder", description=__doc__)
    sync.add_argument("folder", type=Path, metavar="DIR", help="the robot's folder")
    sync.add_argument("--map", metavar="URL", help="http://HOST:PORT/maps/NAME (as before)")
    sync.add_argument("--mode", choices=get_args(Mode), help="(as before)")
    sync.add_argument("--every", type=float, metavar="SECONDS", help="go on until ^C or SIGTERM (one round)")
    sync.add_argument("--json", action="store_true", help="print JSON: sizes in bytes")
    add_amount(sync)
    sync.set_defaults(run=_sync)


def _sync(args: argparse.Namespace) -> int:
    known = folder_status(args.folder)
    url, args.mode = args.map or known.url, args.mode or known.mode or "high-end"
    if url is None:
        raise BadInputError("no_url", f"{args.folder} does not say where its server is; give --map URL")
    if args.every is not None and (args.every <= 0 or args.json):
        raise BadInputError("bad_option", "--every takes seconds above 0, and goes without --json")
    with (
        until_signal() as stopping,
        Robot(
            None,
            url,
            directory=args.folder,
            name=known.robot,
            token=args.token,
            mode=args.mode,
            scope=scope_of(args),
            link=args.link,
            stay=True,
        ) as robot,
    ):
        if args.every is None:
            _say(_one_round(robot), as_json=args.json)
        else:
            with lines_on_stderr(robot.events()):
                robot.start_sync(every_s=args.every)
                stopping.wait()
    return 0


def _one_round(robot: Robot) -> SyncReport:
    with robot.events() as events:
        report = robot.sync()
        changed = {cell for event in events.take() if isinstance(event, CellsChanged) for cell in event.cells}
    return SyncReport(
        pushed=report.pushed,
        refused={str(commit): f"{exc.message} [{exc.kind}]" for commit, exc in report.refused.items()},
        cells_changed=len(changed),
        waiting=robot.waiting,
        up_bytes=robot.traffic.up_bytes,
        down_bytes=robot.traffic.down_bytes,
    )


def _say(report: SyncReport, *, as_json: bool) -> None:
    if as_json:
        say(report.model_dump_json())
        return
    for commit, reason in report.refused.items():
        say(f"the server refuses {commit}: {reason}")
    say(
        f"pushed {report.pushed} commits, {report.cells_changed} cells have news; {shown_bytes(report.up_bytes)} up, "
        f"{shown_bytes(report.down_bytes)} down; {report.waiting} commits wait"
    )
