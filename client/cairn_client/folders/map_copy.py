"""A copy of a map in a folder, that a later pull brings up to date by what changed alone."""

import secrets
import shutil
from dataclasses import asdict, dataclass
from pathlib import Path

from cairn_client.folders.state_folder import is_copy, is_state_folder, opened_replica, url_of
from cairn_client.robot.robot import Robot
from cairn_map.errors import BadInputError, CairnError, ConflictError


@dataclass(frozen=True, slots=True)
class Pulled:
    """Result of a clone or a pull."""

    map_url: str
    folder: Path
    cells: int
    """Number of cells in the copy now."""
    voxels: int
    """Number of known voxels in the copy now."""
    changed_cells: int
    new_commits: int
    """Number of commits that the copy did not have before."""
    down_bytes: int
    cursor: str
    """Cursor of the server's state that the copy holds."""

    def as_json(self) -> dict[str, object]:
        """Its fields, for JSON."""
        return {**asdict(self), "folder": str(self.folder)}


def clone(map_url: str, folder: Path, *, token: str | None, name: str | None = None) -> Pulled:
    """Copy a map into a new folder. Cut off, it is finished by `pull`.

    Args:
        map_url: `http://HOST:PORT/maps/NAME`.
        folder: new, or empty.
        token: to register by, where the server wants one.
        name: name of this copy among the robots of the map; None: a random one.

    Raises:
        ConflictError: kind `copy_exists`: there is something in the folder.
        CairnError: the server cannot be reached, has no such map, or refuses.
    """
    if folder.exists() and any(folder.iterdir()):
        known = "; `cairn pull` brings it up to date" if is_state_folder(folder) else ""
        raise ConflictError("copy_exists", f"{folder} is not empty{known}")
    is_new = not folder.exists()
    try:
        return _pull(map_url, folder, token=token, name=name or f"copy-{secrets.token_hex(4)}")
    except CairnError:
        if not _can_be_pulled(folder):
            _remove(folder, is_new=is_new)
        raise


def _can_be_pulled(folder: Path) -> bool:
    """True if a copy knows its map, so that a pull finishes it."""
    try:
        with opened_replica(folder):
            return True
    except BadInputError:
        return False


def _remove(folder: Path, *, is_new: bool) -> None:
    """Remove what a clone left in a folder that was empty, and the folder if it was new."""
    for path in folder.iterdir() if folder.is_dir() else ():
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink()
    if is_new and folder.is_dir():
        folder.rmdir()


def pull(folder: Path, *, token: str | None = None) -> Pulled:
    """Bring a copy up to date.

    Raises:
        BadInputError: the folder is no copy.
        CairnError: the server cannot be reached, or refuses.
    """
    map_url = url_of(folder)
    with opened_replica(folder) as replica:
        name, is_robot = replica.author.robot, not is_copy(replica)
    if is_robot:
        raise BadInputError(
            "no_copy", f"{folder} is robot {name}'s folder; `cairn robot sync {folder}` brings it up to date"
        )
    return _pull(map_url, folder, token=token, name=name)


def _pull(map_url: str, folder: Path, *, token: str | None, name: str) -> Pulled:
    with Robot(None, map_url, directory=folder, name=name, token=token, mode="viewer", stay=True) as robot:
        replica = robot.replica
        before = replica.fingerprints()
        commits = len(replica.header.coverage) if replica.header else 0
        robot.sync()
        robot.sync()  # tells the server where this copy stands now
        after = replica.fingerprints()
        header, packed = replica.header, robot.map.packed()
        return Pulled(
            map_url=map_url,
            folder=folder,
            cells=len(packed),
            voxels=sum(len(evidence) for evidence in packed.values()),
            changed_cells=sum(before.get(key) != after.get(key) for key in before.keys() | after.keys()),
            new_commits=len(header.coverage) - commits if header else 0,
            down_bytes=robot.traffic.down_bytes,
            cursor=header.to if header else "",
        )
