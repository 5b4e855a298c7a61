"""Be a robot: map recordings as they come or afterwards, keep a copy of a map, look after a robot's folder.

    $ cairn robot replay shelf/ --map http://127.0.0.1:8750/maps/shelf --voxel 0.01
    shelf: 15 scans; the first has 26% of its pixels, median range 0.57 m
    replayed 15 scans as 15 commits in 1.9 s (7.9 scans/s), 302.0 kB up, 62.8 kB down, 0 commits wait
    $ cairn robot run spool/ --map http://127.0.0.1:8750/maps/shelf --name mole
    $ cairn robot live ws://robot:8765 --map http://127.0.0.1:8750/maps/shelf --name mole
    $ cairn robot status cairn-shelf/
    $ cairn robot queue cairn-shelf/
    $ cairn robot sync cairn-shelf/
    $ cairn robot sync mole/ --map http://127.0.0.1:8750/maps/shelf --mode low-end --near 4,2,0
    $ cairn robot amend cairn-shelf/ --trajectory optimised.tum

`replay` reads a recording folder (RECORDING.md), a bag of ROS 1 or ROS 2 (.bag, .mcap, .db3; `cairn robot inspect`
lists its topics and proposes --topics), a known layout as it was published (apc_shelf_rgbd, mm5_rgbdt), or any folder
of frames that options describe (--depth, --pose, --intrinsics, ...: `cairn robot replay --help`). It maps as a live
robot would: each measurement becomes a commit, first kept in the state folder, then pushed. Without a link it goes on,
and the next `replay` or `sync` with the same state folder pushes the commits that wait. Two robots can share a
recording: --share 1/2 takes every second measurement from the first on, --share 2/2 the others.

`sync` pushes the commits that wait in a robot's folder and fetches changes, or makes a new folder of the map at --map.
With --mode low-end it fetches whole cells instead of differences, on request only those around a place (--near X,Y,Z
--radius METRES). For a copy to look at, there are `cairn clone` and `cairn pull`, which push nothing and need no robot.

`replay`, `run` and `sync` can fetch a part of the map: --box X0,Y0,Z0,X1,Y1,Z1 (metres in the map's frame) only the
cells that share more than a face with this box; and in short replies: with --reply-bytes 100000 each reply ends after
100 kB of cells, or one cell. `--link small` is for some ten to some hundred kbit/s: it chooses short replies, makes
commits that take more work and four tenths fewer bytes, and sends them in parts of 16 kB, so that a link that breaks
goes on where it stopped. On every link the cells around the robot come first.

`replay`, `run` and `live` map into the map's first layer; `--layer fine` names another (`cairn map layer`), in a folder
of its own, and `--assigned` takes the one that operators assigned to the robot. `--layer` of a command asks for a layer
that is there: a robot makes none.

`run` maps the recordings that a driver puts into a folder, and syncs, until a signal ends it. `live` maps what a robot
with ROS sees, through its Foxglove bridge, as it sees it. `status` and `queue` look
into a robot's folder, also while the robot is at work. `amend` moves past measurements to the poses of a
trajectory that a SLAM corrected.
"""

import argparse
import time
from datetime import UTC, datetime
from pathlib import Path

from cairn_client.cli.arguments import Subparsers, run_subcommand, say, shown_age, shown_bytes
from cairn_client.cli.robots import amend, inspect, live, replay, run, sync
from cairn_client.folders.folder_status import FolderStatus, QueuedCommit, folder_queue, folder_status
from cairn_map.errors import BadInputError

STATUS = """`cairn robot status`: state of the robot of a folder, whether or not it is at work.

$ cairn robot status state/
mole on map lab (http://base:8750/maps/lab), high-end, at work
key            mole.1f2e3d4c5b6a7988
last contact   12 s ago; failing for 8 s: cannot reach http://base:8750/ [no_link]
waiting        2 commits, 81.3 kB; 5 kept, 203.1 kB
map            14 cells, 1.2 MB, at cursor 6f...
disk           5.3 MB
"""
QUEUE = """`cairn robot queue`: the commits that a robot's folder keeps, oldest first.

    $ cairn robot queue state/
    captured (UTC)           size  cells  server has it  commit
    2026-11-20 14:05:11   40.6 kB      4  yes            mole.5f0c2a9be1d3f607.11
    2026-11-20 14:05:43   40.7 kB      5  no             mole.5f0c2a9be1d3f607.12

A commit that the server has is kept until no restore of the server from a backup can lose it.
"""


