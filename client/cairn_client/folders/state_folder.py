"""State folder of a robot, or of a copy, opened by another program: its owner, and the map in it."""

from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from cairn_client.replica.replica import Replica
from cairn_client.replica.replica_state import ReplicaState
from cairn_client.replica.replica_store import FILE_NAME, ReplicaStore
from cairn_map.commits.ids import robot_name
from cairn_map.epochs.layer import MapLayer
from cairn_map.errors import BadInputError


def is_state_folder(folder: Path) -> bool:
    """True if a robot or a copy keeps its map in a folder."""
    return (folder / FILE_NAME).is_file()


def check_state_folder(folder: Path) -> None:
    """Check that a robot or a copy keeps its map in a folder.

    Raises:
        BadInputError: kind `no_state_folder`: neither does.
    """
    if not is_state_folder(folder):
        raise BadInputError("no_state_folder", f"{folder} is no robot's folder and no copy: there is no {FILE_NAME}")


def robot_of(folder: Path) -> str | None:
    """Name of the robot whose folder it is; None: no robot's yet. Raises: ConflictError: a robot has it open."""
    if not is_state_folder(folder):
        return None
    with closing(ReplicaStore(folder)) as store:
        return ReplicaState(store).robot


def layer_of(folder: Path) -> MapLayer | None:
    """Layer that a folder's map has; None: no map yet. Raises: ConflictError: a robot has it open."""
    if not is_state_folder(folder):
        return None
    with closing(ReplicaStore(folder)) as store:
        return ReplicaState(store).layer


def layer_folders(folder: Path) -> list[Path]:
    """A robot's folder, or those of the layers that a `LayeredRobot` of a folder maps into, by name.

    Raises:
        BadInputError: kind `no_state_folder`: it is neither.
        ConflictError: a robot has one open.
    """
    if is_state_folder(folder):
        return [folder]
    found = []
    for each in sorted(folder.iterdir() if folder.is_dir() else ()):
        if is_state_folder(each):
            with closing(ReplicaStore(each)) as store:
                if ReplicaState(store).mode != "viewer":
                    found.append(each)
    if not found:
        check_state_folder(folder)
    return found


@contextmanager
def opened_replica(folder: Path) -> Iterator[Replica]:
    """The map in a folder that exists, under the name that it has.

    Raises:
        BadInputError: kind `no_state_folder`: no robot keeps its map there.
        ConflictError: a robot has it open.
        DamagedDataError: it is broken.
    """
    check_state_folder(folder)
    with closing(ReplicaStore(folder)) as store:
        state = ReplicaState(store)
        robot, map_name, layer = state.robot, state.map_name, state.layer
        if robot is None or map_name is None or layer is None:
            raise BadInputError("no_state_folder", f"{folder} was never used; begin with `cairn clone URL {folder}`")
        grid, epoch_s = layer.geometry, layer.epoch_s
        yield Replica(store, robot=robot_name(robot), map_name=map_name, geometry=grid, epoch_s=epoch_s)


def url_of(folder: Path) -> str:
    """The URL of the map that a folder is from.

    Raises:
        BadInputError: no state folder, or one that was never opened since it remembers.
    """
    with opened_replica(folder) as replica:
        url = replica.state.url
    if url is None:
        raise BadInputError("no_url", f"{folder} does not say which server its map is on; name its URL")
    return url


def is_copy(replica: Replica) -> bool:
    """True if it is a viewer's copy of a map: it makes no commits."""
    return replica.state.mode == "viewer"
