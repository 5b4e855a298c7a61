"""Create, look at, download and correct maps on a server.

    $ cairn map create http://127.0.0.1:8750/maps/lab --voxel 0.04
    map lab: voxels of 4 cm, cells of 5.12 m, channels colour, intensity, temperature, epochs of 120 s
    $ cairn map copy http://127.0.0.1:8750/maps/lab https://maps.example.org/maps/lab --follow
    $ cairn map ls http://127.0.0.1:8750
    $ cairn map info http://127.0.0.1:8750/maps/lab
    $ cairn map get http://127.0.0.1:8750/maps/lab 0,0,0 -o cell.ply
    $ cairn map export http://127.0.0.1:8750/maps/lab --ply lab.ply --picture lab.png --cells lab/
    $ cairn map export http://127.0.0.1:8750/maps/lab --map-server floor1
    $ cairn map publish http://127.0.0.1:8750/maps/lab --foxglove 8766
    $ cairn map log http://127.0.0.1:8750/maps/lab --graph
    $ cairn map changes http://127.0.0.1:8750/maps/lab --since 14:05
    $ cairn map hotspots http://127.0.0.1:8750/maps/lab --over 40
    $ cairn map marks http://127.0.0.1:8750/maps/lab
    $ cairn map mark http://127.0.0.1:8750/maps/lab --add "north door" --at 1.5,-2,1 --kind door
    $ cairn map layer add http://127.0.0.1:8750/maps/lab fine --voxel 0.01
    $ cairn map branches http://127.0.0.1:8750/maps/lab
    $ cairn map retract http://127.0.0.1:8750/maps/lab --robot mole --pushed-after 14:05 --dry-run
    $ cairn map retract http://127.0.0.1:8750/maps/lab --robot mole --all-layers
    $ cairn map robots list http://127.0.0.1:8750/maps/lab
    $ cairn map delete http://127.0.0.1:8750/maps/lab
    $ cairn map query lab/ ray 1,2,0.4 0,1,0
    $ cairn map render lab/ --from 1,2,1.4 --to 4,2,1 -o view.png

A map's URL is http://HOST:PORT/maps/NAME. A retract takes exactly the evidence of the named commits out again, on
the server and on every robot; everything else stays as it is. Results go to standard output, progress to standard
error; --json prints JSON for programs.
"""

import argparse
import json
import re
import time
from collections.abc import Iterator
from pathlib import Path

from cairn_calib.rig.rig import load_rig
from cairn_client.cli import hot_spots, layers, marks, publish
from cairn_client.cli.arguments import (
    Subparsers,
    add_map_parser,
    add_token,
    api_of,
    run_subcommand,
    say,
    seconds_of,
    shown_bytes,
    shown_length,
)
from cairn_client.cli.maps import (
    branch_table,
    changes,
    create,
    delete,
    map_export,
    map_log,
    query,
    render,
    robots,
    server_copy,
)
from cairn_client.folders.map_folder import layers_of
from cairn_client.http.api import MapApi
from cairn_client.sync.responses import one_line
from cairn_map.errors import BadInputError, NotFoundError
from cairn_map.wire.messages import MapSizes, Retract, Retracted
from cairn_map.wire.utc_times import with_utc

DIGEST = re.compile("[0-9a-f]{64}")
TIMES = ("pushed_after", "pushed_before", "captured_after", "captured_before")


def main(argv: list[str]) -> int:
    """Run one of the subcommands."""
    parts = (
        create.add_parser,
        server_copy.add_parser,
        _add_ls,
        _add_info,
        branch_table.add_parser,
        map_log.add_parser,
        changes.add_parser,
        map_export.add_get_parser,
        map_export.add_export_parser,
        hot_spots.add_parser,
        marks.add_list_parser,
        marks.add_parser,
        layers.add_parser,
        publish.add_parser,
        query.add_parser,
        render.add_parser,
        _add_retract,
        robots.add_parser,
        delete.add_parser,
        delete.add_rename,
    )
    return run_subcommand("cairn map", __doc__, parts, argv)


def _add_ls(commands: Subparsers) -> None:
    text = "list the maps of a server"
    listing = commands.add_parser("ls", help=text, description=text)
    listing.add_argument("server", help="http://HOST:PORT")
    add_token(listing)
    listing.add_argument("--json", action="store_true", help="print JSON")
    listing.set_defaults(run=_ls)


def _ls(args: argparse.Namespace) -> int:
    with MapApi(args.server, token=args.token.of(args.server)) as api:
        infos = api.maps()
    if args.json:
        say(json.dumps([info.model_dump(mode="json") for info in infos]))
        return 0
    say(f"{'map':<24} {'voxel':>8} {'cells':>6} {'size':>9} {'commits':>8} {'robots':>7}")
    for info in infos:
        voxel = shown_length(info.geometry.voxel_edge_m)
        size = shown_bytes(info.size_bytes)
        say(f"{info.name:<24} {voxel:>8} {info.cells:>6} {size:>9} {info.commits:>8} {info.branches:>7}")
    if not infos:
        say("(none yet; make one with `cairn map create SERVER/maps/NAME`)")
    return 0


def _add_info(commands: Subparsers) -> None:
    about = add_map_parser(commands, "info", _info, text="extent, sizes and robots of a map")
    about.add_argument("--json", action="store_true", help="print JSON")


