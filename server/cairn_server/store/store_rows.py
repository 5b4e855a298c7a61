"""What a store holds, as rows: maps, commits, cells, the log, branches."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

from cairn_map.commits.cursor import Cursor
from cairn_map.commits.ids import Author, CommitId
from cairn_map.commits.version_vector import EMPTY, VersionVector
from cairn_map.evidence.fingerprint import Fingerprint
from cairn_map.evidence.grid import CellKey, Geometry
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_map.wire.access_messages import RoleText

Robot = tuple[int, str]
"""Number of the map, and the robot's name, or `relay_of` a token."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MapRow:
    """A map as created; never changes."""

    number: int
    name: str
    geometry: Geometry
    sensor_model: SensorModel
    seal_key: bytes = field(default=b"", repr=False)
    """By which the server knows again the retracts that it made."""


@dataclass(frozen=True, slots=True, kw_only=True)
class NewCommit:
    """A validated commit on its way into the store."""

    id: CommitId
    sha: bytes
    size_bytes: int
    text: bytes
    """Its meta as it was pushed: the SHA-256 is over these bytes."""
    captured_s: tuple[float, float] | None
    retracts: tuple[CommitId, ...]
    diff: Mapping[CellKey, bytes]
    tops: tuple[int, ...]
    """Largest number of each plane; their sums over all commits bound every sum in the map."""
    rig: bytes | None = None
    """SHA-256 of the rig that its sensors were described by."""
    signatures: str | None = None
    """Of whom it speaks for, checked; as in `Cairn-Signature`."""
    via: str | None = None
    """Name of the token of the relay that handed it over."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StoredCommit:
    """A commit as the folder reads it."""

    number: int
    id: CommitId
    sha: bytes
    text: bytes
    retracts: tuple[CommitId, ...]
    diff: Mapping[CellKey, bytes]
    """Empty if it is gone, too."""
    gone: bool = False
    """Its evidence and its meta are not kept any more."""
    signatures: str | None = None


@dataclass(frozen=True, slots=True)
class Contribution:
    """What one log entry did to one cell."""

    seq: int
    kind: bytes
    author: Author
    diff: int
    """Number of the diff in the store."""
    size_bytes: int


@dataclass(frozen=True, slots=True, kw_only=True)
class CellRow:
    """A cell of the folded map."""

    key: CellKey
    lm: int
    """Log entry that last changed it."""
    digest: bytes
    fingerprint: Fingerprint
    voxels: int
    body: bytes
    """Empty where a listing did not ask for it."""
    size_bytes: int
    stamps: bytes = b""
    """Of `stamps`; empty where a listing did not ask for them."""
    gone_seq: int = 0
    """The newest log entry of which the evidence is not kept any more; a fold does not change it."""
    hottest_k: float | None = None
    """`cell_order.hottest_k`; None, too, of a cell that did not change since it is stored."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Entry:
    """One entry of the log: a commit folded (`+`) or taken out (`-`)."""

    kind: bytes
    commit: int
    """Number of the commit in the store."""
    chain: bytes


@dataclass(frozen=True, slots=True, kw_only=True)
class Fold:
    """What one fold changes, made from the state at `base`."""

    base: Cursor
    head: Cursor
    vector: VersionVector
    entries: tuple[Entry, ...]
    cells: tuple[CellRow, ...]
    retracted: tuple[CommitId, ...] = ()
    """Ids whose retract took or will take effect; each once, for ever."""
    damaged: tuple[tuple[int, str], ...] = ()
    """Numbers of commits to set aside, and why: pushed again, they are pending again."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Selection:
    """Which commits with evidence an operator means: all that fit every part that is not None."""

    robot: str | None = None
    rig: bytes | None = None
    pushed_s: tuple[float, float] = (-math.inf, math.inf)
    """When the server received it, UTC seconds since 1970."""
    captured_s: tuple[float, float] = (-math.inf, math.inf)
    """Some scan of it was taken then; commits that state no time only fit the default."""


@dataclass(frozen=True, slots=True)
class Branch:
    """A registered robot."""

    name: str
    mode: str
    sensors: tuple[str, ...]
    cursor: Cursor | None
    last_seen_s: float
    incarnation: str = ""
    """With which it registered last; empty in stores of old."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Totals:
    """Sizes of a map."""

    cells: int = 0
    size_bytes: int = 0
    commits: int = 0
    branches: int = 0
    corner_cells: tuple[tuple[int, int, int], tuple[int, int, int]] | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Head:
    """The newest folded state."""

    cursor: Cursor
    vector: VersionVector = field(default=EMPTY)


class EntrySize(NamedTuple):
    """What one log entry weighs."""

    seq: int
    author: Author | None
    """Whose evidence came; None: some was taken out, which is news to its author, too."""
    size_bytes: int


@dataclass(frozen=True, slots=True)
class Use:
    """What a robot's commits took."""

    size_bytes: int = 0
    cells: int = 0

    def __add__(self, more: "Use") -> "Use":
        return Use(self.size_bytes + more.size_bytes, self.cells + more.cells)

    def __sub__(self, less: "Use") -> "Use":
        return Use(self.size_bytes - less.size_bytes, self.cells - less.cells)


def relay_of(token: str) -> str:
    """What stands for a robot's name where a relay's token is meant; no robot has a space in its name."""
    return f"relay {token}"


@dataclass(frozen=True, slots=True)
class Backlog:
    """Commits of one map that are durable but not folded."""

    map: str
    commits: int
    oldest_s: float | None
    """When the oldest of them came, as a time; None without any."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StoreFigures:
    """Sizes now, and counts since the start."""

    size_bytes: int
    """Of everything at rest, without what is written ahead."""
    ahead_bytes: int
    """Written ahead, to be moved to its place."""
    free_bytes: int
    """On the disk."""
    queued: int
    """Jobs that wait to be written."""
    written: int
    """Transactions."""
    emptied: int
    """Times that the write-ahead log was emptied."""
    failures: dict[str, int]
    """Transactions that were not written, by kind of error."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Token:
    """A token as it is kept: everything but its secret."""

    name: str
    role: RoleText
    map_number: int | None
    """None: all maps."""
    map_name: str | None
    robot: str | None
    created_s: float
    expires_s: float | None
    last_used_s: float | None = None


def registration_name(map_name: str, robot: str) -> str:
    """Name of the token that a registration gives; no administrator can choose it, for its colon."""
    return f"{map_name}:{robot}"
