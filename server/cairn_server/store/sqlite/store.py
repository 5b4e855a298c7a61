"""The embedded store: one SQLite file, one writer, readers that never wait for it (`store.Store`)."""

import json
import logging
import os
import secrets
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future
from concurrent.futures import TimeoutError as FutureTimeoutError
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import TypeVar

import apsw

from cairn_map.commits.cursor import Cursor
from cairn_map.commits.ids import Author, Incarnation, RobotName
from cairn_map.epochs.epoch import BASE, Epoch
from cairn_map.epochs.layer import MapLayer
from cairn_map.errors import BadInputError, NotFoundError, UnreachableError
from cairn_map.evidence.grid import Geometry
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_map.wire.access_messages import AuditText
from cairn_server.map_refusals import GoneMap, check_same_map, map_gone
from cairn_server.store.admission import OWN_WORD, Grounds
from cairn_server.store.attachments.attachment_rows import AttachmentRows, Query
from cairn_server.store.branch_signs import LastSeen
from cairn_server.store.folder_lock import lock_folder
from cairn_server.store.private_files import close_to_others, make_private
from cairn_server.store.sqlite.branches import SqliteBranchNotes, stored_branches
from cairn_server.store.sqlite.changes import append_commit, heal_cell, insert_map, next_number, write_fold
from cairn_server.store.sqlite.ended_tokens import LIST_NAME, EndedTokens
from cairn_server.store.sqlite.failures import FULL, disk_full, opening_failure
from cairn_server.store.sqlite.old_sums import measure_old_sums
from cairn_server.store.sqlite.readers import Readers
from cairn_server.store.sqlite.reads import SqliteReads
from cairn_server.store.sqlite.retention import (
    DYING,
    check_lives,
    clear_part,
    delete_map,
    forget_evidence,
    missing_map,
)
from cairn_server.store.sqlite.robot_keys import SqliteAdmittedKeys, admit_registration
from cairn_server.store.sqlite.schema import MAPS, WAITING, WAITING_MAPS, ensure_schema
from cairn_server.store.sqlite.shares import SqliteShares
from cairn_server.store.sqlite.tile_rows import fill_tiles
from cairn_server.store.sqlite.tokens import (
    SqliteAuditLog,
    SqliteTokens,
    put_registration,
    remove_tokens_of,
    write_audit,
)
from cairn_server.store.sqlite.writer import Writer, connect, first, rows
from cairn_server.store.store_age import CLOCKS, AgeMark, Clocks, StoreAge
from cairn_server.store.store_clock import ClockMark, clock_mark_from_text
from cairn_server.store.store_rows import (
    Backlog,
    Branch,
    CellRow,
    Fold,
    MapRow,
    NewCommit,
    Robot,
    StoreFigures,
    Use,
    registration_name,
    relay_of,
    unpaid_bricks,
)

PROBE_S = 5.0
"""Time in which the writer gets to a probe, unless it does not keep up."""
INCREMENTAL = 2
"""`PRAGMA auto_vacuum` of a file whose unused pages can be given back one by one."""
UNUSED_PAGES_MAX, UNUSED_SHARE_MAX = 1024, 0.125
"""Unused pages, 16 MB, and their share of the file, above both of which they are given back: fewer are used again."""
SHRINK_PAGES = 64
"""Most pages that are given back in one transaction: 1 MB."""
MAPS_MAX = 1000
"""Most maps whose backlogs are listed."""

T = TypeVar("T")

log = logging.getLogger(__name__)

FILE_NAME = "cairn.sqlite"
NEWEST = "SELECT max(epoch) FROM commits WHERE map = ? AND epoch IS NOT NULL"
"""SQL of the newest epoch of a map's commits."""


class SqliteClock:
    """`store_clock.StoreClock` of the one machine that has the store."""

    def __init__(self, writer: Writer, clocks: Clocks, kept: ClockMark) -> None:
        self._writer = writer
        self._clocks = clocks
        self._kept = kept

    @property
    def boot(self) -> str:
        """Boot of the machine."""
        return self._clocks.boot

    def steady_s(self) -> float:
        """The machine's steady clock."""
        return self._clocks.since_boot_s()

    def wall_s(self) -> float:
        """The machine's time of day."""
        return self._clocks.wall_s()

    def kept(self) -> ClockMark:
        """State that was kept last."""
        return self._kept

    def keep(self, mark: ClockMark, *, before: ClockMark) -> None:
        """Keep a state; no other server keeps any."""
        self._kept = mark
        with suppress(UnreachableError):  # a later one is kept soon
            self._writer.submit(lambda connection: rows(connection, "UPDATE age SET clock = ?", (mark.to_text(),)))


