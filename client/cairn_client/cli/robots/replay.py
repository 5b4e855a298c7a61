"""`cairn robot replay`: map a recording as a live robot would."""

import argparse
import logging
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from cairn_client.cli.arguments import Subparsers, api_of, say, shown_bytes, shown_length
from cairn_client.cli.range_arguments import add_ranges, integrator_of, returns_line
from cairn_client.cli.robot_arguments import add_gate, add_kept_scans, add_map, gate_of, kept_scans_bytes, scope_of
from cairn_client.cli.robots.layer_option import add_layer_option, bring_keys, choose_layer
from cairn_client.cli.source_arguments import add_source_arguments, asked_source
from cairn_client.http.api import MapApi
from cairn_client.robot.robot import Robot
from cairn_fusion.mapping.grouping import Grouping, OpenGroup
from cairn_fusion.mapping.scan_gate import ScanGate
from cairn_fusion.recording.recording import ScanSource
from cairn_fusion.recording.turned_source import TurnedSource
from cairn_fusion.recording.upright import upright_of
from cairn_fusion.recording.view_agreement import pose_doubt
from cairn_fusion.recording.way_doubts import way_doubts
from cairn_map.codec.cell_code import Profile
from cairn_map.commits.commit import Commit
from cairn_map.commits.ids import map_of_layer
from cairn_map.epochs.epoch import STANDARD_EPOCH_S
from cairn_map.epochs.layer import MapLayer
from cairn_map.errors import BadInputError, DamagedDataError, NotFoundError, UnreachableError
from cairn_map.evidence.channels import COLOUR, INTENSITY, TEMPERATURE, Channel
from cairn_map.evidence.grid import geometry_for
from cairn_map.progress import with_progress
from cairn_map.wire.messages import CreateMap

log = logging.getLogger(__name__)

REPLAYED_FILE = "replayed.txt"
SYNC_EVERY_S = 2.0
"""Pause between syncs while replaying; at the end everything is pushed and fetched once more."""


def _replay(args: argparse.Namespace) -> int:
    # What to replay, and on which map.
    size, gate = args.scans_per_measurement, gate_of(args, is_standard=False)
    source = asked_source(args.recording, args, scans_per_measurement=size)
    _say_range(source)
    _say_doubts(source, args)
    name = args.name or default_name(source.name)
    choose_layer(args, name)
    layer = ensure_map(args, partial(channels_of, source))
    state: Path = args.state
    part = f"{args.recording.resolve()} {args.share[0]}/{args.share[1]}"
    if not args.again and part in _replayed(state):
        raise BadInputError(
            "replayed_before", f"{state} has replayed this recording already; --again counts its evidence once more"
        )
    # Map this robot's share, and take a note, so that the evidence is not counted twice.
    stops = source.measurements()[args.share[0] - 1 :: args.share[1]]
    # Scans that neither the recording nor an option groups are grouped as they come.
    is_open = size is None and all(len(stop) == 1 for stop in stops)
    grouping = Grouping() if source.has_times else Grouping(seconds_max=None)
    group = OpenGroup(grouping) if is_open else None
    bring_keys(state, name, args.map)
    start_s = time.monotonic()
    scans = sum(map(len, stops))
    with Robot(
        source.rig,
        args.map,
        directory=state,
        name=name,
        token=args.token.of(args.map),
        mode=args.mode,
        geometry=layer,
        integrator=integrator_of(args),
        scope=scope_of(args, args.mode),
        link=args.link,
        stay=True,
        keep_scans_bytes=kept_scans_bytes(args),
        times="recorded",
    ) as robot:
        if robot.replica.layer.has_epochs:
            _missed_sync(robot)  # it learns the server's time, by which epochs are counted
        commits = _map_stops(robot, source, stops, Profile(args.profile) if args.profile else None, group, gate)
        with (state / REPLAYED_FILE).open("a") as file:
            file.write(f"{part}\n")
        mapped_s = time.monotonic() - start_s
        # The second round tells the server where this robot stands now.
        missed = _missed_sync(robot) or _missed_sync(robot)
        is_folded = missed is None and _is_folded(robot)
        total_s = time.monotonic() - start_s
        waiting, traffic, returns = robot.waiting, robot.traffic, robot.returns
    say(
        f"replayed {scans} scans as {commits} commits in {mapped_s:.1f} s ({scans / mapped_s:.1f} scans/s), "
        f"{shown_bytes(traffic.up_bytes)} up, {shown_bytes(traffic.down_bytes)} down, {waiting} commits wait"
    )
    if gate.kept_out:
        say(f"{gate.kept_out} of these scans were taken by a robot that had not moved, and are not mapped")
    say(returns_line(returns))
    if is_folded:
        say(f"all of it is in the server's map: {total_s:.1f} s in all, with push and fold")
    if missed is not None:
        why = "no link to it" if missed.kind == "no_link" else f"{missed.message} [{missed.kind}]"
        say(f"not all is on {args.map}: {why}; `cairn robot sync {state} --map URL` pushes them later")
    return 0


