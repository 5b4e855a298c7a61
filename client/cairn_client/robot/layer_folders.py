"""Folders of one robot's layers: the keys and tokens that each has for the others.

    state/evidence/     a robot's folder (`Robot`) for each layer
    state/fine/

A robot's name is bound to one key on the map, in all its layers, so a new folder is lent those that vouch for it. A
token of the map counts on all layers, one of a layer on that layer alone.
"""

import logging
from collections.abc import Collection, Iterator, Mapping
from contextlib import closing
from pathlib import Path

from cairn_client.http.map_url import layer_url, split_map_url
from cairn_client.replica.replica import Replica
from cairn_client.replica.replica_state import ReplicaState, RobotKeys
from cairn_client.replica.replica_store import FILE_NAME, ReplicaStore
from cairn_client.robot.membership import own_token
from cairn_client.robot.robot import Robot
from cairn_map.commits.ids import RobotName
from cairn_map.epochs.layer import EVIDENCE
from cairn_map.errors import BadInputError, ConflictError, DamagedDataError

log = logging.getLogger(__name__)


class LayerFolders:
    """Folders of a robot's layers on a map."""

    def __init__(self, folder: Path, robot: RobotName, map_url: str) -> None:
        """`folder` has one below it for each layer; `map_url` is the map's."""
        self._folder = folder
        self._robot = robot
        self._map_url = map_url

    def name_of(self, layer: str) -> str:
        """Name under which a layer is asked for: MAP, or MAP.LAYER."""
        return split_map_url(layer_url(self._map_url, layer))[1]

    def tokens(self, *, opened: Collection[str]) -> list[tuple[str, str]]:
        """The robot's own tokens by layer, that of the map first, of all layers but those that are open."""
        found = [(layer, own_token(state, self._map_url)) for layer, state in self._closed(opened)]
        return sorted(
            ((layer, token) for layer, token in found if token is not None), key=lambda each: each[0] != EVIDENCE
        )

    def lend_to(self, layer: str, robots: Mapping[str, Robot]) -> None:
        """Let a layer's folder sign with the keys of the layers that are open; a new one also with those of others.

        Raises:
            BadInputError: kind `other_replica`: the folder is another robot's.
            CairnError: a folder cannot be opened.
        """
        folder = self._folder / layer
        if not (folder / FILE_NAME).is_file():
            for _, state in self._closed(robots):
                lend_stored_keys(state, self._robot, folder)
        for robot in robots.values():
            lend_keys(robot.replica, folder)

    def _closed(self, opened: Collection[str]) -> Iterator[tuple[str, ReplicaState]]:
        """States of the folders of this robot and map that are not open, neither here nor elsewhere, by layer."""
        for path in sorted(self._folder.glob(f"*/{FILE_NAME}")):
            layer = path.parent.name
            if layer in opened:
                continue
            try:
                store = ReplicaStore(path.parent)
            except ConflictError:  # another program of this robot is at work in it
                continue
            except DamagedDataError as exc:
                log.warning("layer %s lends nothing: %s", layer, exc.message)
                continue
            with closing(store):
                state = ReplicaState(store)
                if state.robot == self._robot and state.map_name == self.name_of(layer):
                    yield layer, state


def lend_keys(replica: Replica, folder: Path) -> None:
    """Let another folder of an open robot, which is not open itself, sign with the keys that vouch for its name.

    Raises:
        BadInputError: the folder is another robot's.
        CairnError: it cannot be opened.
    """
    lend_stored_keys(replica.state, replica.author.robot, folder)


def lend_stored_keys(state: ReplicaState, robot: RobotName, folder: Path) -> None:
    """Let another folder of a robot, which is not open, sign with the keys that vouch for its name in this state.

    Raises:
        BadInputError: the folder is another robot's.
        CairnError: it cannot be opened.
    """
    with closing(ReplicaStore(folder)) as store:
        other = ReplicaState(store)
        if other.robot not in (None, robot):
            raise BadInputError("other_replica", f"{folder} belongs to robot {other.robot}, not to {robot}")
        RobotKeys(other, robot).borrow(RobotKeys(state, robot).vouching())
