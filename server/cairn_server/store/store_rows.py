"""Rows of a store: maps, commits, cells, log entries, branches, tokens, and the sums over them."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from cairn_map.commits.cursor import Cursor
from cairn_map.commits.ids import OPERATOR, Author, CommitId
from cairn_map.commits.mark import Mark, MarkKey
from cairn_map.commits.version_vector import VersionVector
from cairn_map.epochs.epoch import BASE, Epoch
from cairn_map.epochs.layer import LayerDefinition, MapLayer
from cairn_map.evidence.fingerprint import Fingerprint
from cairn_map.evidence.grid import CellKey, Geometry
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_map.wire.access_messages import AuditEntry, RoleText
from cairn_map.wire.mark_messages import MarkEntry
from cairn_server.store.admission import OWN_WORD, Grounds

AUDIT_ROWS_MAX = 100_000
"""Newest lines of the audit log, which are kept; a choice reads through all of them at most, some 30 ms."""
NUMBER_LIMIT = 1 << 63
"""Above every line's number."""

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
    """Key by which the server recognizes the retracts that it made."""
    epoch_s: int | None = None
    """Length of an epoch, seconds; None: one sum for all times."""
    of_map: int | None = None
    """Number of the map whose further layer it is; None: it is a map itself."""

    @property
    def layer(self) -> MapLayer:
        """Definition of its evidence: the grid and the length of an epoch."""
        return MapLayer(geometry=self.geometry, epoch_s=self.epoch_s)

    @property
    def names_number(self) -> int:
        """Number of the map that robots' names are bound on, and tokens count on: of a layer that of its map."""
        return self.number if self.of_map is None else self.of_map


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
    tops: Mapping[int, tuple[int, ...]]
    """Largest number of each plane in each region (`shares.region_of`); they bound every sum in the map (`shares`)."""
    bricks: int = 0
    """Count of the bricks of 8^3 voxels that it touches."""
    rig: bytes | None = None
    """SHA-256 of the rig that its sensors were described by."""
    signatures: str | None = None
    """Checked signatures of the authors in whose names it speaks, as in `Cairn-Signature`."""
    via: str | None = None
    """Name of the token of the relay that handed it over, or of the operator for whom the server made it."""
    grounds: Grounds = OWN_WORD
    """Grounds on which it speaks for its author."""
    epoch: Epoch = BASE
    """Epoch of all its evidence."""
    marks: tuple[Mark, ...] = ()
    """Its marks, by number; then it has no evidence."""
    layer: LayerDefinition | None = None
    """Layer of the map that begins with it; then it has no evidence."""

    @property
    def is_carried(self) -> bool:
        """True if a relay brings it, whose robots have fewer places than those that come themselves."""
        return self.via is not None and self.id.author.robot != OPERATOR


Millimetres = tuple[int, int, int]
MarkBox = tuple[Millimetres, Millimetres]
"""Lowest and highest corner, millimetres, both included."""


class MarkChange(NamedTuple):
    """Last change of one mark: it came, or was taken out. It never moves: an edit is another mark."""

    seq: int
    """Log entry that brought it, or took it out."""
    key: MarkKey
    record: str | None
    """As `Mark.to_json`; None: it was taken out."""
    amends: tuple[CommitId, ...] = ()
    """Commits that its commit takes out."""


def overlap(mark_low: Millimetres, mark_high: Millimetres, box: MarkBox) -> bool:
    """True if a mark's own box has a point in another one."""
    return all(low <= end and begin <= high for low, high, begin, end in zip(mark_low, mark_high, *box, strict=True))


def entries_of(found: Iterable[MarkChange]) -> list[MarkEntry]:
    """Marks that came, of changes that a store names."""
    return [
        MarkEntry(
            key=str(change.key),
            mark=Mark.model_validate_json(change.record),
            amends=tuple(map(str, change.amends)),
        )
        for change in found
        if change.record is not None
    ]


