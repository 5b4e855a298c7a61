"""A robot's folder, or a copy's, looked at from outside: whose it is, and the map as it stands in it."""

from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from cairn_client.replica.replica import Replica
from cairn_client.replica.replica_identity import MODE_KEY, URL_KEY
from cairn_client.replica.replica_store import FILE_NAME, ReplicaStore
from cairn_map.commits.ids import robot_name
from cairn_map.errors import BadInputError
from cairn_map.evidence.grid import Geometry


def is_state_folder(folder: Path) -> bool:
    """Whether a robot or a copy keeps its map there."""
    return (folder / FILE_NAME).is_file()


def robot_of(folder: Path) -> str | None:
    """Whose folder it is; None: nobody's yet. Raises: ConflictError: a robot has it open."""
    if not is_state_folder(folder):
        return None
    with closing(ReplicaStore(folder)) as store:
        return store.get("robot")


@contextmanager
def opened_replica(folder: Path) -> Iterator[Replica]:
    """The map in a folder that exists, under the name that it has.

    Raises:
        BadInputError: kind `no_state_folder`: nobody's.
        ConflictError: a robot has it open.
        DamagedDataError: it is broken.
    """
    if not is_state_folder(folder):
        raise BadInputError("no_state_folder", f"{folder} is no robot's folder and no copy: there is no {FILE_NAME}")
    with closing(ReplicaStore(folder)) as store:
        robot, map_name, geometry = (store.get(key) for key in ("robot", "map", "geometry"))
        if robot is None or map_name is None or geometry is None:
            raise BadInputError("no_state_folder", f"{folder} was never used; begin with `cairn clone URL {folder}`")
        yield Replica(
            store,
            robot=robot_name(robot),
            map_name=map_name,
            geometry=Geometry.model_validate_json(geometry),
        )


def url_of(folder: Path) -> str:
    """The URL of the map that a folder is from.

    Raises:
        BadInputError: no state folder, or one that was never opened since it remembers.
    """
    with opened_replica(folder) as replica:
        url = replica.store.get(URL_KEY)
    if url is None:
        raise BadInputError("no_url", f"{folder} does not say which server its map is on; name its URL")
    return url


def is_copy(replica: Replica) -> bool:
    """Whether it is nobody's but a viewer's: it makes no commits."""
    return replica.store.get(MODE_KEY) == "viewer"
