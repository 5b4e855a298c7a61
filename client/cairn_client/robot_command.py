"""Be a robot: replay a recording into a map, or keep a local copy of one.

    $ cairn robot replay shelf/ --map http://127.0.0.1:8750/maps/shelf --voxel 0.01
    shelf: 15 scans; the first has 26% of its pixels, median range 0.57 m
    replayed 15 scans as 15 commits in 1.9 s (7.9 scans/s), 302.0 kB up, 62.8 kB down, 0 commits wait
    $ cairn robot pull --map http://127.0.0.1:8750/maps/shelf --state copy/

`replay` reads a recording folder (RECORDING.md), a known layout as it was published (apc_shelf_rgbd, mm5_rgbdt), or
any folder of frames that options describe (--depth, --pose, --intrinsics, ...: `cairn robot replay --help`). It maps
as a live robot would: each measurement becomes a commit, first kept in the state folder, then pushed.
Without a link it goes on, and the next `replay` or `pull` with the same state folder pushes what waits. Two robots
can share a recording: --share 1/2 takes every second measurement from the first on, --share 2/2 the others.

`pull` fetches what the state folder's robot misses and pushes what waits there. With --mode low-end it fetches whole
cells instead of differences, on request only those around a place (--near X,Y,Z --radius METRES).

Both can fetch a part of the map: --box X0,Y0,Z0,X1,Y1,Z1 (metres in the map's frame) only the cells that share more
than a face with this box; and in small helpings: with --reply-bytes 100000 each reply ends after 100 kB of cells, or
one cell, so that a link that breaks often loses no more than that.
"""

import argparse
import logging
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from cairn_client.api import MapApi
from cairn_client.arguments import (
    add_token,
    allow_negative_lists,
    api_of,
    parser,
    say,
    shown_bytes,
    shown_length,
    with_progress,
)
from cairn_client.frame_arguments import add_frame_arguments, frame_options
from cairn_client.replica_store import ReplicaStore
from cairn_client.robot import Mode, Robot
from cairn_client.scope import Scope
from cairn_client.sync import Wanted, within
from cairn_fusion.importers import open_source
from cairn_fusion.integrate import Integrator
from cairn_fusion.recording import Recording
from cairn_map.cell_code import Profile
from cairn_map.channels import COLOUR, INTENSITY, TEMPERATURE, Channel
from cairn_map.errors import BadInputError, DamagedDataError, NotFoundError, UnreachableError
from cairn_map.grid import Geometry, geometry_for
from cairn_map.messages import CreateMap

log = logging.getLogger(__name__)

REPLAYED_FILE = "replayed.txt"
SYNC_EVERY_S = 2.0
"""While replaying; at the end everything is pushed and fetched once more."""


def main(argv: list[str]) -> int:
    """Run one of the subcommands."""
    args = _parser().parse_args(argv)
    run: Callable[[argparse.Namespace], int] = args.run
    return run(args)


def _replay(args: argparse.Namespace) -> int:
    integrator = Integrator(min_range_m=args.min_range, max_range_m=args.max_range)
    options, size = frame_options(args), args.scans_per_measurement
    source = open_source(args.recording, options=options, frames=args.frames, scans_per_measurement=size)
    _say_range(source)
    geometry = _ensure_map(args, source)
    name = args.name or _default_name(source.name)
    state = args.state or Path(f"cairn-{name}")
    part = f"{args.recording.resolve()} {args.share[0]}/{args.share[1]}"
    if not args.again and part in _replayed(state):
        raise BadInputError(
            "replayed_before", f"{state} has replayed this recording already; --again counts its evidence once more"
        )
    stops = source.measurements()[args.share[0] - 1 :: args.share[1]]
    start_s = time.monotonic()
    commits = scans = 0
    with Robot(
        source.rig,
        args.map,
        directory=state,
        name=name,
        token=args.token,
        mode=args.mode,
        geometry=geometry,
        integrator=integrator,
        scope=_scope(args),
    ) as robot:
        last_sync_s = start_s
        for stop in with_progress(stops, source.name, total=len(stops)):
            for index in stop:
                robot.observe(source.scan(index))
                scans += 1
            commits += robot.commit(profile=Profile(args.profile)) is not None
            if time.monotonic() - last_sync_s > SYNC_EVERY_S:
                _try_sync(robot)
                last_sync_s = time.monotonic()
        with (state / REPLAYED_FILE).open("a") as file:
            file.write(f"{part}\n")
        mapped_s = time.monotonic() - start_s
        # The second round tells the server where this robot stands now.
        is_linked = _try_sync(robot) and _try_sync(robot)
        waiting, traffic = robot.waiting, robot.traffic
    say(
        f"replayed {scans} scans as {commits} commits in {mapped_s:.1f} s ({scans / mapped_s:.1f} scans/s), "
        f"{shown_bytes(traffic.up_bytes)} up, {shown_bytes(traffic.down_bytes)} down, {waiting} commits wait"
    )
    if not is_linked:
        say(f"no link to {args.map}: `cairn robot pull --map URL --state {state}` pushes them when there is one")
    return 0