def removed_commits(found: Iterable[MarkChange]) -> list[CommitId]:
    """Commits whose marks went, of changes that a store names; each once."""
    return list(dict.fromkeys(change.key.commit for change in found if change.record is None))


CAPTURED_AHEAD_MAX_S = 600.0
"""Lead of a robot's clock up to which the time that it states for a commit is believed."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StoredCommit:
    """A commit as it is read for folding."""

    number: int
    id: CommitId
    sha: bytes
    text: bytes
    retracts: tuple[CommitId, ...]
    diff: Mapping[CellKey, bytes]
    """Evidence by cell; empty, too, if it was dropped."""
    gone: bool = False
    """True if its evidence and its meta were dropped."""
    signatures: str | None = None
    due_from: int | None = None
    """Index in `retracts` of the first commit still to be taken out, while the retract is under way; None otherwise."""
    epoch: Epoch = BASE
    """Epoch of its evidence; known, too, once that and its meta were dropped."""


class NamedCommit(NamedTuple):
    """State of a commit that another one names, without its evidence; of one not folded as if it were unknown."""

    id: CommitId
    is_folded: bool = False
    is_gone: bool = False
    """True if its evidence was dropped."""
    is_retracted: bool = False
    """True if a retract of it has taken effect, or waits for it to come."""
    cells: int = 0
    bricks: int = 0
    """Count of the bricks that it touches; one for each byte where that was not counted yet."""


@dataclass(frozen=True, slots=True)
class Contribution:
    """Effect of one log entry on one cell."""

    seq: int
    kind: bytes
    commit: CommitId
    size_bytes: int
    """Size of what the commit adds to the cell."""
    epoch: Epoch = BASE
    """Epoch to which the commit adds it."""

    @property
    def author(self) -> Author:
        """Author of the commit."""
        return self.commit.author


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
    """Stamps as encoded by `stamps`; empty where a listing did not ask for them."""
    gone_seq: int = 0
    """Newest log entry whose evidence was dropped; a fold does not change it."""
    hottest_k: float | None = None
    """Hottest temperature (`cell_order.hottest_k`); None, too, of cells unchanged since before it was stored."""
    history_bytes: int = 0
    """Bytes, of `size_bytes`, of the rows that are older than the cell's newest one."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Entry:
    """One entry of the log: a commit folded (`+`) or taken out (`-`)."""

    kind: bytes
    commit: int
    """Number of the commit in the store."""
    chain: bytes


class RetractStep(NamedTuple):
    """Progress of a retract whose commits are taken out in several folds: `StoredCommit.due_from` before and after."""

    commit: int
    """Number of the retracting commit in the store."""
    before: int | None
    """None: the commit itself is folded now."""
    after: int | None
    """None: this was the last part."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Fold:
    """Changes of one fold, made from the state at `base`."""

    base: Cursor
    head: Cursor
    entries: tuple[Entry, ...]
    cells: Iterable[CellRow]
    retracted: tuple[CommitId, ...] = ()
    """Ids whose retract took or will take effect; each once, for ever."""
    damaged: tuple[tuple[int, str], ...] = ()
    """Numbers of commits to set aside, and why: pushed again, they are pending again."""
    steps: tuple[RetractStep, ...] = ()
    """Progress of retracts that do not end with the fold in which they began."""
    left: tuple[int, ...] = ()
    """Numbers of commits that stay pending, since an object store keeps bytes that they need and does not answer."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Selection:
    """Selection of commits with evidence by an operator: those that fit every part that is not None."""

    robot: str | None = None
    rig: bytes | None = None
    pushed_s: tuple[float, float] = (-math.inf, math.inf)
    """Interval of the time of receipt, UTC seconds since 1970."""
    captured_s: tuple[float, float] = (-math.inf, math.inf)
    """Interval in which some scan of it was taken; commits that state no time only fit the default."""


