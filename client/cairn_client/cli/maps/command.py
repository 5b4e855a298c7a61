"""Create, look at, download and correct maps on a server.

    $ cairn map create http://127.0.0.1:8750/maps/lab --voxel 0.04
    map lab: voxels of 4 cm, cells of 5.12 m, channels colour, intensity, temperature
    $ cairn map ls http://127.0.0.1:8750
    $ cairn map info http://127.0.0.1:8750/maps/lab
    $ cairn map get http://127.0.0.1:8750/maps/lab 0,0,0 -o cell.ply
    $ cairn map export http://127.0.0.1:8750/maps/lab --ply lab.ply --picture lab.png --cells lab/
    $ cairn map log http://127.0.0.1:8750/maps/lab --graph
    $ cairn map branches http://127.0.0.1:8750/maps/lab
    $ cairn map retract http://127.0.0.1:8750/maps/lab --robot mole --pushed-after 14:05 --dry-run
    $ cairn map query lab/ ray 1,2,0.4 0,1,0
    $ cairn map render lab/ --from 1,2,1.4 --to 4,2,1 -o view.png
    $ cairn map heal http://127.0.0.1:8750/maps/lab lab/

A map's URL is http://HOST:PORT/maps/NAME. A retract takes exactly the evidence of the named commits out again, on
the server and on every robot; everything else stays as it is. Results go to standard output, progress to standard
error; --json prints what programs want.
"""

import argparse
import json
import time
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

from cairn_client.cli.arguments import add_token, allow_negative_lists, api_of, parser, say, shown_bytes, shown_length
from cairn_client.cli.maps import map_export
from cairn_client.cli.maps.branch_table import branch_table
from cairn_client.cli.maps.heal import add_heal_arguments, heal
from cairn_client.cli.maps.log_graph import log_graph
from cairn_client.cli.maps.part_export import add_part_arguments
from cairn_client.cli.maps.prior_data import push_prior_data
from cairn_client.cli.maps.query import add_query_arguments
from cairn_client.cli.maps.render import add_render_arguments
from cairn_client.cli.maps.retract import add_retract_arguments, retract
from cairn_client.http.api import MapApi
from cairn_map.errors import BadInputError
from cairn_map.evidence.channels import COLOUR, INTENSITY, TEMPERATURE, Channel, ChannelKind
from cairn_map.evidence.grid import Geometry, geometry_for
from cairn_map.wire.messages import CreateMap, LogEntry, MapInfo

Run = Callable[[argparse.Namespace], None]

CHANNELS = {"colour": COLOUR, "intensity": INTENSITY, "temperature": TEMPERATURE}


def main(argv: list[str]) -> int:
    """Run one of the subcommands."""
    args = _parser().parse_args(argv)
    run: Run = args.run
    run(args)
    return 0


def _create(args: argparse.Namespace) -> None:
    api, name = api_of(args.map, args.token)
    geometry = _geometry(args)
    if args.source is not None:
        with api:
            info, count, added = push_prior_data(api, name, args.source, token=args.token)
        _say_map(info)
        say(f"started from {args.source}: {count} cells, as the commit of author `initial`")
        if added < count:
            say(f"{count - added} of them were pushed before, and are not added again (nor if they were retracted)")
        return
    with api:
        made = api.create_map(name, CreateMap(geometry=geometry))
    _say_map(made)


def _ls(args: argparse.Namespace) -> None:
    with MapApi(args.server, token=args.token) as api:
        infos = api.maps()
    if args.json:
        say(json.dumps([info.model_dump(mode="json") for info in infos]))
        return
    say(f"{'map':<24} {'voxel':>8} {'cells':>6} {'size':>9} {'commits':>8} {'robots':>7}")
    for info in infos:
        voxel = shown_length(info.geometry.voxel_edge_m)
        size = shown_bytes(info.size_bytes)
        say(f"{info.name:<24} {voxel:>8} {info.cells:>6} {size:>9} {info.commits:>8} {info.branches:>7}")
    if not infos:
        say("(none yet; make one with `cairn map create SERVER/maps/NAME`)")


def _info(args: argparse.Namespace) -> None:
    api, name = api_of(args.map, args.token)
    with api:
        info, branches = api.map_info(name), api.branches(name)
    if args.json:
        branch_json = [branch.model_dump(mode="json") for branch in branches]
        say(json.dumps({**info.model_dump(mode="json"), "branch_list": branch_json}))
        return
    _say_map(info)
    say(f"{info.cells} cells, {shown_bytes(info.size_bytes)}, {info.commits} commits; head {info.cursor}")
    if info.box_m:
        low, high = ("  ".join(f"{value:.2f}" for value in corner) for corner in info.box_m)
        say(f"cells span ({low}) m to ({high}) m")
    for branch in branches:
        lag = "has not fetched all yet" if branch.behind is None else f"{branch.behind} log entries since it last asked"
        lag = "fetches whole cells" if branch.mode == "low-end" else lag
        seen_s, sensors = time.time() - branch.last_seen_s, ", ".join(branch.sensors)
        say(f"  {branch.branch:<16} {branch.mode:<9} {lag}, seen {seen_s:.0f} s ago, {sensors}")


def _log(args: argparse.Namespace) -> None:
    api, name = api_of(args.map, args.token)
    with api:
        entries = api.log(name, after=args.after, limit=args.limit)
    if args.json:
        say(json.dumps([entry.model_dump(mode="json") for entry in entries]))
        return
    taken_out = {entry.id: entry.seq for entry in entries if entry.kind == "-"}
    listed = (_log_line(entry, taken_out.get(entry.id)) for entry in entries)
    for line in log_graph(entries) if args.graph else listed:
        say(line)
    if not entries:
        say("(nothing yet)")
    if len(entries) == args.limit:
        say(f"(perhaps more: --after {entries[-1].seq})")


