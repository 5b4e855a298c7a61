"""What a robot's folder says of it, while the robot is at work and while it is not: its place, its link, what waits."""

from pathlib import Path

from pydantic import BaseModel, ConfigDict

from cairn_client.folders.sqlite_glance import Glance, KeptBytes, commit_bytes, glance
from cairn_client.replica.folder_lock import is_locked
from cairn_client.replica.replica_identity import MODE_KEY, URL_KEY
from cairn_client.robot.round_watch import CONTACT_KEY, Contact
from cairn_map.commits.commit import split_commit
from cairn_map.errors import DamagedDataError
from cairn_map.evidence.grid import Geometry
from cairn_map.wire.messages import Mode


class FolderStatus(BaseModel):
    """What `cairn robot status --json` prints; names are added, never changed."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    robot: str
    map: str
    url: str | None
    """`http://HOST:PORT/maps/NAME`; None: the folder was never opened by a robot that remembers it."""
    mode: Mode | None
    is_open: bool
    """Whether a robot works in the folder now."""
    incarnation: str
    voxel_edge_m: float
    cursor: str | None
    """The server's state that is here; None: nothing was fetched yet, or only a part."""
    cells: int
    """Held whole, as the server had them at `cursor` or later."""
    cells_bytes: int
    waiting: int
    """Commits that the server has not acknowledged."""
    waiting_bytes: int
    kept: int
    """Those, and the acknowledged ones that a restore of the server could still lose."""
    kept_bytes: int
    last_contact_s: float | None
    """End of the last whole round with the server, UTC, to ten seconds."""
    failing_since_s: float | None
    """First failure since then, UTC; None: there was none."""
    failure_kind: str
    failure: str
    """The last one, for people; empty if there was none."""
    disk_bytes: int


class QueuedCommit(BaseModel):
    """A commit whose bytes are in the folder."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    id: str
    captured_s: tuple[float, float] | None
    """First and last scan, UTC; None for a commit without scans, or one that the disk damaged."""
    cells: int
    size_bytes: int
    acknowledged: bool
    """The server has it; it is kept until no restore of the server can lose it."""
    is_damaged: bool
    note: str


class FolderQueue(BaseModel):
    """What `cairn robot queue --json` prints; names are added, never changed."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    robot: str
    map: str
    commits: list[QueuedCommit]
    """Oldest first."""


def folder_status(folder: Path) -> FolderStatus:
    """How the robot of a folder is doing; raises as `glance`."""
    seen = glance(folder)
    meta = seen.meta
    contact = Contact.model_validate_json(meta.get(CONTACT_KEY, "{}"))
    waiting = [commit for commit in seen.commits if not commit.is_acked]
    return FolderStatus(
        robot=_known(seen, "robot", folder),
        map=_known(seen, "map", folder),
        url=meta.get(URL_KEY),
        mode=meta.get(MODE_KEY),  # type: ignore[arg-type] # checked by the model
        is_open=is_locked(folder),
        incarnation=_known(seen, "incarnation", folder),
        voxel_edge_m=Geometry.model_validate_json(_known(seen, "geometry", folder)).voxel_edge_m,
        cursor=meta.get("default_cursor"),
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
    )


def folder_queue(folder: Path) -> FolderQueue:
    """The commits that are kept in a folder; raises as `glance`."""
    seen = glance(folder)
    return FolderQueue(
        robot=_known(seen, "robot", folder),
        map=_known(seen, "map", folder),
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


def _known(seen: Glance, key: str, folder: Path) -> str:
    """Raises: DamagedDataError: kind `damaged_store`: it is not there."""
    if key not in seen.meta:
        raise DamagedDataError("damaged_store", f"the robot's folder {folder} does not say its {key}")
    return seen.meta[key]