@dataclass(frozen=True, slots=True)
class Branch:
    """A registered robot."""

    name: str
    mode: str
    sensors: tuple[str, ...]
    cursor: Cursor | None
    last_seen_s: float
    incarnation: str = ""
    """Incarnation with which it registered last; empty in stores of early versions."""


@dataclass(frozen=True, slots=True)
class HeardRobot:
    """Last sign of a registered robot."""

    map: str
    robot: str
    heard_s: float
    """Time of the sign, UTC seconds since 1970."""


LOG_ENTRY_BYTES = 500
"""About the bytes of a log entry and of what is kept of its commit for ever, with their indexes."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Totals:
    """Sizes of a map."""

    cells: int = 0
    size_bytes: int = 0
    commits: int = 0
    branches: int = 0
    corner_cells: tuple[tuple[int, int, int], tuple[int, int, int]] | None = None
    history_bytes: int = 0
    """Bytes, of `size_bytes`, of rows that are older than the newest one of their cell."""
    evidence_bytes: int = 0
    """Bytes of the commits whose evidence is kept, as they were pushed."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Head:
    """State of a map that an answer was read from, and the commits in it."""

    cursor: Cursor
    vector: VersionVector


class ChainedEntry(NamedTuple):
    """One log entry, as the chain hashes it: what is read of many entries, however much each of them says."""

    seq: int
    kind: bytes
    commit: CommitId
    sha: bytes
    chain: bytes


class EntrySize(NamedTuple):
    """Size of one log entry."""

    seq: int
    author: Author | None
    """Author whose evidence was added; None: evidence was taken out, which its author has to fetch, too."""
    size_bytes: int


@dataclass(frozen=True, slots=True)
class Use:
    """Use of quotas by a robot's commits."""

    size_bytes: int = 0
    cells: int = 0
    bricks: int = 0
    """Bricks of 8^3 voxels touched beyond one for each byte."""

    def __add__(self, more: "Use") -> "Use":
        return Use(self.size_bytes + more.size_bytes, self.cells + more.cells, self.bricks + more.bricks)

    def __sub__(self, less: "Use") -> "Use":
        return Use(self.size_bytes - less.size_bytes, self.cells - less.cells, self.bricks - less.bricks)


def unpaid_bricks(bricks: int, *, size_bytes: int) -> int:
    """Bricks that a commit of so many bytes touches beyond one for each byte."""
    return max(0, bricks - size_bytes)


@dataclass(frozen=True, slots=True, kw_only=True)
class RobotShares:
    """Use of its shares of a map's bounds by one robot, or of the reserve."""

    robot: str
    """Its name; empty for the reserve."""
    incarnations: int
    """Count of its authors that are not closed; for the reserve of the servers' own and closed ones."""
    intervals: int
    """Count of the intervals of their numbers."""
    sums: float | None
    """Part of its share of the sums that is taken in its fullest region; None: not more than half."""


@dataclass(frozen=True, slots=True)
class UsedPart:
    """Part of a bound of a map that is used, of which more than half is (`shares.ALARM_PART`)."""

    map: str
    robot: str
    """Name of the robot whose share it is; empty: the reserve, or with bound `robots` the map."""
    bound: str
    part: float


@dataclass(frozen=True, slots=True, kw_only=True)
class ClosedRobot:
    """Result of closing a robot."""

    authors: int
    intervals: int


def relay_of(token: str) -> str:
    """Name under which a relay's token is counted; no robot has a space in its name."""
    return f"relay {token}"