class SqliteAttachmentTables:
    """`attachment_rows.Database` of one file."""

    def __init__(self, readers: Readers, writer: Writer | None = None) -> None:
        """Without a writer nothing is written."""
        self._readers = readers
        self._writer = writer

    def run(self, job: Callable[[Query], T]) -> T:
        """Result of a job in one transaction of the writer."""
        if self._writer is None:
            raise BadInputError("bad_store", "this file is only read")
        return self._writer.run(lambda connection: job(partial(rows, connection)))

    @contextmanager
    def reading(self) -> Iterator[Query]:
        """Function for readings, for the length of a `with`."""
        with self._readers.reading() as reader:
            yield partial(rows, reader)

    def check_lives(self, query: Query, map_number: int) -> None:
        """Refuse to write to a map that was deleted."""
        found = query("SELECT number, name, deleted_s, by FROM gone_map WHERE number = ?", (map_number,))
        if found:
            raise map_gone(GoneMap(**dict(zip(("number", "name", "deleted_s", "by"), found[0], strict=True))))


class SqliteStore(SqliteReads):
    """`store.Store` in a folder, which one process has (`folder_lock`)."""

    leases = None
    replicas = None

    def __init__(self, folder: Path, clocks: Clocks = CLOCKS) -> None:
        """Open or make the store, whose age goes on by these clocks.

        Raises:
            ConflictError: kind `store_in_use`: another server works on it.
            BadInputError: kind `store_version` or `bad_store`: no folder, or no store of this version.
        """
        path = folder / FILE_NAME
        try:
            folder.mkdir(0o700, parents=True, exist_ok=True)  # what is in it is as secret as the maps
            self._lock = lock_folder(folder)
        except OSError as exc:
            if exc.errno in FULL:
                raise opening_failure(exc, path) from exc
            raise BadInputError("bad_store", f"cannot keep a store in {folder}: {exc.strerror}") from exc
        try:
            self._ended = _prepare(path)
            self._writer = Writer(path)
        except BaseException:
            self._lock.close()
            raise
        super().__init__(Readers(path))
        self._seen = LastSeen()
        with self._readers.reading() as reader:
            age_s, wall_s, mark = first(reader, "SELECT age_s, wall_s, clock FROM age")
        self.age = StoreAge(AgeMark(age_s, wall_s), clocks)
        self.clock = SqliteClock(self._writer, clocks, clock_mark_from_text(mark))
        self.tokens = SqliteTokens(self._writer, self._readers, self.age, self._ended)
        self.keys = SqliteAdmittedKeys(self._writer, self._readers)
        self.uses = SqliteUses(self._readers)
        self.shares = SqliteShares(self._writer, self._readers)
        self.attachments = AttachmentRows(SqliteAttachmentTables(self._readers, self._writer))
        self.audit_log = SqliteAuditLog(self._writer, self._readers)
        self.health = SqliteHealth(path, self._writer, self._readers, self.age)
        self._names: dict[str, MapRow] = {}  # of maps, which never change
        self.notes = SqliteBranchNotes(self._writer, self._readers)

    def create_map(
        self, name: str, geometry: Geometry, sensor_model: SensorModel, epoch_s: int | None = None
    ) -> tuple[MapRow, bool]:
        """The map and whether it is new; an equal one may exist already."""
        layer = MapLayer(geometry=geometry, epoch_s=epoch_s)

        def job(connection: apsw.Connection) -> bool:
            found = first(connection, "SELECT geometry, epoch_s, sensor_model FROM map WHERE name = ?", (name,))
            if found:
                known = MapLayer(geometry=Geometry.model_validate_json(found[0]), epoch_s=found[1])
                check_same_map(name, (known, SensorModel.model_validate_json(found[2])), (layer, sensor_model))
                return False
            insert_map(connection, name, layer, sensor_model, secrets.token_bytes(32))
            return True

        is_new = self._writer.run(job)
        return self.map(name), is_new

    def map(self, name: str) -> MapRow:
        """The map of a name."""
        names = self._names  # what is read before a deletion must not be known after it
        kept = names.get(name)
        if kept is not None:
            return kept
        found = self.map_rows("WHERE name = ?", (name,))
        if found:
            names[name] = found[0]
            return found[0]
        with self._readers.reading() as reader:
            raise missing_map(reader, name)

    def delete_map(self, row: MapRow, *, by: str) -> GoneMap:
        """Take a map out of the store for good, and end its tokens; durable on return."""
        gone = self._writer.run(lambda connection: delete_map(connection, row, self._ended, by=by))
        self._names = {}
        self.tokens.forget_known()
        return gone

    def clear_deleted(self, *, size_bytes_max: int) -> bool:
        """Remove about so many bytes of what deleted maps left; False once nothing is left of them."""
        with self._readers.reading() as reader:
            if first(reader, DYING) is None:
                return False
        return self._writer.run(lambda connection: clear_part(connection, size_bytes_max=size_bytes_max))

    def newest_epoch(self, row: MapRow) -> Epoch:
        """Newest epoch of the commits of a map; `BASE` if none has one."""
        with self._readers.reading() as reader:
            newest = first(reader, NEWEST, (row.number,))
        return BASE if newest is None else Epoch(newest)

    def append(self, row: MapRow, commit: NewCommit) -> bool:
        """Keep a commit; True if it is new, False if the same one is kept already. Durable on return."""
        return self.submit(row, commit).result()

    def submit(self, row: MapRow, commit: NewCommit) -> Future[bool]:
        """Keep a commit, as `append` does; durable once the answer is there."""
        return self._writer.submit(lambda connection: append_commit(connection, row, commit, age_s=self.age.now_s()))

    def append_built(self, row: MapRow, author: Author, build: Callable[[int], NewCommit]) -> NewCommit:
        """Keep a commit that `build(n)` makes for the author's next number n."""

        def job(connection: apsw.Connection) -> NewCommit:
            commit = build(next_number(connection, row, author))
            append_commit(connection, row, commit, age_s=self.age.now_s())
            return commit

        return self._writer.run(job)

    def forget_evidence(self, row: MapRow, *, before_s: float, limit: int) -> int:
        """Drop the evidence and the meta of up to `limit` commits folded, and last pushed, before an age; how many."""

        def job(connection: apsw.Connection) -> int:
            check_lives(connection, row.number)
            return forget_evidence(connection, row, before_s, limit, age_s=self.age.now_s())

        return self._writer.run(job)

    def fold(self, row: MapRow, fold: Fold) -> bool:
        """Write a fold if the head is still its base; False (and nothing written) otherwise."""
        return self._writer.run(lambda connection: write_fold(connection, row, fold, age_s=self.age.now_s()))

    def register(self, row: MapRow, branch: Branch, token_hash: bytes, grounds: Grounds = OWN_WORD) -> None:
        """Make a branch, or give an existing one a new token, if its name is not bound to another key."""
        author = Author(RobotName(branch.name), Incarnation(branch.incarnation))
        self._write_seen()  # before the row is replaced, in the order of the writer's jobs
        self._seen.forget(row.number, branch.name)
        sensors = json.dumps(branch.sensors)
        values = (row.number, branch.name, branch.mode, sensors, branch.last_seen_s, branch.incarnation)

        def job(connection: apsw.Connection) -> None:
            check_lives(connection, row.number)
            admit_registration(connection, row, author, grounds)
            connection.execute(
                "INSERT INTO branch (map, name, mode, sensors, last_seen_s, incarnation) VALUES (?, ?, ?, ?, ?, ?)"
                " ON CONFLICT (map, name) DO UPDATE SET mode = excluded.mode, sensors = excluded.sensors,"
                " last_seen_s = excluded.last_seen_s,"
                # A new incarnation may have lost its disk: where it stands is not known before it fetches.
                " cursor = CASE WHEN branch.incarnation = excluded.incarnation THEN cursor END,"
                " incarnation = excluded.incarnation",
                values,
            )
            self._ended.note_named(connection, registration_name(row.name, branch.name))
            put_registration(connection, row, branch.name, token_hash, age_s=self.age.now_s())

        self._writer.run(job)
        self.tokens.forget_known()

    def seen(self, row: MapRow, name: str, cursor: Cursor | None) -> None:
        """Note that a branch was heard of, and where it stands; may be written later."""
        if self._seen.note(row.number, name, str(cursor) if cursor else None):
            with suppress(UnreachableError):  # it is only a note, and what it is about was done
                self._write_seen()

    def _write_seen(self) -> Future[None]:
        """Write what was heard of branches."""
        values = [(sign.time_s, sign.cursor, *key) for key, sign in self._seen.taken().items()]
        query = "UPDATE branch SET last_seen_s = ?, cursor = coalesce(?, cursor) WHERE map = ? AND name = ?"

        def job(connection: apsw.Connection) -> None:
            connection.executemany(query, values).fetchall()

        return self._writer.submit(job)

    def deregister(self, row: MapRow, name: str) -> None:
        """Remove a branch and its token."""

        def job(connection: apsw.Connection) -> None:
            connection.execute("DELETE FROM branch WHERE map = ? AND name = ?", (row.number, name))
            if not connection.changes():
                raise NotFoundError("no_branch", f"map {row.name} has no branch {name!r}")
            self._ended.note_robot(connection, row.number, name)
            remove_tokens_of(connection, row, name)

        self._writer.run(job)
        self.tokens.forget_known()
        self._seen.forget(row.number, name)

    def branches(self, row: MapRow) -> list[Branch]:
        """All branches, by name."""
        with suppress(UnreachableError):  # a full disk is no reason not to tell what is known
            self._write_seen().result()
        with self._readers.reading() as reader:
            return stored_branches(reader, row)

    def branch(self, row: MapRow, name: str) -> Branch | None:
        """One branch as it is stored."""
        with self._readers.reading() as reader:
            return next(iter(stored_branches(reader, row, name)), None)

    def recount(self) -> None:
        """Compute the sums and vectors again that are kept besides cells and log: in a store that was damaged."""
        self._writer.run(fill_tiles)

    def keep_age(self) -> None:
        """Keep the age of the store, for the next start; may be written later."""
        mark = self.age.mark()
        with suppress(UnreachableError):  # the next one comes soon, and a start goes on from the last one
            self._writer.submit(
                lambda connection: rows(connection, "UPDATE age SET age_s = ?, wall_s = ?", (mark.age_s, mark.wall_s))
            )

    def audit(self, what: str, detail: str, *, client: str = "") -> None:
        """Note something that an administrator may have to look into; may be written later."""
        log.warning("%s: %r", what, detail, extra={"fields": {"client": client} if client else {}})
        said = AuditText("server", what, detail, client)
        with suppress(UnreachableError):
            self._writer.submit(lambda connection: write_audit(connection, said))

    def close(self) -> None:
        """Finish what was accepted and close."""
        with suppress(UnreachableError):  # closed before
            self._write_seen()
            self.tokens.write_used()
            self.keep_age()
        try:
            self._writer.close()
            self._readers.close()
        finally:
            self._lock.close()