def _map_stops(
    robot: Robot,
    source: ScanSource,
    stops: Sequence[range],
    profile: Profile | None,
    group: OpenGroup | None,
    gate: ScanGate,
) -> int:
    """Map measurements, or single scans by a grouping, with a sync now and then; the number of commits made."""
    commits, last_sync_s = 0, time.monotonic()
    # The map's log says how its z axis was found.
    note = source.text if isinstance(source, TurnedSource) else ""
    for stop in with_progress(stops, source.name, total=len(stops)):
        for index in stop:
            scan = source.scan(index)
            if not gate.takes(scan.range_camera, scan.time_s, scan.T_map_rig):
                continue
            if group is not None and group.ends_before(scan.time_s, scan.T_map_rig):
                commits += _commit(robot, profile, note) is not None
            commits += robot.observe(scan) is not None
        if group is None:
            commits += _commit(robot, profile, note) is not None
        if time.monotonic() - last_sync_s > SYNC_EVERY_S:
            _missed_sync(robot)
            last_sync_s = time.monotonic()
    return commits + (_commit(robot, profile, note) is not None)


def _say_range(source: ScanSource) -> None:
    """Write the ranges of the first scan (5 m for a shelf at arm's length are wrong depth units), and pose notes."""
    range_m = source.scan(0).range_m
    seen = range_m[np.isfinite(range_m)]
    median = f"median range {np.median(seen):.2f} m" if len(seen) else "no range at all"
    say(f"{source.name}: {len(source)} scans; the first has {len(seen) / range_m.size:.0%} of its pixels, {median}")
    for note in source.pose_notes:
        say(note)
    rounded = source.rounding.text()
    if rounded:
        say(rounded)


def _say_doubts(source: ScanSource, args: argparse.Namespace) -> None:
    """Write doubts about poses that somebody described, and about z as the axis that points up."""
    if args.intrinsics is not None or args.poses is not None:
        doubt = pose_doubt(source)
        if doubt is not None:
            say(doubt)
    if args.poses is None:
        for doubt in way_doubts(source):
            say(doubt)
    if args.up is None and args.T_map_world is None:
        upright = upright_of(source)
        if upright is not None and (text := upright.doubt()):
            say(text)


def _replayed(state: Path) -> set[str]:
    """Recordings, with the share, that a robot's folder has replayed."""
    path = state / REPLAYED_FILE
    return set(path.read_text().splitlines()) if path.exists() else set()


def _commit(robot: Robot, profile: Profile | None, note: str) -> Commit | None:
    """Commit; where the folder's limits are reached, after a sync, which may make room."""
    try:
        return robot.commit(profile=profile, note=note)
    except UnreachableError as exc:
        if exc.kind != "outbox_full" or _missed_sync(robot) or _missed_sync(robot):
            raise
        return robot.commit(profile=profile, note=note)


def _missed_sync(robot: Robot) -> UnreachableError | None:
    """Error of a sync that is to be tried again later; None: it was done."""
    try:
        robot.sync()
    except UnreachableError as exc:
        return exc
    except DamagedDataError as exc:
        log.error("%s", exc.message)  # mapping goes on: sound cells have come, and own commits are pushed
    return None


def _is_folded(robot: Robot) -> bool:
    """True once the server's map holds all that was pushed; False if that takes longer, or the link is lost."""
    try:
        return robot.sync(until_folded=True).is_up_to_date
    except (UnreachableError, DamagedDataError):
        return False


