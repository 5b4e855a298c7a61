"""Be a robot: map recordings as they come or afterwards, keep a copy of a map, look after a robot's folder.

    $ cairn robot replay shelf/ --map http://127.0.0.1:8750/maps/shelf --voxel 0.01
    shelf: 15 scans; the first has 26% of its pixels, median range 0.57 m
    replayed 15 scans as 15 commits in 1.9 s (7.9 scans/s), 302.0 kB up, 62.8 kB down, 0 commits wait
    $ cairn robot pull --map http://127.0.0.1:8750/maps/shelf --state mole/ --mode low-end --near 4,2,0
    $ cairn robot run spool/ --map http://127.0.0.1:8750/maps/shelf --name mole
    $ cairn robot status cairn-shelf/
    $ cairn robot queue cairn-shelf/
    $ cairn robot sync cairn-shelf/

`replay` reads a recording folder (RECORDING.md), a bag of ROS 1 or ROS 2 (.bag, .mcap, .db3; `cairn robot inspect`
says what is in it and proposes --topics), a known layout as it was published (apc_shelf_rgbd, mm5_rgbdt), or any
folder of frames that options describe (--depth, --pose, --intrinsics, ...: `cairn robot replay --help`). It maps as a
live robot would: each measurement becomes a commit, first kept in the state folder, then pushed.
Without a link it goes on, and the next `replay` or `pull` with the same state folder pushes what waits. Two robots
can share a recording: --share 1/2 takes every second measurement from the first on, --share 2/2 the others.

`pull` makes a robot's folder, or fetches what its robot misses and pushes what waits there. With --mode low-end it
fetches whole cells instead of differences, on request only those around a place (--near X,Y,Z --radius METRES). For a
copy to look at, there are `cairn clone` and `cairn pull`, which push nothing and need no robot.

Both can fetch a part of the map: --box X0,Y0,Z0,X1,Y1,Z1 (metres in the map's frame) only the cells that share more
than a face with this box; and in small helpings: with --reply-bytes 100000 each reply ends after 100 kB of cells, or
one cell. `--link small` is for some ten to some hundred kbit/s: it chooses helpings, makes commits that take more work
and four tenths fewer bytes, and sends them in parts of 16 kB, so that a link that breaks goes on where it stopped. On
every link the cells around the robot come first.

`run` is a robot that lives: it maps the recordings that a driver puts into a folder, and syncs, until a signal ends it.
`status` and `queue` look into a robot's folder, also while the robot is at work; `sync` pushes and fetches for it.
"""

import argparse
from collections.abc import Callable

from cairn_client.cli.arguments import parser
from cairn_client.cli.robots import inspect as inspect_command
from cairn_client.cli.robots import pull_robot
from cairn_client.cli.robots import queue as queue_command
from cairn_client.cli.robots import replay as replay_command
from cairn_client.cli.robots import run as run_command
from cairn_client.cli.robots import status as status_command
from cairn_client.cli.robots import sync as sync_command


def main(argv: list[str]) -> int:
    """Run one of the subcommands."""
    args = _parser().parse_args(argv)
    run: Callable[[argparse.Namespace], int] = args.run
    return run(args)


def _parser() -> argparse.ArgumentParser:
    top = parser("cairn robot", __doc__)
    commands = top.add_subparsers(required=True, metavar="COMMAND")
    replay_command.add_parser(commands)
    inspect_command.add_parser(commands)
    pull_robot.add_parser(commands)
    run_command.add_parser(commands)
    status_command.add_parser(commands)
    queue_command.add_parser(commands)
    sync_command.add_parser(commands)
    return top