def _prepare(path: Path) -> EndedTokens:
    """Bring the tables up to date, and open the list of ended tokens next to the store."""
    try:
        # SQLite gives its files next to the store the mode of the store.
        make_private(path)
        for name in (f"{path.name}-wal", f"{path.name}-shm", LIST_NAME):
            close_to_others(path.with_name(name))
        connection = connect(path)
        try:
            ensure_schema(connection)
            measure_old_sums(connection)
            return EndedTokens(path.with_name(LIST_NAME), connection)
        finally:
            connection.close()
    except (apsw.Error, OSError) as exc:
        raise opening_failure(exc, path) from exc


class SqliteUses:
    """`store.Uses`."""

    def __init__(self, readers: Readers) -> None:
        self._readers = readers

    def since(self, time_s: float) -> Mapping[Robot, Use]:
        """Use by each robot's commits that came at or after a time, and by what each relay handed over."""
        found: defaultdict[Robot, Use] = defaultdict(Use)
        # Not from the newest back to the first older one: a clock may be set back, and so the order of the numbers
        # says nothing. Nor summed up by SQL, which would go through all commits to have them in groups.
        query = "SELECT map, robot, via, size_bytes, cells, bricks FROM commits WHERE received_s >= ?"
        with self._readers.reading() as reader:
            for number, robot, via, size_bytes, cells, bricks in reader.execute(query, (time_s,)):
                use = Use(size_bytes, cells, unpaid_bricks(bricks, size_bytes=size_bytes))
                found[number, relay_of(via) if via else robot] += use
        return found