def _branches(args: argparse.Namespace) -> None:
    api, name = api_of(args.map, args.token)
    with api:
        branches = api.branches(name)
    if args.json:
        say(json.dumps([branch.model_dump(mode="json") for branch in branches]))
        return
    for line in branch_table(branches):
        say(line)
    if not branches:
        say("(none yet; a robot registers by itself when it first syncs)")


def _log_line(entry: LogEntry, taken_out: int | None) -> str:
    """One entry: what happened, by whom, when it was captured, how much, and what became of it."""
    word = "folded" if entry.kind == "+" else "taken out"
    size = f"{entry.cells} cells, {shown_bytes(entry.size_bytes)}"
    line = f"{entry.seq:>6}  {word:<9}  {_shown_time(entry.captured_s):<19}  {entry.id}  {size}"
    if entry.retracts:
        more = f" and {len(entry.retracts) - 1} more" if len(entry.retracts) > 1 else ""
        line += f"  retracts {entry.retracts[0]}{more}"
    return line + (f"  (taken out by {taken_out})" if entry.kind == "+" and taken_out else "")


def _shown_time(captured_s: tuple[float, float] | None) -> str:
    """When a measurement began, UTC."""
    try:
        return datetime.fromtimestamp(captured_s[0], UTC).strftime("%Y-%m-%d %H:%M:%S") if captured_s else "-"
    except (OverflowError, ValueError, OSError):
        return "-"


def _geometry(args: argparse.Namespace) -> Geometry:
    channels = tuple(_channel(text) for text in args.channels.split(",")) if args.channels else ()
    return geometry_for(voxel_edge_m=args.voxel, channels=channels)


def _channel(text: str) -> Channel:
    """`colour`, `intensity`, `temperature`, or a scalar `name:unit:step`."""
    if text in CHANNELS:
        return CHANNELS[text]
    name, *rest = text.split(":")
    try:
        unit, step = rest
        return Channel(kind=ChannelKind.SCALAR, name=name, unit=unit, step=float(step))
    except ValueError as exc:
        raise BadInputError(
            "bad_channel",
            f"a channel is {', '.join(CHANNELS)}, or a scalar NAME:UNIT:STEP such as dose:uSv/h:0.01; got {text!r}",
        ) from exc


def _say_map(info: MapInfo) -> None:
    geometry = info.geometry
    names = ", ".join(channel.name for channel in geometry.channels) or "none but occupancy"
    say(
        f"map {info.name}: voxels of {shown_length(geometry.voxel_edge_m)}, "
        f"cells of {geometry.cell_edge_m:g} m, channels {names}"
    )


def _parser() -> argparse.ArgumentParser:
    top = parser("cairn map", __doc__)
    commands = top.add_subparsers(required=True, metavar="COMMAND")

    def command(
        name: str, text: str, run: Callable[[argparse.Namespace], None], target: str
    ) -> argparse.ArgumentParser:
        added = commands.add_parser(name, help=text, description=text)
        added.add_argument(target, help="http://HOST:PORT/maps/NAME" if target == "map" else "http://HOST:PORT")
        add_token(added)
        added.set_defaults(run=run)
        return added

    create = command("create", "create a map, empty or from prior data", _create, "map")
    create.add_argument("--voxel", type=float, default=0.04, metavar="METRES", help="voxel edge (0.04)")
    create.add_argument("--channels", default="colour,intensity,temperature", help="scalars as NAME:UNIT:STEP")
    create.add_argument("--from", dest="source", metavar="DIR|URL", help="folder of cells, or another map's URL")
    for name, text, run, target in (
        ("ls", "list the maps of a server", _ls, "server"),
        ("info", "extent, sizes and robots of a map", _info, "map"),
        ("branches", "the robots of a map: lag, last sign of life, pose", _branches, "map"),
        ("log", "what was folded and taken out, oldest first", _log, "map"),
    ):
        added = command(name, text, run, target)
        added.add_argument("--json", action="store_true", help="print JSON")
        if name == "log":
            added.add_argument("--after", type=int, default=0, metavar="SEQ", help="entries after this one (0)")
            added.add_argument("--limit", type=int, default=100, help="at most so many (100)")
            added.add_argument("--graph", action="store_true", help="lines from each commit to those that it hangs on")
    get = command("get", "download one cell", map_export.get_cell, "map")
    get.add_argument("cell", help="its number, i,j,k")
    allow_negative_lists(get)
    get.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help=".cell, .npz, .ply or .view")
    export = command("export", "download a whole map, or a part of it as points", map_export.export_map, "map")
    export.add_argument("--cells", type=Path, metavar="DIR", help="one file a cell, named by its number")
    export.add_argument("--ply", type=Path, metavar="FILE", help="occupied voxels as a point cloud")
    export.add_argument("--npz", type=Path, metavar="FILE", help="all known voxels as NumPy arrays")
    export.add_argument("--picture", type=Path, metavar="FILE", help="PNG: colour, temperature, probability")
    export.add_argument(
        "--ceiling", type=float, metavar="METRES", help="leave out what is higher; with --picture, of the picture alone"
    )
    add_part_arguments(export)
    add_query_arguments(commands.add_parser("query", help="ask a map that lies in a folder, without a server"))
    add_render_arguments(commands.add_parser("render", help="draw a map from a pose, or over a camera's image"))
    add_heal_arguments(command("heal", "send cells that the server's disk damaged", heal, "map"))
    add_retract_arguments(command("retract", "take commits out of a map again, exactly", retract, "map"))
    return top