@dataclass(frozen=True, slots=True)
class Backlog:
    """Commits of one map that are durable but not folded; at least one."""

    map: str
    commits: int
    waited_s: float
    """Seconds for which the oldest one has waited while a server ran."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StoreFigures:
    """Sizes of a store now, and counts since the start."""

    size_bytes: int
    """Bytes of the store's file, without the write-ahead log."""
    ahead_bytes: int
    """Bytes of the write-ahead log."""
    free_bytes: int | None
    """Free bytes of the disk; None: it is a database's, which does not say."""
    queued: int
    """Jobs that wait for the writer."""
    written: int
    """Transactions written."""
    emptied: int
    """Times that the write-ahead log was emptied."""
    failures: dict[str, int]
    """Transactions that were not written, by kind of error."""
    cells_bytes: int
    """Bytes of the cells of all maps."""
    history_bytes: int
    """Bytes, of these, of rows that are older than the newest one of their cell."""
    evidence_bytes: int
    """Bytes of the commits of all maps whose evidence is kept."""
    log_entries: int
    """Log entries of all maps."""
    unused_bytes: int
    """Bytes of the store's file that nothing uses."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Token:
    """Stored token: everything but its secret."""

    name: str
    role: RoleText
    map_number: int | None
    """Number of its only map; None: all maps."""
    map_name: str | None
    robot: str | None
    created_s: float
    expires_s: float | None
    last_used_s: float | None = None
    is_confirmed: bool = True
    """False after a restore without a list of what ended since, until an admin says that it still counts."""
    created_age_s: float = field(default=0.0, compare=False)
    """Age of the store when it was made; set by the store."""
    used_age_s: float = field(default=0.0, compare=False)
    """Age of the store when it was last shown, 0 if it never was; set by the store."""


def registration_name(map_name: str, robot: str) -> str:
    """Name of a registration's token; no administrator can choose it, because of its colon."""
    return f"{map_name}:{robot}"


@dataclass(frozen=True, slots=True)
class AuditChoice:
    """Lines of the audit log that are asked for, in every store the same; None: whatever they say there.

    A line about one map begins its detail with `map NAME:`; in stores of earlier versions that of its creation is the
    name alone.
    """

    who: str | None = None
    what: str | None = None
    map: str | None = None
    since_s: float | None = None
    """Not before this time, UTC seconds since 1970."""
    until_s: float | None = None
    """Before this time, UTC seconds since 1970."""

    def fits(self, line: AuditEntry) -> bool:
        """True if a line is asked for."""
        return (
            self.who in (None, line.who)
            and self.what in (None, line.what)
            and (self.map is None or _is_about(line, self.map))
            and (self.since_s is None or line.time_s >= self.since_s)
            and (self.until_s is None or line.time_s < self.until_s)
        )

    def conditions(self, mark: str) -> tuple[list[str], list[str | float]]:
        """Conditions on a row of the table `audit`, and the values of their marks (`?` or `%s`)."""
        found: list[str] = []
        values: list[str | float] = []
        for text, value in (
            ("who = ", self.who),
            ("what = ", self.what),
            ("time_s >= ", self.since_s),
            ("time_s < ", self.until_s),
        ):
            if value is not None:
                found.append(text + mark)
                values.append(value)
        if self.map is not None:
            begin = _begin_of(self.map)
            found.append(f"(substr(detail, 1, {len(begin)}) = {mark} OR what = 'create_map' AND detail = {mark})")
            values += [begin, self.map]
        return found, values


AUDIT_COLUMNS = "number, time_s, who, what, detail, chain, client"
"""Columns of which `audit_entry` makes a line."""
ALL_LINES = AuditChoice()
"""All lines of the audit log."""


def audit_entry(row: Sequence[Any]) -> AuditEntry:
    """Line of a row of `AUDIT_COLUMNS`."""
    number, time_s, who, what, detail, chain, client = row
    return AuditEntry(number=number, time_s=time_s, who=who, what=what, detail=detail, chain=chain.hex(), client=client)


def _is_about(line: AuditEntry, name: str) -> bool:
    return line.detail.startswith(_begin_of(name)) or (line.what, line.detail) == ("create_map", name)


def _begin_of(name: str) -> str:
    return f"map {name}:"
