"""Layer of a map that a robot's command maps into: `--layer NAME`, or `--assigned`, as operators have it.

    $ cairn robot replay shelf/ --map http://127.0.0.1:8750/maps/lab --name mole --layer fine

Each layer has a folder of its own. A robot's name is bound to one key on the map, in all its layers, so a new folder
for a layer gets the keys that vouch for the name in the robot's other folders next to it.
"""

import argparse
from contextlib import closing
from pathlib import Path

from cairn_client.cli.arguments import api_of
from cairn_client.folders.state_folder import is_state_folder
from cairn_client.http.map_url import layer_url, split_map_url
from cairn_client.replica.replica_state import ReplicaState
from cairn_client.replica.replica_store import ReplicaStore
from cairn_client.robot.layer_folders import lend_stored_keys
from cairn_map.commits.ids import map_of_layer, robot_name
from cairn_map.epochs.layer import EVIDENCE
from cairn_map.errors import BadInputError, ConflictError, NotFoundError


def add_layer_option(command: argparse.ArgumentParser) -> None:
    """Add `--layer` and `--assigned`, of which one at most is given."""
    choice = command.add_mutually_exclusive_group()
    choice.add_argument("--layer", metavar="NAME", help=f"map into this layer of the map ({EVIDENCE}, its first one)")
    choice.add_argument(
        "--assigned", action="store_true", help="map into the layer that operators assigned (`cairn map layer assign`)"
    )


def choose_layer(args: argparse.Namespace, name: str) -> None:
    """Set `args.map` to the URL of the layer, and `args.state`, unless it is given, to the robot's folder for it.

    Raises:
        BadInputError: kind `bad_option`: the URL is that of a layer already, or several layers are assigned.
        NotFoundError: kind `no_assignment`: no layer is.
        UnreachableError: the server cannot be asked which one is.
    """
    layer = _assigned_layer(args, name) if args.assigned else args.layer
    if args.state is None:
        args.state = Path(f"cairn-{name}" if layer in (None, EVIDENCE) else f"cairn-{name}.{layer}")
    if layer is not None:
        args.map = layer_url(args.map, layer)


def bring_keys(folder: Path, name: str, map_url: str) -> None:
    """Let a new folder sign with the keys that the robot's folders next to it have for other layers of the map."""
    if is_state_folder(folder):
        return
    asked = _whole(split_map_url(map_url)[1])
    for other in sorted(folder.absolute().parent.glob(f"cairn-{name}*")):
        if not is_state_folder(other):
            continue
        try:
            with closing(ReplicaStore(other)) as store:
                state = ReplicaState(store)
                if state.robot == name and state.map_name is not None and _whole(state.map_name) == asked:
                    lend_stored_keys(state, robot_name(name), folder)
                    return
        except ConflictError:  # that robot is at work; the server says if the keys are needed
            continue


def _assigned_layer(args: argparse.Namespace, name: str) -> str:
    api, map_name = api_of(args.map, args.token)
    with api:
        found = api.assignment(map_name, robot_name(name))
    if found is None:
        raise NotFoundError(
            "no_assignment",
            f"no layers of {map_name} are assigned to {name}: name one with --layer, or have an operator do it "
            f"(`cairn map layer assign {args.map} {name} --contributes {EVIDENCE}`)",
        )
    layers = [each.layer for each in found.contributes]
    if len(layers) > 1:
        raise BadInputError(
            "bad_option",
            f"{name} is to map into {', '.join(layers)}, and this command maps into one: name it with --layer, or "
            "write a program with cairn.LayeredRobot",
        )
    return layers[0]


def _whole(name: str) -> str:
    """Name of a map, by its own or by that of a layer."""
    return map_of_layer(name) or name