def _say_range(source: Recording) -> None:
    """Ranges of the first scan: who sees 5 m for a shelf at arm's length has given the wrong depth units."""
    range_m = source.scan(0).range_m
    seen = range_m[np.isfinite(range_m)]
    median = f"median range {np.median(seen):.2f} m" if len(seen) else "no range at all"
    say(f"{source.name}: {len(source)} scans; the first has {len(seen) / range_m.size:.0%} of its pixels, {median}")


def _replayed(state: Path) -> set[str]:
    """Recordings, with the share, that a robot's folder has replayed."""
    path = state / REPLAYED_FILE
    return set(path.read_text().splitlines()) if path.exists() else set()


def _pull(args: argparse.Namespace) -> int:
    api, map_name = api_of(args.map, args.token)
    known = _robot_of(args.state)
    name = args.name or known or "viewer"
    mode: Mode = args.mode or ("high-end" if known and known != "viewer" else "viewer")
    scope = replace(_scope(args), wanted=_wanted(args, api, map_name))
    with Robot(None, args.map, directory=args.state, name=name, token=args.token, mode=mode, scope=scope) as robot:
        report = robot.sync()
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


def _try_sync(robot: Robot) -> bool:
    try:
        robot.sync()
    except UnreachableError:
        return False
    except DamagedDataError as exc:
        log.error("%s", exc.message)  # mapping goes on: what is sound came, and own commits are pushed
    return True


def _ensure_map(args: argparse.Namespace, source: Recording) -> Geometry | None:
    """The map's geometry; makes the map if there is none. None: no link, and perhaps the state folder knows it."""
    api, name = api_of(args.map, args.token)
    wished = geometry_for(voxel_edge_m=args.voxel) if args.voxel is not None else None
    try:
        geometry = api.map_info(name).geometry
    except UnreachableError:
        return geometry_for(voxel_edge_m=args.voxel, channels=_channels(source)) if args.voxel else None
    except NotFoundError as exc:
        if exc.kind != "no_map":
            raise
        if args.voxel is None:
            raise BadInputError(
                "no_map", f"there is no map {name} yet; make one with `cairn map create`, or give --voxel METRES"
            ) from exc
        made = geometry_for(voxel_edge_m=args.voxel, channels=_channels(source))
        return api.create_map(name, CreateMap(geometry=made)).geometry
    if wished is not None and wished.voxel_edge_um != geometry.voxel_edge_um:
        raise BadInputError(
            "other_geometry",
            f"map {name} has voxels of {shown_length(geometry.voxel_edge_m)}, not {shown_length(wished.voxel_edge_m)}; "
            "leave --voxel out, or choose another map",
        )
    return geometry


def _channels(source: Recording) -> tuple[Channel, ...]:
    """What the recording's first scan can fill."""
    scan = source.scan(0)
    has = ((COLOUR, bool(scan.colour)), (INTENSITY, scan.amplitude is not None), (TEMPERATURE, bool(scan.thermal)))
    return tuple(channel for channel, found in has if found)


def _default_name(text: str) -> str:
    name = "".join(letter if letter.isascii() and letter.isalnum() else "-" for letter in text.lower()).strip("-")
    return name[:32] or "robot"


