"""Status of a robot as read from its folder, whether it is at work or not: its map, its last contact, what waits."""

from pathlib import Path
from typing import TypeVar

from pydantic import BaseModel, ConfigDict

from cairn_client.folders.sqlite_glance import Glance, KeptBytes, commit_bytes, glance
from cairn_client.replica.folder_lock import is_locked
from cairn_client.replica.limits import STANDARD_LIMITS
from cairn_client.replica.replica_state import Contact, Field, ReplicaState
from cairn_map.commits.commit import split_commit
from cairn_map.errors import DamagedDataError
from cairn_map.wire.messages import Mode

T = TypeVar("T")


class FolderStatus(BaseModel):
    """Status of a robot, as `cairn robot status --json` prints it; names are added, never changed."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    robot: str
    map: str
    url: str | None
    """`http://HOST:PORT/maps/NAME`; None: the folder was never opened by a robot that remembers it."""
    mode: Mode | None
    is_open: bool
    """True if a robot works in the folder now."""
    incarnation: str
    voxel_edge_m: float
    cursor: str | None
    """Cursor of the server's state that is here; None: nothing was fetched yet, or only a part."""
    cells: int
    """Number of cells that are held whole, as the server had them at `cursor` or later."""
    cells_bytes: int
    waiting: int
    """Number of commits that the server has not acknowledged."""
    waiting_bytes: int
    kept: int
    """Number of commits that wait, and of acknowledged ones that a restore of the server could still lose."""
    kept_bytes: int
    last_contact_s: float | None
    """End of the last whole round with the server, UTC, to ten seconds."""
    failing_since_s: float | None
    """Time of the first failure since the last whole round, UTC; None: there was none."""
    failure_kind: str
    failure: str
    """Message of the last failure since the last whole round; empty if there was none."""
    disk_bytes: int
    memory_bytes_max: int | None
    """Memory that its map may take, bytes; None: all."""


class QueuedCommit(BaseModel):
    """A commit whose bytes are in the folder."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    id: str
    captured_s: tuple[float, float] | None
    """Times of the first and the last scan, UTC; None for a commit without scans, or one that the disk damaged."""
    cells: int
    size_bytes: int
    acknowledged: bool
    """True if the server has the commit; it is kept until no restore of the server can lose it."""
    is_damaged: bool
    note: str


class FolderQueue(BaseModel):
    """Commits in a robot's folder, as `cairn robot queue --json` prints them; names are added, never changed."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    robot: str
    map: str
    commits: list[QueuedCommit]
    """Commits whose bytes are kept, oldest first."""


def folder_status(folder: Path) -> FolderStatus:
    """Status of the robot of a folder; raises as `glance`."""
    seen = glance(folder)
    text = seen.meta.get
    contact = ReplicaState.contact.read(text, seen.file) or Contact()
    waiting = [commit for commit in seen.commits if not commit.is_acked]
    return FolderStatus(
        robot=_known(seen, ReplicaState.robot, folder),
        map=_known(seen, ReplicaState.map_name, folder),
        url=ReplicaState.url.read(text, seen.file),
        mode=ReplicaState.mode.read(text, seen.file),
        is_open=is_locked(folder),
        incarnation=_known(seen, ReplicaState.incarnation, folder),
        voxel_edge_m=_known(seen, ReplicaState.geometry, folder).voxel_edge_m,
        cursor=text(ReplicaState.default_cursor.key),
        cells=seen.cells,
        cells_bytes=seen.cells_bytes,
        waiting=len(waiting),
        waiting_bytes=sum(commit.size_bytes for commit in waiting),
        kept=len(seen.commits),
        kept_bytes=sum(commit.size_bytes for commit in seen.commits),
        last_contact_s=contact.last_s,
        failing_since_s=contact.failed_s,
        failure_kind=contact.kind,
        failure=contact.reason,
        disk_bytes=seen.disk_bytes,
        memory_bytes_max=(ReplicaState.limits.read(text, seen.file) or STANDARD_LIMITS).map_bytes_max,
    )


def folder_queue(folder: Path) -> FolderQueue:
    """The commits that are kept in a folder; raises as `glance`."""
    seen = glance(folder)
    return FolderQueue(
        robot=_known(seen, ReplicaState.robot, folder),
        map=_known(seen, ReplicaState.map_name, folder),
        commits=[_queued(folder, commit) for commit in seen.commits],
    )


def _queued(folder: Path, commit: KeptBytes) -> QueuedCommit:
    meta = None
    try:
        data = commit_bytes(folder, commit.id)
        meta = split_commit(data)[0] if data else None
        is_damaged = False
    except DamagedDataError:
        is_damaged = True
    return QueuedCommit(
        id=str(commit.id),
        captured_s=meta.captured_s if meta else None,
        cells=commit.cells,
        size_bytes=commit.size_bytes,
        acknowledged=commit.is_acked,
        is_damaged=is_damaged,
        note=meta.note if meta else "",
    )


def _known(seen: Glance, field: Field[T], folder: Path) -> T:
    """A value that every robot's folder remembers.

    Raises:
        DamagedDataError: kind `damaged_store`: it is not there.
    """
    value = field.read(seen.meta.get, seen.file)
    if value is None:
        raise DamagedDataError("damaged_store", f"the robot's folder {folder} does not say its {field.key}")
    return value
