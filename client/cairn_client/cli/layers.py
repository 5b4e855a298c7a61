"""Layers of a map: the same site at several resolutions, for robots that see it from far and from near.

    $ cairn map layer add http://127.0.0.1:8750/maps/lab fine --voxel 0.01
    layer fine of map lab: voxels of 1 cm, cells of 1.28 m, channels colour, intensity, temperature, epochs of 120 s
    robots map into it at http://127.0.0.1:8750/maps/lab.fine
    $ cairn map layer list http://127.0.0.1:8750/maps/lab
    layer                    voxel     cell  cells      size  URL
    evidence                  4 cm   5.12 m     56   12.4 MB  http://127.0.0.1:8750/maps/lab
    fine                      1 cm   1.28 m      0       0 B  http://127.0.0.1:8750/maps/lab.fine
    $ cairn map layer add http://127.0.0.1:8750/maps/lab ground --kind level
    layer ground of map lab: voxels of 20 cm and 5 cm height, cells of 12.8 m, channels height, epochs of 120 s
    robots map into it at http://127.0.0.1:8750/maps/lab.ground
    $ cairn map layer add http://127.0.0.1:8750/maps/lab things --voxel 0.05 --classes wall,floor,chair
    layer things of map lab: voxels of 5 cm, cells of 3.2 m, channels classes, epochs of 120 s
    classes wall, floor, chair, other
    $ cairn map layer assign http://127.0.0.1:8750/maps/lab mole --contributes evidence,fine --inside fine=0,0,0,4,3,2
    mole maps into evidence, fine in a box
    $ cairn map layer assigned http://127.0.0.1:8750/maps/lab
    mole maps into evidence, fine in a box

A map begins with one layer, `evidence`, and has at most 16. Each is pushed to, fetched, queried, drawn and exported
under its own URL, by every command that takes a map's: MAP.LAYER. Robots' names, tokens, marks and the sensor model are
those of the map. A layer of the kind level is the ground outdoors: each scan votes for the heights of surfaces, and
`cairn map query MAP.LAYER elevation` reads them, with slopes, steps and what is in the way. A definition is a commit:
relays carry it, and it never changes; another definition under the same name is refused (`other_layer`), also on a
server that is joined later. It takes an operator's token to add one.

`assign` says which layers a robot maps into, everywhere or where its head is inside or outside of a box, and which
others it fetches. A robot that leaves it to operators (`cairn.LayeredRobot` without `contributes`) asks for it as often
as it does rounds, `cairn robot run --assigned` when it starts, for one layer everywhere; --none leaves it to the
robot's own program again. It is kept by this server alone.

A layer with --classes counts what label images show (RECORDING.md; `labels` of a scan): names of at most 63 classes,
by commas or one a line in a file, to which `other` is added. They are fixed with the layer: more are another layer.
"""

import argparse
import json
import re
from pathlib import Path

from pydantic import ValidationError

from cairn_client.cli.arguments import (
    EPOCH_HELP,
    NO_EPOCHS,
    Subparsers,
    add_map_parser,
    api_of,
    channels_from_text,
    epoch_s_from_text,
    say,
    shown_bytes,
    shown_length,
)
from cairn_map.epochs.layer import EVIDENCE
from cairn_map.errors import BadInputError, first_error
from cairn_map.evidence.channels import Channel, classes_channel
from cairn_map.evidence.grid import LEVEL_EDGE_M, LEVEL_STEP_M, Geometry, geometry_for, level_geometry
from cairn_map.wire.layer_messages import AddLayer, Assignment, LayerInfo

LEVEL = "level"
"""Kind of a layer whose voxels are flat, as `--kind` names it."""
CLASSES_TEXT_MAX = 1 << 16
"""Characters of a file of classes that are read."""
CLASS_NAMES = re.compile(r"[a-z0-9_,]+")


def add_parser(commands: Subparsers) -> None:
    """Add the subcommand, and its own."""
    text = "add layers of other resolutions to a map, and list them"
    parts = commands.add_parser("layer", help=text, description=__doc__).add_subparsers(
        required=True, metavar="COMMAND"
    )
    _add_add(parts)
    _add_list(parts)
    _add_assign(parts)
    _add_assigned(parts)