def _wanted(args: argparse.Namespace, api: MapApi, map_name: str) -> Wanted | None:
    if args.near is None:
        return None
    if args.mode != "low-end":
        raise BadInputError("bad_option", "--near goes with --mode low-end; a high-end copy holds the whole map")
    return within(args.near, radius_m=args.radius, cell_edge_m=api.map_info(map_name).geometry.cell_edge_m)


def _scope(args: argparse.Namespace) -> Scope:
    if args.reply_bytes is not None and args.mode == "low-end":
        raise BadInputError("bad_option", "--reply-bytes bounds the answers with differences; low-end fetches cells")
    return Scope(box_m=(args.box[:3], args.box[3:]) if args.box else None, reply_bytes_max=args.reply_bytes)


def _share(text: str) -> tuple[int, int]:
    part, slash, parts = text.partition("/")
    if not slash or not part.isdigit() or not parts.isdigit() or not 1 <= int(part) <= int(parts):
        raise argparse.ArgumentTypeError(f"expected PART/PARTS such as 1/2, got {text!r}")
    return int(part), int(parts)


def _place(text: str) -> tuple[float, float, float]:
    try:
        x, y, z = (float(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected X,Y,Z in metres, got {text!r}") from None
    return x, y, z


def _box(text: str) -> tuple[float, ...]:
    parts = text.split(",")
    if len(parts) != 6:
        raise argparse.ArgumentTypeError(f"expected X0,Y0,Z0,X1,Y1,Z1 in metres, got {text!r}")
    return (*_place(",".join(parts[:3])), *_place(",".join(parts[3:])))


def _parser() -> argparse.ArgumentParser:
    top = parser("cairn robot", __doc__)
    commands = top.add_subparsers(required=True, metavar="COMMAND")
    replay = commands.add_parser("replay", help="map a recording", description="map a recording")
    replay.add_argument("recording", type=Path, help="recording folder, or one of the known published layouts")
    replay.add_argument("--voxel", type=float, metavar="METRES", help="make the map with this voxel edge if needed")
    replay.add_argument("--again", action="store_true", help="replay what this robot has replayed before once more")
    replay.add_argument("--share", type=_share, default=(1, 1), metavar="I/N", help="every N-th measurement from I on")
    replay.add_argument("--scans-per-measurement", type=int, metavar="N", help="regroup the scans")
    replay.add_argument(
        "--min-range", type=float, default=Integrator().min_range_m, metavar="METRES", help="ignore what is nearer"
    )
    replay.add_argument(
        "--max-range",
        type=float,
        default=Integrator().max_range_m,
        metavar="METRES",
        help="ignore what is farther (10)",
    )
    replay.add_argument("--state", type=Path, metavar="DIR", help="the robot's folder (cairn-NAME)")
    replay.add_argument("--mode", choices=("high-end", "low-end"), default="high-end")
    replay.add_argument(
        "--profile",
        choices=list(Profile),
        default=Profile.FAST,
        help="small: four tenths fewer bytes, more work (fast)",
    )
    add_frame_arguments(replay)
    replay.set_defaults(run=_replay)
    pull = commands.add_parser("pull", help="fetch what is missing", description="fetch what is missing")
    pull.add_argument("--state", type=Path, required=True, metavar="DIR", help="the robot's folder")
    pull.add_argument("--mode", choices=("high-end", "low-end", "viewer"))
    pull.add_argument("--near", type=_place, metavar="X,Y,Z", help="low-end: only cells around this place, metres")
    pull.add_argument("--radius", type=float, default=10.0, metavar="METRES", help="low-end: how far around (10)")
    pull.set_defaults(run=_pull)
    for command in (replay, pull):
        allow_negative_lists(command)
        command.add_argument("--map", required=True, metavar="URL", help="http://HOST:PORT/maps/NAME")
        command.add_argument("--name", help="the robot's name on the map")
        command.add_argument("--box", type=_box, metavar="X0,Y0,Z0,X1,Y1,Z1", help="fetch only cells in it, metres")
        command.add_argument(
            "--reply-bytes", type=int, metavar="BYTES", help="of cells in one reply; the rest comes in the next ones"
        )
        add_token(command)
    return top