def ensure_map(args: argparse.Namespace, channels: Callable[[], tuple[Channel, ...]]) -> MapLayer | None:
    """The map's grid and epochs; if there is no map, a new one's, of these channels.

    None without a link: the state folder may know it.
    """
    api, name = api_of(args.map, args.token)
    with api:
        return _ensured(api, name, args, channels)


def _ensured(
    api: MapApi, name: str, args: argparse.Namespace, channels: Callable[[], tuple[Channel, ...]]
) -> MapLayer | None:
    wished = geometry_for(voxel_edge_m=args.voxel) if args.voxel is not None else None
    try:
        layer = api.map_info(name).layer
    except UnreachableError:
        if not args.voxel:
            return None
        return MapLayer(geometry=geometry_for(voxel_edge_m=args.voxel, channels=channels()))
    except NotFoundError as exc:
        if exc.kind != "no_map" or map_of_layer(name) is not None:  # an operator adds layers, never a robot
            raise
        if args.voxel is None:
            raise BadInputError(
                "no_map", f"there is no map {name} yet; make one with `cairn map create`, or give --voxel METRES"
            ) from exc
        made = geometry_for(voxel_edge_m=args.voxel, channels=channels())
        return api.create_map(name, CreateMap(geometry=made, epoch_s=STANDARD_EPOCH_S)).layer
    geometry = layer.geometry
    if wished is not None and wished.voxel_edge_um != geometry.voxel_edge_um:
        raise BadInputError(
            "other_geometry",
            f"map {name} has voxels of {shown_length(geometry.voxel_edge_m)}, not {shown_length(wished.voxel_edge_m)}; "
            "leave --voxel out, or choose another map",
        )
    return layer


def channels_of(source: ScanSource) -> tuple[Channel, ...]:
    """Channels that the recording's first scan can fill."""
    scan = source.scan(0)
    has = ((COLOUR, bool(scan.colour)), (INTENSITY, scan.amplitude is not None), (TEMPERATURE, bool(scan.thermal)))
    return tuple(channel for channel, found in has if found)


def default_name(text: str) -> str:
    """A robot's name made of any text."""
    name = "".join(letter if letter.isascii() and letter.isalnum() else "-" for letter in text.lower()).strip("-")
    return name[:32] or "robot"


def add_parser(commands: Subparsers) -> None:
    """Add the subcommand."""
    replay = commands.add_parser("replay", help="map a recording", description="map a recording")
    add_map(replay)
    add_layer_option(replay)
    replay.add_argument(
        "recording", type=Path, help="recording folder, known published layout, folder of point clouds, or bag of ROS"
    )
    replay.add_argument("--voxel", type=float, metavar="METRES", help="make the map with this voxel edge if needed")
    replay.add_argument(
        "--again", action="store_true", help="replay a recording once more that this robot has replayed"
    )
    replay.add_argument("--share", type=_share, default=(1, 1), metavar="I/N", help="every N-th measurement from I on")
    bounds = Grouping()
    replay.add_argument(
        "--scans-per-measurement",
        type=int,
        metavar="N",
        help=f"scans of one commit (those that the recording groups, else up to {bounds.scans_max} within "
        f"{bounds.seconds_max:g} s and {bounds.metres_max:g} m)",
    )
    add_ranges(replay)
    add_gate(
        replay,
        standard="A replay takes every scan of a recording, unless one of these options is given; the two others then "
        "have the values of a live robot.",
    )
    replay.add_argument("--state", type=Path, metavar="DIR", help="the robot's folder (cairn-NAME)")
    add_kept_scans(replay)
    replay.add_argument("--mode", choices=("high-end", "low-end"), default="high-end")
    replay.add_argument(
        "--profile",
        choices=list(Profile),
        help="small: four tenths fewer bytes, more work (as --link wants it)",
    )
    add_source_arguments(replay)
    replay.set_defaults(run=_replay)


def _share(text: str) -> tuple[int, int]:
    part, slash, parts = text.partition("/")
    if not slash or not part.isdigit() or not parts.isdigit() or not 1 <= int(part) <= int(parts):
        raise argparse.ArgumentTypeError(f"expected PART/PARTS such as 1/2, got {text!r}")
    return int(part), int(parts)
