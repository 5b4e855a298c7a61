"""`cairn robot live`: map what a robot with ROS sees, as it sees it, through its Foxglove bridge or another door.

    $ cairn robot inspect ws://robot:8765 --output live.yaml          # which topics are what; a file to edit
    $ cairn robot live ws://robot:8765 --topics live.yaml --map http://base:8750/maps/lab --voxel 0.05 --name mole
    mole: 2.1 scans/s of 15.0 (12.9/s not moved), newest 0.2 s old, 1 commits wait
    ^Cmapped 310 scans of 9000 as 104 commits; 8690 not moved; 0 commits wait

Any robot with ROS 2 or ROS 1 has a door for it: sudo apt install ros-$ROS_DISTRO-foxglove-bridge, then ros2 launch
foxglove_bridge foxglove_bridge_launch.xml. cairn needs no ROS. Run it on the robot: images then stay there, and only
commits cross the radio.

Other doors: wss://HOST:PORT, a bridge behind TLS (--ca FILE: its issuer); zenoh://HOST:PORT[?domain=N], the router of
rmw_zenoh or a zenoh-bridge-ros2dds (pip install "cairn-robotics[robot,live]"); ros2:[?domain=N], the ROS 2 of this
machine, sourced, with its Python (3.11 or newer).

The topics file is that of bags (`cairn robot inspect`); without --topics a proposal is made, and taken if it leaves no
question open. A range image becomes a scan once a pose at or after its time came; of other cameras the nearest image
goes with it, as in a replay: the same messages recorded in a bag give the same map, byte for byte. Scans of a robot
that has not moved are not taken, except one every 2 s; --every-scan takes all. If mapping is slower than the cameras,
the newest scans win.

The status line says what arrives and what is missing, by cause: no tf, tf late, a gap in tf, a publisher without
messages, clocks apart, no link. --json prints the whole status each second. A bridge or a node that starts again is
found again. Without a link to the map's server it maps on, as every robot. ^C or SIGTERM ends it: what came is mapped,
and waiting commits are pushed for some seconds.

--record DIR writes the messages that became scans as a bag, of which `cairn robot replay DIR` makes the same map. Names
of `corrections` in the topics file move what was mapped by the path that a SLAM optimises; that needs --keep-scans.

A source that cannot be mapped ends it within ten seconds, with one sentence and exit code 2: no door there, another
protocol, a topic that is missing, silent or of another type, a topics file with questions, a map of another grid.
"""

import argparse
from pathlib import Path

from cairn_client.cli.arguments import Subparsers
from cairn_client.cli.range_arguments import add_ranges
from cairn_client.cli.robot_arguments import add_gate, add_kept_scans, add_limits, add_map
from cairn_client.cli.robots.layer_option import add_layer_option
from cairn_map.codec.cell_code import Profile
from cairn_map.errors import BadInputError


def add_parser(commands: Subparsers) -> None:
    """Add the subcommand."""
    live = commands.add_parser("live", help="map what a robot with ROS sees, as it sees it", description=__doc__)
    live.add_argument("source", metavar="SOURCE", help="ws://HOST:PORT of its Foxglove bridge, or another door")
    live.add_argument("--ca", type=Path, metavar="FILE", help="issuer of the certificate of wss:// (this machine's)")
    add_map(live)
    add_layer_option(live)
    live.add_argument("--voxel", type=float, metavar="METRES", help="make the map with this voxel edge if needed")
    live.add_argument("--topics", type=Path, metavar="YAML", help="meaning of the topics; see inspect")
    add_ranges(live)
    add_gate(live, standard="A scan is taken once one of these is reached.")
    live.add_argument("--state", type=Path, metavar="DIR", help="the robot's folder (cairn-NAME)")
    live.add_argument("--mode", choices=("high-end", "low-end"), default="high-end")
    live.add_argument("--profile", choices=list(Profile), help="small: fewer bytes, more work (as --link wants it)")
    live.add_argument("--every", type=float, default=5.0, metavar="SECONDS", help="longest pause between syncs (5)")
    add_limits(live)
    add_kept_scans(live)
    live.add_argument("--record", type=Path, metavar="DIR", help="write the messages that become scans, for replay")
    live.add_argument("--stay", action="store_true", help="stay on the map at the end")
    live.add_argument("--json", action="store_true", help="print the status as JSON, a line each second")
    live.set_defaults(run=_live)


def _live(args: argparse.Namespace) -> int:
    try:  # other commands of `cairn robot` do without these libraries
        from cairn_client.cli.robots.live_run import run_live
    except ModuleNotFoundError as exc:
        raise BadInputError(
            "missing_extra", f'live robots need {exc.name}: pip install "cairn-robotics[robot]"'
        ) from exc
    return run_live(args)