class SqliteHealth:
    """`store.StoreHealth` over the writer and the readers of one file."""

    def __init__(self, path: Path, writer: Writer, readers: Readers, age: StoreAge) -> None:
        self._path = path
        self._writer = writer
        self._readers = readers
        self._age = age
        self._is_shrinking = False

    def backlogs(self) -> list[Backlog]:
        """Commits that are not folded yet, or whose retract is under way, of the maps that have any."""
        # All go along the indices of what waits: a folded log of any length costs nothing, nor does an idle map.
        waiting = WAITING.replace("?1", "map.number")
        query = (
            f"SELECT name, (SELECT count(*) FROM {waiting}), (SELECT received_age_s FROM commits"  # noqa: S608 - our own clause
            f" WHERE number = (SELECT min(number) FROM {waiting})) FROM {MAPS} WHERE number IN ({WAITING_MAPS})"
            " ORDER BY map.number LIMIT ?"
        )
        with self._readers.reading() as reader:
            found = rows(reader, query, (MAPS_MAX,))
        now_s = self._age.now_s()
        return [Backlog(name, count, max(0.0, now_s - oldest_s)) for name, count, oldest_s in found]

    def figures(self) -> StoreFigures:
        """Sizes and counts."""
        with self._readers.reading() as reader:
            kept = "(SELECT sum(kept_bytes) FROM author WHERE map = map.number)"
            sums = ", ".join(f"coalesce(sum({each}), 0)" for each in ("cells_bytes", "history_bytes", kept, "seq"))
            cells_bytes, history_bytes, evidence_bytes, entries = first(reader, f"SELECT {sums} FROM {MAPS}")  # noqa: S608
            unused_bytes = reader.pragma("freelist_count") * reader.pragma("page_size")
        return StoreFigures(
            size_bytes=self._path.stat().st_size,
            ahead_bytes=self._writer.checkpoints.size_bytes(),
            free_bytes=self._free_bytes(),
            queued=self._writer.queued,
            written=self._writer.written,
            emptied=self._writer.checkpoints.count,
            failures=dict(self._writer.failures),
            cells_bytes=cells_bytes,
            history_bytes=history_bytes,
            evidence_bytes=evidence_bytes,
            log_entries=entries,
            unused_bytes=unused_bytes,
        )

    def check_space(self, free_bytes_min: int) -> None:
        """Refuse to take more while less than this is free."""
        if free_bytes_min <= 0:
            return
        free_bytes = self._free_bytes()
        if free_bytes < free_bytes_min:
            raise disk_full(
                f"{free_bytes} bytes are free on the server's disk, it keeps {free_bytes_min}; make room, or lower "
                "the setting disk_free_min_bytes"
            )

    def shrink(self) -> bool:
        """Give a bounded part of the file's unused pages back to the disk; True while that is under way."""
        with self._readers.reading() as reader:
            pages, unused = reader.pragma("page_count"), reader.pragma("freelist_count")
            if reader.pragma("auto_vacuum") != INCREMENTAL:
                return False
        self._is_shrinking = unused > (0 if self._is_shrinking else max(UNUSED_PAGES_MAX, UNUSED_SHARE_MAX * pages))
        if self._is_shrinking:
            self._writer.run(lambda connection: rows(connection, f"PRAGMA incremental_vacuum({SHRINK_PAGES})"))
        return self._is_shrinking

    def heal(self, row: MapRow, cell: CellRow) -> bool:
        """Put sound bytes in the place of a damaged cell; False if it changed meanwhile."""
        return self._writer.run(lambda connection: heal_cell(connection, row, cell))

    def probe(self) -> None:
        """Write something that changes nothing, as durably as a commit."""
        if not self._writer.is_alive:
            raise UnreachableError("store_failed", "the store's writer has ended; start the server again")
        try:
            self._writer.submit(_rewrite_version).result(PROBE_S)
        except FutureTimeoutError:
            raise UnreachableError("busy", f"the disk took nothing for {PROBE_S:.0f} s", retry_after_s=5.0) from None

    def _free_bytes(self) -> int:
        found = os.statvfs(self._path.parent)
        return found.f_bavail * found.f_frsize


def _rewrite_version(connection: apsw.Connection) -> None:
    connection.pragma("user_version", connection.pragma("user_version"))
