"""Publish a map for Foxglove, RViz and bags: as messages of ROS 2, kept up to date by the map's live events.

    $ cairn map publish http://127.0.0.1:8750/maps/lab --foxglove 8766      # until Ctrl-C
    lab at ws://127.0.0.1:8766: open it in Foxglove or Lichtblick ("Foxglove WebSocket")
    15:04:05  12 cells: ground at 0.00 m, published 0.31 s after the news
    15:04:10  3 cells: ground at 0.00 m, published 0.09 s after the news
    $ cairn map publish http://127.0.0.1:8750/maps/lab --mcap lab.mcap       # as it is now
    lab.mcap: 5 messages, 1.4 MB
    $ cairn map publish http://127.0.0.1:8750/maps/lab --mcap run.mcap --follow --changes 20

Topics, all in the frame `map` (--frame), lengths in metres, temperatures in degrees Celsius:

    /map                        nav_msgs/OccupancyGrid: a storey's floor, 100 occupied, 0 free, -1 unknown
    /cairn/points               sensor_msgs/PointCloud2: all occupied voxels, at most every 10 s
    /cairn/changed_points       sensor_msgs/PointCloud2: those of the cells that changed
    /cairn/hot_spots            visualization_msgs/MarkerArray: the ten hottest places
    /cairn/marks                visualization_msgs/MarkerArray: what robots and people marked
    /cairn/octomap              octomap_msgs/Octomap: occupied and free space, once, with --octomap
    /tf                         tf2_msgs/TFMessage: robots that report where they are, each the frame of its name
    /cairn/robots/NAME/path     nav_msgs/Path: the way of one since publishing began, at most every 3 s; its name has
                                _ for - and _U for _

The storey of /map is that of --ground; without it the largest one, chosen again after each change, but left only for
one with twice its free area. A viewer that joins late gets the newest message of each topic at once.

Robots get all but /tf as topics of their own ROS, Nav2 /map among them, without a ROS on this machine:

    --through ws://robot:8765   by the robot's Foxglove bridge, which publishes it there; it keeps nothing for nodes
                                that come late, so /map is sent again every 5 s
    --zenoh zenoh://robot:7447  by a zenoh router, of rmw_zenoh (?domain=N: ROS_DOMAIN_ID) or of zenoh-bridge-ros2dds;
                                nodes that come late get the newest message of each topic
    --ros2                      by the ROS 2 of this machine, in the domain of ROS_DOMAIN_ID, kept in the same way

A file is FILE.part until the command ends, at a change's number, by Ctrl-C or by SIGTERM; then it has its index.

The server of --foxglove has no access control: it listens on this machine alone, unless another address is given
(--foxglove 0.0.0.0:8766). Browsers' pages are refused but for Foxglove's own; --origin http://viewer:8080 lets those of
a Lichtblick of your own in. For Nav2's map server there are files: `cairn map export URL --map-server NAME`.
"""

import argparse
import re
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

from cairn_client.cli.arguments import Subparsers, add_token, api_of, say, shown_bytes
from cairn_client.cli.floor_arguments import add_floor_arguments
from cairn_client.http.api import MapApi
from cairn_client.http.live_listener import Lost, listen
from cairn_map.errors import BadInputError, UnreachableError
from cairn_map.wire.live_events import CellsEvent, Hello, MarksEvent, RobotHeard

if TYPE_CHECKING:
    from cairn_client.publish.followed_map import FollowedMap
    from cairn_client.publish.map_publisher import MapPublisher, Sink
    from cairn_client.publish.mcap_file import McapFile
    from cairn_client.publish.zenoh_sink import ZenohSink

ADDRESS = re.compile(r"(?:(?P<host>[^\s:]+|\[[0-9a-fA-F:]+\]):)?(?P<port>\d{1,5})")
ORIGIN = re.compile(r"https?://[^\s/]+/?", re.IGNORECASE)
FRAME = re.compile(r"[A-Za-z][\w./-]{0,63}")