def _add_add(commands: Subparsers) -> None:
    add = add_map_parser(commands, "add", _add, text="add a layer to a map; takes an operator's token")
    add.add_argument("name", help="its name: a letter, then a-z, 0-9 and _, at most 32")
    add.add_argument("--kind", choices=(EVIDENCE, LEVEL), default=EVIDENCE, help="level: heights of surfaces alone")
    add.add_argument(
        "--voxel", type=float, metavar="METRES", help=f"voxel edge, 0.001 to 1; needed but for a level ({LEVEL_EDGE_M})"
    )
    add.add_argument("--height-step", type=float, metavar="METRES", help=f"height of a level's voxels ({LEVEL_STEP_M})")
    add.add_argument("--channels", help="colour,intensity,temperature, scalars as NAME:UNIT:STEP (those of the map)")
    add.add_argument("--classes", metavar="NAMES|FILE", help="names of classes that label images show, at most 63")
    add.add_argument("--epoch", metavar=f"SECONDS|{NO_EPOCHS}", help=f"{EPOCH_HELP} (that of the map)")
    add.add_argument("--json", action="store_true", help="print JSON")


def _add_list(commands: Subparsers) -> None:
    listing = add_map_parser(commands, "list", _list, text="list the layers of a map")
    listing.add_argument("--json", action="store_true", help="print JSON")


def _add_assign(commands: Subparsers) -> None:
    assign = add_map_parser(commands, "assign", _assign, text="assign layers to a robot; takes an operator's token")
    assign.add_argument("robot", help="its name, registered or not")
    assign.add_argument("--contributes", metavar="LAYER,...", help="layers that it maps into, and keeps")
    assign.add_argument("--fetches", metavar="LAYER,...", default="", help="other layers that it keeps to read")
    for side in ("inside", "outside"):
        assign.add_argument(
            f"--{side}",
            action="append",
            default=[],
            metavar="LAYER=X0,Y0,Z0,X1,Y1,Z1",
            help=f"map into this layer only where its head is {side} this box, metres; once for each layer",
        )
    assign.add_argument("--none", action="store_true", help="leave its layers to its own program again")


def _add_assigned(commands: Subparsers) -> None:
    assigned = add_map_parser(commands, "assigned", _assigned, text="list the layers that are assigned to robots")
    assigned.add_argument("--json", action="store_true", help="print JSON")


def _assign(args: argparse.Namespace) -> int:
    if args.none == (args.contributes is not None):
        raise BadInputError("bad_option", "say --contributes LAYER,... or, to take it back, --none")
    if args.none and (args.fetches or args.inside or args.outside):
        raise BadInputError("bad_option", "--none takes all back: it goes with no --fetches, --inside or --outside")
    assignment = None if args.none else _assignment(args)
    api, name = api_of(args.map, args.token)
    with api:
        if assignment is None:
            api.unassign(name, args.robot)
            say(f"{args.robot} maps as its own program says")
        else:
            api.assign(name, args.robot, assignment)
            say(f"{args.robot} maps into {assignment.summary}")
    return 0


def _assignment(args: argparse.Namespace) -> Assignment:
    """The options as an assignment.

    Raises:
        BadInputError: kind `bad_layer`: it cannot be; `bad_option`: a box of a layer that the robot does not map into,
            or a second one.
    """
    names = args.contributes.split(",")
    mapped: dict[str, dict[str, object]] = {name: {"layer": name} for name in names}
    if len(mapped) != len(names):
        raise BadInputError("bad_layer", f"--contributes names a layer once, got {args.contributes!r}")
    for side in ("inside", "outside"):
        for text in getattr(args, side):
            layer, _, corners = text.partition("=")
            numbers = corners.split(",")
            if layer not in mapped or len(numbers) != 6:
                raise BadInputError(
                    "bad_option", f"--{side} takes LAYER=X0,Y0,Z0,X1,Y1,Z1 of a layer in --contributes, got {text!r}"
                )
            if f"{side}_m" in mapped[layer]:
                raise BadInputError("bad_option", f"--{side} names one box of a layer, got a second one of {layer}")
            mapped[layer][f"{side}_m"] = [numbers[:3], numbers[3:]]
    try:
        return Assignment.model_validate(
            {"contributes": list(mapped.values()), "fetches": [name for name in args.fetches.split(",") if name]}
        )
    except ValidationError as exc:
        raise BadInputError("bad_layer", f"the layers cannot be assigned: {first_error(exc)}") from exc


def _assigned(args: argparse.Namespace) -> int:
    api, name = api_of(args.map, args.token)
    with api:
        found = api.assignments(name)
    if args.json:
        say(json.dumps([each.model_dump(mode="json", exclude_none=True) for each in found]))
        return 0
    for each in found:
        say(f"{each.robot} maps into {each.assignment.summary}")
    if not found:
        say("(none: every robot maps as its own program says)")
    return 0