def main(argv: list[str]) -> int:
    """Run one of the subcommands.

    Raises:
        BadInputError: kind `bad_option`: the subcommand is `pull`, which `sync` has replaced.
    """
    if argv[:1] == ["pull"]:
        raise BadInputError(
            "bad_option",
            "there is no `cairn robot pull`: `cairn robot sync DIR --map URL` does the same (a copy to look at: "
            "`cairn clone`)",
        )
    looking = (_add_status, _add_queue)
    parts = (
        replay.add_parser,
        inspect.add_parser,
        run.add_parser,
        live.add_parser,
        *looking,
        sync.add_parser,
        amend.add_parser,
    )
    return run_subcommand("cairn robot", __doc__, parts, argv)


def _add_status(commands: Subparsers) -> None:
    status = commands.add_parser("status", help="state of the robot of a folder", description=STATUS)
    status.add_argument("folder", type=Path, metavar="DIR", help="the robot's folder")
    status.add_argument("--json", action="store_true", help="print JSON: times in UTC seconds, sizes in bytes")
    status.set_defaults(run=_status)


def _add_queue(commands: Subparsers) -> None:
    queue = commands.add_parser("queue", help="the commits that a robot's folder keeps", description=QUEUE)
    queue.add_argument("folder", type=Path, metavar="DIR", help="the robot's folder")
    queue.add_argument("--json", action="store_true", help="print JSON: times in UTC seconds, sizes in bytes")
    queue.set_defaults(run=_queue)


def _status(args: argparse.Namespace) -> int:
    status = folder_status(args.folder)
    if args.json:
        say(status.model_dump_json())
        return 0
    state = "at work" if status.is_open else "not at work"
    server = status.url or "server unknown"
    say(f"{status.robot} on map {status.map} ({server}), {status.mode or 'mode unknown'}, {state}")
    say(f"  key            {status.robot}.{status.incarnation}")
    say(f"  last contact   {_contact(status)}")
    waiting = f"{status.waiting} commits, {shown_bytes(status.waiting_bytes)}"
    say(f"  waiting        {waiting}; {status.kept} kept, {shown_bytes(status.kept_bytes)}")
    place = f"at cursor {status.cursor}" if status.cursor else "not all of the server's"
    say(f"  map            {status.cells} cells, {shown_bytes(status.cells_bytes)}, {place}")
    say(f"  disk           {shown_bytes(status.disk_bytes)}")
    most = "no limit" if status.memory_bytes_max is None else f"{shown_bytes(status.memory_bytes_max)} at most"
    say(f"  memory of map  {most}")
    return 0


def _contact(status: FolderStatus) -> str:
    now_s = time.time()
    last = "never" if status.last_contact_s is None else f"{shown_age(now_s - status.last_contact_s)} ago"
    if status.failing_since_s is None:
        return last
    return f"{last}; failing for {shown_age(now_s - status.failing_since_s)}: {status.failure} [{status.failure_kind}]"


def _queue(args: argparse.Namespace) -> int:
    queue = folder_queue(args.folder)
    if args.json:
        say(queue.model_dump_json())
        return 0
    if not queue.commits:
        say(f"(nothing: all commits of {queue.robot} are on map {queue.map} for good)")
        return 0
    say(f"{'captured (UTC)':<19} {'size':>9} {'cells':>6}  {'server has it':<13}  commit")
    for commit in queue.commits:
        known = "damaged" if commit.is_damaged else "yes" if commit.acknowledged else "no"
        size = shown_bytes(commit.size_bytes)
        note = f"  {commit.note}".replace("\n", " ").rstrip()
        say(f"{_captured(commit):<19} {size:>9} {commit.cells:>6}  {known:<13}  {commit.id}{note}")
    return 0


def _captured(commit: QueuedCommit) -> str:
    try:
        first_s = commit.captured_s[0] if commit.captured_s else None
        return "-" if first_s is None else datetime.fromtimestamp(first_s, UTC).strftime("%Y-%m-%d %H:%M:%S")
    except (OverflowError, ValueError, OSError):
        return "-"
