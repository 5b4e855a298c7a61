"""`cairn robot pull`: fetch what a state folder misses, and push what waits there."""

import argparse
from dataclasses import replace
from pathlib import Path

from cairn_client.api import MapApi
from cairn_client.arguments import (
    api_of,
    say,
    shown_bytes,
)
from cairn_client.nearness import Wanted, within
from cairn_client.replica_store import ReplicaStore
from cairn_client.robot import Robot
from cairn_client.robot_arguments import add_map, place, scope_of
from cairn_map.errors import BadInputError
from cairn_map.robot_status import Mode


def _pull(args: argparse.Namespace) -> int:
    api, map_name = api_of(args.map, args.token)
    known = _robot_of(args.state)
    name = args.name or known or "viewer"
    mode: Mode = args.mode or ("high-end" if known and known != "viewer" else "viewer")
    scope = replace(scope_of(args), wanted=_wanted(args, api, map_name))
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
        report = robot.sync()
        while report.has_more:
            report.has_more = robot.sync().has_more
        robot.sync()  # tells the server where this robot stands now
        cells = robot.map.packed()
        voxels = sum(len(evidence) for evidence in cells.values())
        traffic = robot.traffic
        say(
            f"{len(cells)} cells, {voxels} known voxels in {args.state}; {report.pushed} commits pushed, "
            f"{shown_bytes(traffic.down_bytes)} down"
        )
    return 0


def _robot_of(state: Path) -> str | None:
    """Whose folder this is, or None if it is nobody's yet."""
    if not state.exists():
        return None
    store = ReplicaStore(state)
    try:
        return store.get("robot")
    finally:
        store.close()


def _wanted(args: argparse.Namespace, api: MapApi, map_name: str) -> Wanted | None:
    if args.near is None:
        return None
    if args.mode != "low-end":
        raise BadInputError("bad_option", "--near goes with --mode low-end; a high-end copy holds the whole map")
    return within(args.near, radius_m=args.radius, cell_edge_m=api.map_info(map_name).geometry.cell_edge_m)


def add_parser(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the subcommand."""
    pull = commands.add_parser("pull", help="fetch what is missing", description="fetch what is missing")
    add_map(pull)
    pull.add_argument("--state", type=Path, required=True, metavar="DIR", help="the robot's folder")
    pull.add_argument("--mode", choices=("high-end", "low-end", "viewer"))
    pull.add_argument("--near", type=place, metavar="X,Y,Z", help="low-end: only cells around this place, metres")
    pull.add_argument("--radius", type=float, default=10.0, metavar="METRES", help="low-end: how far around (10)")
    pull.set_defaults(run=_pull)