def _add(args: argparse.Namespace) -> int:
    api, name = api_of(args.map, args.token)
    with api:
        info = api.map_info(name)
        geometry = _level_geometry(args) if args.kind == LEVEL else _cubes(args, info.geometry)
        epoch_s = epoch_s_from_text(args.epoch, otherwise=info.epoch_s)
        try:
            request = AddLayer(name=args.name, geometry=geometry, epoch_s=epoch_s)
        except ValidationError as exc:
            raise BadInputError("bad_layer", f"the layer cannot be: {first_error(exc)}") from exc
        added = api.add_layer(name, request)
    if args.json:
        say(added.model_dump_json())
        return 0
    layer = added.layer
    names = ", ".join(channel.name for channel in layer.geometry.channels) or "none but occupancy"
    epochs = "" if layer.epoch_s is None else f", epochs of {layer.epoch_s} s"
    say(
        f"layer {layer.name} of map {name}: voxels of {_voxel(layer.geometry)}, "
        f"cells of {layer.geometry.cell_edge_m:g} m, channels {names}{epochs}"
    )
    for channel in layer.geometry.channels:
        if channel.classes:
            say(f"classes {', '.join(channel.classes)}")
    say(f"robots map into it at {_url(args.map, name, layer)}")
    return 0


def _cubes(args: argparse.Namespace, of_map: Geometry) -> Geometry:
    if args.height_step is not None or args.voxel is None:
        raise BadInputError("bad_option", "a layer needs --voxel METRES; --height-step goes with --kind level")
    channels = of_map.channels if args.channels is None else channels_from_text(args.channels)
    if args.classes is not None:
        channels = (*(channels if args.channels else ()), classes_from_text(args.classes))
    return geometry_for(voxel_edge_m=args.voxel, channels=channels)


def _level_geometry(args: argparse.Namespace) -> Geometry:
    if args.channels is not None or args.classes is not None:
        raise BadInputError("bad_option", "a level has one channel, the height; leave out --channels and --classes")
    edge_m = LEVEL_EDGE_M if args.voxel is None else args.voxel
    step_m = LEVEL_STEP_M if args.height_step is None else args.height_step
    return level_geometry(voxel_edge_m=edge_m, height_step_m=step_m)


def _voxel(geometry: Geometry) -> str:
    """Such as `1 cm`, or `20 cm and 5 cm height`."""
    edge = shown_length(geometry.voxel_edge_m)
    return f"{edge} and {shown_length(geometry.voxel_height_m)} height" if geometry.is_flat else edge


def _list(args: argparse.Namespace) -> int:
    api, name = api_of(args.map, args.token)
    with api:
        layers = api.layers(name)
    if args.json:
        say(json.dumps([layer.model_dump(mode="json") for layer in layers]))
        return 0
    say(f"{'layer':<20} {'voxel':>9} {'cell':>8} {'cells':>6} {'size':>9}  URL")
    for layer in layers:
        edge, size = shown_length(layer.geometry.voxel_edge_m), shown_bytes(layer.size_bytes)
        voxel = f"{edge} flat" if layer.geometry.is_flat else edge
        cell = f"{layer.geometry.cell_edge_m:g} m"
        url = _url(args.map, name, layer)
        say(f"{layer.name:<20} {voxel:>9} {cell:>8} {layer.cells:>6} {size:>9}  {url}")
    return 0


def classes_from_text(text: str) -> Channel:
    """Channel of classes of a text such as `wall,floor`, or of a file with one name a line, `#` before comments.

    Raises:
        BadInputError: kind `bad_classes`: the names cannot be, or the file cannot be read.
    """
    path = Path(text)
    if CLASS_NAMES.fullmatch(text) and not path.is_file():
        return classes_channel(tuple(text.split(",")))
    try:
        with path.open(encoding="utf-8") as file:
            listed = file.read(CLASSES_TEXT_MAX)
    except (OSError, ValueError) as exc:
        raise BadInputError(
            "bad_classes",
            f"classes are names by commas (a letter, then a-z, 0-9, _), or a file of them; got {text!r}",
        ) from exc
    names = [line.strip() for line in listed.splitlines()]
    return classes_channel(tuple(name for name in names if name and not name.startswith("#")))


def _url(map_url: str, name: str, layer: LayerInfo) -> str:
    return map_url.rstrip("/").removesuffix(name) + layer.map