def _info(args: argparse.Namespace) -> int:
    api, name = api_of(args.map, args.token)
    with api:
        info, branches, sizes = api.map_info(name), api.branches(name), _sizes(api, name)
    if args.json:
        more: dict[str, object] = {"branch_list": [with_utc(branch).model_dump(mode="json") for branch in branches]}
        more |= {"sizes": sizes.model_dump(mode="json")} if sizes else {}
        say(json.dumps({**info.model_dump(mode="json"), **more}))
        return 0
    create.say_map(info)
    size = shown_bytes(info.size_bytes)
    if info.epoch_s is not None:
        present, history = info.size_bytes - info.history_bytes, info.history_bytes
        size += f" ({shown_bytes(present)} of the present, {shown_bytes(history)} of history)"
    say(f"{info.cells} cells, {size}, {info.commits} commits; head {info.cursor}")
    if sizes is not None:
        kept, log = shown_bytes(sizes.evidence_bytes), shown_bytes(sizes.log_bytes)
        say(f"besides the cells {kept} of evidence that is kept, and about {log} of log ({sizes.log_entries} entries)")
    if info.box_m:
        low, high = ("  ".join(f"{value:.2f}" for value in corner) for corner in info.box_m)
        say(f"cells span ({low}) m to ({high}) m")
    for branch in branches:
        lag = "has not fetched all yet" if branch.behind is None else f"{branch.behind} log entries since it last asked"
        lag = "fetches whole cells" if branch.mode == "low-end" else lag
        seen_s, sensors = time.time() - branch.last_seen_s, one_line(", ".join(branch.sensors))
        say(f"  {branch.branch:<16} {branch.mode:<9} {lag}, seen {seen_s:.0f} s ago, {sensors}")
    return 0


def _sizes(api: MapApi, name: str) -> MapSizes | None:
    """Sizes of a map; None from a server of an earlier version."""
    try:
        return api.map_sizes(name)
    except NotFoundError as exc:
        if exc.kind != "no_route":
            raise
        return None


def _add_retract(commands: Subparsers) -> None:
    """Commits by id, and all that fit every other option."""
    retract = add_map_parser(commands, "retract", _retract, text="take commits out of a map again, exactly")
    retract.add_argument("--commit", action="append", metavar="ID", help="robot.incarnation.n, as `log` shows it")
    retract.add_argument("--robot", help="all that this robot pushed")
    retract.add_argument("--rig", metavar="RIG", help="all that was made with this rig: its rig.json, or its digest")
    for part in TIMES:
        what, side = part.split("_")
        when = f"all that was {what} {side} a time, UTC: 14:05, 2026-11-20T14:05"
        retract.add_argument(f"--{what}-{side}", metavar="TIME", help=when)
    retract.add_argument("--all-layers", action="store_true", help="in all layers of the map, not its first one alone")
    retract.add_argument("--dry-run", action="store_true", help="list the commits, and change nothing")
    retract.add_argument("--note", default="", help="the reason; kept in the log")


def _retract(args: argparse.Namespace) -> int:
    """Take commits out, or with --dry-run list those that it would be."""
    api, name = api_of(args.map, args.token)
    request = Retract(
        commits=args.commit or [],
        robot=args.robot,
        rig=rig_digest(args.rig) if args.rig is not None else None,
        note=args.note,
        preview=args.dry_run,
        **{f"{part}_s": seconds_of(getattr(args, part)) for part in TIMES},
    )
    with api:
        for layer, each in _retracts(api, name, request, all_layers=args.all_layers):
            where = f" of {layer}" if args.all_layers else ""
            if each.id is None:
                say(f"would take out {len(each.commits)} commits{where} (nothing was done):")
            else:
                say(f"{each.id} takes out {len(each.commits)} commits{where}:")
            for commit in each.commits:
                say(f"  {commit}")
    return 0


def _retracts(api: MapApi, name: str, request: Retract, *, all_layers: bool) -> Iterator[tuple[str, Retracted]]:
    """Retracts with the name of the map, or of each layer that has such commits, each as soon as it is done.

    Each layer is a log of its own, so a retract is one commit in each; after a failure the same command goes on.

    Raises:
        NotFoundError: kind `nothing_to_retract`: none has any.
        BadInputError: kind `bad_option`: commits of all layers are named by what they have in common, not one by one.
    """
    if not all_layers:
        yield name, api.retract(name, request)
        return
    if request.commits:
        raise BadInputError("bad_option", "--commit names a commit of one layer: give the layer's URL, MAP.LAYER")
    is_done, nothing = False, None
    for layer in layers_of(api, name).values():
        try:
            retracted = api.retract(layer, request)
        except NotFoundError as exc:
            if exc.kind != "nothing_to_retract":
                raise
            nothing = exc
        else:
            is_done = True
            yield layer, retracted
    if not is_done and nothing is not None:
        raise nothing


def rig_digest(text: str) -> str:
    """Digest of a rig, of itself or of a `rig.json`, however that is laid out.

    Raises:
        BadInputError: kind `bad_rig`: neither.
    """
    if DIGEST.fullmatch(text):
        return text
    if not Path(text).exists():
        raise BadInputError(
            "bad_rig",
            f"--rig takes a rig.json, or the 64 hex digits that commits state of it; {text!r} is neither",
        )
    return load_rig(text).digest()