def add_parser(commands: Subparsers) -> None:
    """Add the subcommand."""
    text = "publish a map for Foxglove, RViz and bags"
    publish = commands.add_parser("publish", help=text, description=__doc__)
    publish.add_argument("map", help="http://HOST:PORT/maps/NAME")
    publish.add_argument("--foxglove", type=_address, metavar="[HOST:]PORT", help="serve viewers here (0: a free port)")
    publish.add_argument(
        "--origin", action="append", default=[], type=_origin, metavar="ORIGIN", help="its pages may join, too"
    )
    publish.add_argument("--mcap", type=Path, metavar="FILE", help="write the messages into a file")
    publish.add_argument("--through", metavar="URL", help="send to the Foxglove bridge at ws://HOST:PORT, for its ROS")
    publish.add_argument("--zenoh", metavar="URL", help="send to the ROS 2 of the router at zenoh://HOST:PORT?domain=N")
    publish.add_argument("--ros2", action="store_true", help="send to the ROS 2 of this machine")
    publish.add_argument("--ca", type=Path, metavar="FILE", help="issuer of the certificate of wss:// (this machine's)")
    publish.add_argument("--follow", action="store_true", help="go on with each change; with all but --mcap it does")
    publish.add_argument("--changes", type=int, metavar="N", help="end after so many changes, the first state included")
    publish.add_argument("--octomap", action="store_true", help="the octree of occupied and free space, too, once")
    publish.add_argument("--frame", default="map", type=_frame, metavar="NAME", help="frame of the map (map)")
    add_floor_arguments(publish)
    add_token(publish)
    publish.set_defaults(run=_run)


def _run(args: argparse.Namespace) -> int:
    _check_options(args)
    try:
        from cairn_client.publish.followed_map import FollowedMap
        from cairn_client.publish.map_publisher import FloorChoice, MapPublisher
    except ModuleNotFoundError as exc:
        raise _missing_extra(exc) from exc
    api, name = api_of(args.map, args.token)
    with _ended_by_sigterm(), ExitStack() as open_parts:
        open_parts.enter_context(api)
        followed = FollowedMap(api, name)
        # Checked before a file is begun: a band is of the map's voxels.
        followed.snapshot.floor_grid(ground_m=args.ground or 0.0, band_m=args.band)
        sinks = _open_sinks(args, name, open_parts)
        choice = FloorChoice(ground_m=args.ground, band_m=args.band, frame=args.frame)
        publisher = MapPublisher(api, followed, sinks, choice)
        if args.follow or _is_live(args):
            _follow(api, followed, publisher, args)
        else:
            _publish_once(api, followed, publisher, args)
    return 0


def _open_sinks(args: argparse.Namespace, name: str, open_parts: ExitStack) -> "list[Sink]":
    """Places that the options name, each closed with the stack."""
    try:
        from cairn_client.publish.bridge_sink import BridgeSink
        from cairn_client.publish.foxglove_server import FoxgloveServer
        from cairn_client.publish.mcap_file import McapFile
        from cairn_client.publish.ros2_sink import Ros2Sink
    except ModuleNotFoundError as exc:
        raise _missing_extra(exc) from exc
    sinks: list[Sink] = []
    if args.foxglove is not None:
        host, port = args.foxglove
        server = open_parts.enter_context(FoxgloveServer(f"cairn: {name}", host=host, port=port, origins=args.origin))
        sinks.append(server)
        _say_at_once(f'{name} at {server.url}: open it in Foxglove or Lichtblick ("Foxglove WebSocket")')
    if args.through is not None:
        sinks.append(open_parts.enter_context(BridgeSink(args.through, ca_file=args.ca)))
        _say_at_once(f"{name} through {args.through}")
    if args.zenoh is not None:
        sinks.append(open_parts.enter_context(_zenoh_sink(args.zenoh)))
        _say_at_once(f"{name} through {args.zenoh}")
    if args.ros2:
        sinks.append(open_parts.enter_context(Ros2Sink()))
        _say_at_once(f"{name} in the ROS 2 of this machine")
    if args.mcap is not None:
        file = McapFile(args.mcap)
        # After it is closed, also by Ctrl-C, which is how a file that follows a map ends.
        open_parts.callback(_say_written, file)
        sinks.append(open_parts.enter_context(file))
    return sinks


def _zenoh_sink(url: str) -> "ZenohSink":
    try:
        from cairn_client.publish.zenoh_sink import ZenohSink
    except ModuleNotFoundError as exc:
        raise _missing_extra(exc, "robot,live") from exc
    return ZenohSink(url)


def _missing_extra(exc: ModuleNotFoundError, extras: str = "robot") -> BadInputError:
    return BadInputError("missing_extra", f'publishing needs {exc.name}: pip install "cairn-robotics[{extras}]"')


def _is_live(args: argparse.Namespace) -> bool:
    """True if the map goes to programs that run, not into a file alone."""
    return args.ros2 or any(given is not None for given in (args.foxglove, args.through, args.zenoh))


