"""Layer of a map that a robot's command maps into: `--layer NAME`, or `--assigned`, as operators have it.

    $ cairn robot replay shelf/ --map http://127.0.0.1:8750/maps/lab --name mole --layer fine

--assigned takes what operators assigned if it is one layer, everywhere; without a link it is the layer of the robot's
folder, if it has one folder. Each layer has a folder of its own. A robot's name is bound to one key on the map, in all
its layers, so a new folder for a layer gets the keys that vouch for the name in the robot's other folders next to it.
"""

import argparse
import logging
from collections.abc import Iterable, Iterator
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
from cairn_map.errors import BadInputError, ConflictError, NotFoundError, UnreachableError

log = logging.getLogger(__name__)


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
        BadInputError: kind `bad_option`: the URL is that of a layer already; or what is assigned is more than one
            layer everywhere, which such a command cannot do.
        NotFoundError: kind `no_assignment`: no layer is.
        UnreachableError: the server cannot be asked which one is, and no folder says it, or several do.
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
    for state in _states(folder.absolute().parent.glob(f"cairn-{name}*"), name, map_url):
        lend_stored_keys(state, robot_name(name), folder)
        return


def _states(folders: Iterable[Path], name: str, map_url: str) -> Iterator[ReplicaState]:
    """States of a robot's folders, of those that are of the map of a URL and in which no robot is at work."""
    asked = _whole(split_map_url(map_url)[1])
    for folder in sorted(folders):
        if not is_state_folder(folder):
            continue
        try:
            store = ReplicaStore(folder)
        except ConflictError:
            continue
        with closing(store):
            state = ReplicaState(store)
            if state.robot == name and state.map_name is not None and _whole(state.map_name) == asked:
                yield state


def _assigned_layer(args: argparse.Namespace, name: str) -> str:
    api, map_name = api_of(args.map, args.token)
    with api:
        try:
            found = api.assignment(map_name, robot_name(name))
        except UnreachableError as exc:
            return _known_layer(args, name, exc)
    if found is None:
        raise NotFoundError(
            "no_assignment",
            f"no layers of {map_name} are assigned to {name}: name one with --layer, or have an operator do it "
            f"(`cairn map layer assign {args.map} {name} --contributes {EVIDENCE}`)",
        )
    (mapped, *others), fetches = found.contributes, found.fetches
    if others or fetches or mapped.inside_m is not None or mapped.outside_m is not None:
        raise BadInputError(
            "bad_option",
            f"what is assigned to {name} ({found.summary}) is not one layer everywhere, into which this command maps: "
            "name one with --layer, or write a program with cairn.LayeredRobot",
        )
    return mapped.layer


def _known_layer(args: argparse.Namespace, name: str, cause: UnreachableError) -> str:
    """Layer of the robot's folder, where there is one.

    Raises:
        UnreachableError: the cause: there is none, or there are several.
    """
    folders = Path().glob(f"cairn-{name}*") if args.state is None else [args.state]
    layers = [str(state.map_name).partition(".")[2] or EVIDENCE for state in _states(folders, name, args.map)]
    if len(layers) != 1:
        raise UnreachableError(
            cause.kind,
            f"{cause.message}; which layer is assigned is unknown, and {len(layers)} folders of {name} are here: name "
            "it with --layer",
        ) from cause
    log.warning("the assigned layer is unknown now, the robot's folder has layer %s: %s", layers[0], cause.message)
    return layers[0]


def _whole(name: str) -> str:
    """Name of a map, by its own or by that of a layer."""
    return map_of_layer(name) or name
