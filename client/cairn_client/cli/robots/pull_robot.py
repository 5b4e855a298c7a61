"""`cairn robot pull`: make or bring up to date a robot's folder: fetch what it misses, and push what waits there.

    $ cairn robot pull --map http://base:8750/maps/lab --state mole/ --mode low-end --near 4,2,0 --radius 15
    14 cells, 81233 known voxels in mole/; 0 commits pushed, 1.2 MB down

Not what you want?  A whole map to look at: `cairn clone URL`, and later `cairn pull DIR`, which push nothing.
A robot's folder that is there, as it was set up: `cairn robot sync DIR`.
"""

import argparse
from dataclasses import replace
from pathlib import Path

from pydantic import BaseModel, ConfigDict

from cairn_client.cli.arguments import api_of, say, shown_bytes
from cairn_client.cli.robot_arguments import add_map, place, scope_of
from cairn_client.folders.state_folder import robot_of
from cairn_client.robot.robot import Robot
from cairn_client.sync.near_cells import Wanted, within
from cairn_map.errors import BadInputError
from cairn_map.wire.messages import Mode


class PullReport(BaseModel):
    """What `cairn robot pull --json` prints; names are added, never changed."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    cells: int
    """That are here, with what waits to be pushed."""
    voxels: int
    """Known ones in them."""
    pushed: int
    refused: dict[str, str]
    """Commits that the server will not take, and why."""
    waiting: int
    """Commits that the server has not acknowledged."""
    up_bytes: int
    down_bytes: int


def _pull(args: argparse.Namespace) -> int:
    known = robot_of(args.state)
    name = args.name or known or "viewer"
    mode: Mode = args.mode or ("high-end" if known and known != "viewer" else "viewer")
    scope = replace(scope_of(args), wanted=_wanted(args))
    with Robot(
        *(None, args.map),
        directory=args.state,
        name=name,
        token=args.token,
        mode=mode,
        scope=scope,
        link=args.link,
        stay=True,
    ) as robot:
        report = _pulled(robot)
    if args.json:
        say(report.model_dump_json())
    else:
        say(
            f"{report.cells} cells, {report.voxels} known voxels in {args.state}; {report.pushed} commits pushed, "
            f"{shown_bytes(report.down_bytes)} down"
        )
    return 0


def _pulled(robot: Robot) -> PullReport:
    report = robot.sync()
    while report.has_more:
        report.has_more = robot.sync().has_more
    robot.sync()  # tells the server where this robot stands now
    cells = robot.map.packed()
    return PullReport(
        cells=len(cells),
        voxels=sum(len(evidence) for evidence in cells.values()),
        pushed=report.pushed,
        refused={str(commit): f"{exc.message} [{exc.kind}]" for commit, exc in report.refused.items()},
        waiting=robot.waiting,
        up_bytes=robot.traffic.up_bytes,
        down_bytes=robot.traffic.down_bytes,
    )


def _wanted(args: argparse.Namespace) -> Wanted | None:
    if args.near is None:
        return None
    if args.mode != "low-end":
        raise BadInputError("bad_option", "--near goes with --mode low-end; a high-end copy holds the whole map")
    api, name = api_of(args.map, args.token)
    with api:
        geometry = api.map_info(name).geometry
    return within(args.near, radius_m=args.radius, cell_edge_m=geometry.cell_edge_m)


def add_parser(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the subcommand."""
    pull = commands.add_parser(
        "pull",
        help="make a robot's folder, or fetch what it misses (a copy: cairn clone)",
        description=__doc__,
        formatter_class=argparse.RawTextHelpFormatter,
    )
    add_map(pull)
    pull.add_argument("--state", type=Path, required=True, metavar="DIR", help="the robot's folder")
    pull.add_argument(
        "--mode",
        choices=("high-end", "low-end", "viewer"),
        help="high-end: differences; low-end: whole cells; viewer: pushes nothing\n(as before; a new folder's: viewer)",
    )
    pull.add_argument("--near", type=place, metavar="X,Y,Z", help="low-end: only cells around this place, metres")
    pull.add_argument("--radius", type=float, default=10.0, metavar="METRES", help="low-end: how far around (10)")
    pull.add_argument("--json", action="store_true", help="print JSON: sizes in bytes")
    pull.set_defaults(run=_pull)