def _check_options(args: argparse.Namespace) -> None:
    """Refuse options that would do nothing.

    Raises:
        BadInputError: kind `nothing_asked`, `bad_option`.
    """
    if not _is_live(args) and args.mcap is None:
        raise BadInputError(
            "nothing_asked", "say where to publish: --foxglove PORT, --through URL, --zenoh URL, --ros2, or --mcap FILE"
        )
    if args.ca is not None and args.through is None:
        raise BadInputError("bad_option", "--ca is about a bridge behind TLS: give --through wss://HOST:PORT, too")
    if args.changes is not None and (args.changes < 1 or not (args.follow or _is_live(args))):
        raise BadInputError("bad_option", "--changes N, 1 or more, is for a map that is followed: give --follow, too")
    if args.origin and args.foxglove is None:
        raise BadInputError("bad_option", "--origin is about viewers: give --foxglove PORT, too")


@contextmanager
def _ended_by_sigterm() -> Iterator[None]:
    """Let SIGTERM end the block as Ctrl-C does, so that a file gets its index; only the main thread has signals."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _publish_once(api: MapApi, followed: "FollowedMap", publisher: "MapPublisher", args: argparse.Namespace) -> None:
    publisher.publish_changes(followed.fetch())
    publisher.publish_marks()
    if args.octomap:
        publisher.publish_octree()
    for branch in api.branches(followed.info.name):
        publisher.publish_robot(branch.branch, branch.status)


def _follow(api: MapApi, followed: "FollowedMap", publisher: "MapPublisher", args: argparse.Namespace) -> None:
    """Publish the present state and each change, without an end but for `--changes`."""
    heard_s, left, is_first, has_marks = time.monotonic(), args.changes, True, True
    for event in listen(api, followed.info.name):
        match event:
            case Lost():
                _say_now(f"link lost: {event.reason}; trying again in {event.retry_in_s:.1f} s")
                continue
            case Hello():
                if not event.resumed:
                    heard_s = time.monotonic()
                    followed.note_any()
                    has_marks = True
                for sign in event.robots:
                    publisher.publish_robot(sign.branch, sign.status)
            case CellsEvent():
                heard_s = time.monotonic() if not followed.has_news else heard_s
                followed.note(event)
                continue  # `head` ends the changes of a fold
            case MarksEvent():
                has_marks = True
            case RobotHeard() if event.robot.gone:
                publisher.forget_robot(event.robot.branch)
            case RobotHeard():
                publisher.publish_robot(event.robot.branch, event.robot.status)
            case _:
                pass
        if has_marks:
            has_marks = not _have_published_marks(publisher)
        # After a link that broke no news may be left but what is not published yet.
        if not (followed.has_news or publisher.is_behind or is_first):
            publisher.publish_due()
            continue
        try:
            count = publisher.publish_changes(followed.fetch())
            if is_first and args.octomap:
                publisher.publish_octree()
        except UnreachableError as exc:
            _say_now(f"{exc.message}; trying again with the next sign of life")
            continue
        is_first = False
        ground = "no ground yet" if publisher.ground_m is None else f"ground at {publisher.ground_m:.2f} m"
        _say_now(f"{count} cells: {ground}, published {time.monotonic() - heard_s:.2f} s after the news")
        if left is not None:
            left -= 1
            if left <= 0:
                return


def _have_published_marks(publisher: "MapPublisher") -> bool:
    """Publish marks that changed; False if the link broke."""
    try:
        publisher.publish_marks()
    except UnreachableError as exc:
        _say_now(f"{exc.message}; trying again with the next sign of life")
        return False
    return True


def _say_written(file: "McapFile") -> None:
    if file.count:
        say(f"{file.path}: {file.count} messages, {shown_bytes(file.path.stat().st_size)}")


def _say_now(text: str) -> None:
    _say_at_once(f"{datetime.now(UTC):%H:%M:%S}  {text}")


def _say_at_once(text: str) -> None:
    """Say a line so that a program that reads a pipe gets it at once."""
    say(text)
    sys.stdout.flush()


def _address(text: str) -> tuple[str, int]:
    found = ADDRESS.fullmatch(text)
    if not found or int(found["port"]) > 65_535:
        raise argparse.ArgumentTypeError(f"an address is PORT or HOST:PORT, such as 8766; got {text!r}")
    return (found["host"] or "127.0.0.1").strip("[]"), int(found["port"])


def _origin(text: str) -> str:
    if not ORIGIN.fullmatch(text):
        raise argparse.ArgumentTypeError(f"an origin is http://HOST:PORT or https://HOST, got {text!r}")
    return text.rstrip("/").lower()


def _frame(text: str) -> str:
    if not FRAME.fullmatch(text):
        raise argparse.ArgumentTypeError(f"a frame is a name of letters, digits, '_', '.', '/' and '-'; got {text!r}")
    return text
