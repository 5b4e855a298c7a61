"""The store in PostgreSQL: one database, which any number of servers may share (`store.Store`)."""

import logging
import secrets
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from functools import partial
from typing import Any, TypeVar

from cairn_map.commits.cursor import Cursor
from cairn_map.commits.ids import Author
from cairn_map.epochs.epoch import BASE, Epoch
from cairn_map.epochs.layer import MapLayer
from cairn_map.errors import UnreachableError
from cairn_map.evidence.grid import Geometry
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_server.map_refusals import GoneMap, check_same_map
from cairn_server.store.admission import OWN_WORD, Grounds
from cairn_server.store.attachments.attachment_rows import AttachmentRows, Query
from cairn_server.store.objects.cold_bytes import ColdReads
from cairn_server.store.postgres.branches import PgBranches
from cairn_server.store.postgres.connections import NOTING, Connection, Connections, first
from cairn_server.store.postgres.failures import lost_map, missing_map
from cairn_server.store.postgres.folds import PgLeases, write_fold
from cairn_server.store.postgres.health import PgHealth, PgUses
from cairn_server.store.postgres.pushes import append_commit, append_slowly, insert_map, next_number
from cairn_server.store.postgres.reads import PgReads
from cairn_server.store.postgres.replica_notes import PgReplicaNotes
from cairn_server.store.postgres.retention import DYING, clear_part, delete_map, forget_evidence
from cairn_server.store.postgres.robot_keys import PgAdmittedKeys
from cairn_server.store.postgres.schema import NOW_S, prepare
from cairn_server.store.postgres.shares import PgShares
from cairn_server.store.postgres.tokens import PgAuditLog, PgTokens
from cairn_server.store.postgres.writing_threads import WritingThreads
from cairn_server.store.store_age import CLOCKS, AgeMark, Clocks, StoreAge
from cairn_server.store.store_clock import ClockMark, clock_mark_from_text
from cairn_server.store.store_rows import Branch, Fold, MapRow, NewCommit

T = TypeVar("T")

log = logging.getLogger(__name__)

TICK = """
UPDATE age SET
    age_s = greatest(
        %(own_s)s::float8, age_s + CASE WHEN now_s - wall_s BETWEEN 0 AND 150 THEN now_s - wall_s ELSE 0 END
    ),
    wall_s = now_s
FROM (SELECT extract(epoch FROM clock_timestamp())::float8 AS now_s) AS clock
RETURNING age_s, wall_s
"""
"""The age of the store goes on by the time since any server ticked last, by the database's clock: so all servers have
one age. Time in which none ran does not count, nor does a jump of that clock: each ticks every 60 s."""
NOW = f"SELECT {NOW_S}"
CONNECTIONS = 48
"""Most connections of one server to the database, which allows 100 by default."""
NAMES_S = 1.0
"""Time for which a map's name is not looked up again: in a database that was put back it may be another map's."""
NOTING_CONNECTIONS = 12
"""Most besides for what need not be durable at once."""


class PgClock:
    """`store_clock.StoreClock`: the time of day is the database's, for all its servers."""

    boot = ""

    def __init__(self, noting: Connections, threads: WritingThreads, clocks: Clocks) -> None:
        self._noting = noting
        self._threads = threads
        self._clocks = clocks

    def steady_s(self) -> float:
        """The machine's steady clock."""
        return self._clocks.since_boot_s()

    def wall_s(self) -> float:
        """The database's time of day."""
        with self._noting.lent() as connection:
            return float(first(connection, NOW))

    def kept(self) -> ClockMark:
        """State that any server kept last."""
        with self._noting.lent() as connection:
            return clock_mark_from_text(first(connection, "SELECT clock FROM age"))

    def keep(self, mark: ClockMark, *, before: ClockMark) -> None:
        """Keep a state, unless another server kept one since."""
        query = "UPDATE age SET clock = %s WHERE coalesce(clock, %s) = %s"
        values = (mark.to_text(), ClockMark().to_text(), before.to_text())
        self._threads.note(lambda connection: connection.execute(query, values))


class PgAttachmentTables:
    """`attachment_rows.Database` of a database."""

    def __init__(self, connections: Connections) -> None:
        self._connections = connections

    def run(self, job: Callable[[Query], T]) -> T:
        """Result of a job in one transaction, which may be run again."""
        return self._connections.run(lambda connection: job(partial(_rows_of, connection)))

    @contextmanager
    def reading(self) -> Iterator[Query]:
        """Function for readings, for the length of a `with`."""
        with self._connections.lent() as connection:
            yield partial(_rows_of, connection)

    def check_lives(self, query: Query, map_number: int) -> None:
        """Lock the head of a map, which a deletion takes away first, or refuse to write to it."""
        if not query("SELECT 1 FROM head WHERE map = ? FOR NO KEY UPDATE", (map_number,)):
            with self._connections.lent() as connection:
                raise lost_map(connection, map_number)


def _rows_of(connection: Connection, statement: str, values: Sequence[Any]) -> list[tuple[Any, ...]]:
    """Rows of a statement whose values are marked as SQLite does."""
    cursor = connection.execute(statement.replace("?", "%s").encode(), values, binary=True)
    return cursor.fetchall() if cursor.description else []


class PgStore(PgReads):
    """`store.Store` in a database."""

    def __init__(
        self,
        url: str,
        *,
        connections: int = CONNECTIONS,
        clocks: Clocks = CLOCKS,
        objects: ColdReads | None = None,
        size_bytes_max: int | None = None,
    ) -> None:
        """Open or make the store, whose age goes on by these clocks.

        Args:
            url: of the database.
            connections: most of them to the database.
            clocks: of this process.
            objects: object store in which some of its bytes may be.
            size_bytes_max: room for the database, which it does not say itself.

        Raises:
            BadInputError: kind `bad_store` or `store_version` (`schema.prepare`).
        """
        prepare(url, has_objects=objects is not None)
        super().__init__(Connections(url, limit=connections), objects)
        self._noting = Connections(url, limit=NOTING_CONNECTIONS, settings=NOTING)
        self._threads = WritingThreads(self._noting)
        with self._connections.lent() as connection:
            self.age = StoreAge(AgeMark(*first(connection, TICK, {"own_s": 0.0})), clocks)
        self.clock = PgClock(self._noting, self._threads, clocks)
        self.tokens = PgTokens(self._connections, self._threads, self.age)
        self.keys = PgAdmittedKeys(self._connections)
        self.uses = PgUses(self._connections)
        self.shares = PgShares(self._connections)
        self.attachments = AttachmentRows(PgAttachmentTables(self._connections))
        self.audit_log = PgAuditLog(self._connections)
        self.health = PgHealth(
            self._connections, self._threads, self.age, objects=self._objects, size_bytes_max=size_bytes_max
        )
        self.leases = PgLeases(self._noting)
        self.notes = PgBranches(self._connections, self._threads)
        self.replicas = PgReplicaNotes(url, self._connections, self._noting, self.notes)
        self._names: dict[str, tuple[MapRow, float]] = {}  # with the time until which a map is known by its name

    def create_map(
        self, name: str, geometry: Geometry, sensor_model: SensorModel, epoch_s: int | None = None
    ) -> tuple[MapRow, bool]:
        """The map and whether it is new; an equal one may exist already."""
        layer = MapLayer(geometry=geometry, epoch_s=epoch_s)
        key = secrets.token_bytes(32)
        is_new = self._connections.run(lambda connection: insert_map(connection, name, layer, sensor_model, key))
        self._names = {}  # another server may have deleted the one that had the name
        row = self.map(name)
        check_same_map(name, (row.layer, row.sensor_model), (layer, sensor_model))
        return row, is_new

    def map(self, name: str) -> MapRow:
        """The map of a name."""
        names = self._names  # what is read before a deletion must not be known after it
        row, until_s = names.get(name, (None, 0.0))
        now_s = time.monotonic()
        if row is not None and now_s < until_s:
            return row
        found = self.map_rows("WHERE name = %s", (name,))
        if found:
            names[name] = found[0], now_s + NAMES_S
            return found[0]
        with self._connections.lent() as connection:
            raise missing_map(connection, name)

    def delete_map(self, row: MapRow, *, by: str) -> GoneMap:
        """Take a map out of the store for good, and end its tokens; durable on return."""
        gone = self._connections.run(lambda connection: delete_map(connection, row, by=by))
        self._names = {}
        self.tokens.forget_known()
        return gone

    def clear_deleted(self, *, size_bytes_max: int) -> bool:
        """Remove about so many bytes of what deleted maps left; False once nothing is left of them."""
        with self._connections.lent() as connection:
            if first(connection, DYING) is None:
                return False
        age_s = self.age.now_s()
        return self._connections.run(
            lambda connection: clear_part(connection, size_bytes_max=size_bytes_max, age_s=age_s)
        )

    def newest_epoch(self, row: MapRow) -> Epoch:
        """Newest epoch of the commits of a map; `BASE` if none has one."""
        with self._connections.lent() as connection:
            query = "SELECT max(epoch) FROM commits WHERE map = %s AND epoch IS NOT NULL"
            newest = first(connection, query, (row.number,))
        return BASE if newest is None else Epoch(newest)

    def append(self, row: MapRow, commit: NewCommit) -> bool:
        """Keep a commit; True if it is new, False if the same one is kept already. Durable on return."""
        return append_commit(self._connections, row, commit, age_s=self.age.now_s())

    def submit(self, row: MapRow, commit: NewCommit) -> Future[bool]:
        """Keep a commit, as `append` does; durable once the answer is there."""
        return self._threads.submit(partial(self.append, row, commit))

    def append_built(self, row: MapRow, author: Author, build: Callable[[int], NewCommit]) -> NewCommit:
        """Keep a commit that `build(n)` makes for the author's next number n."""

        def job(connection: Connection) -> NewCommit:
            commit = build(next_number(connection, row, author))
            append_slowly(connection, row, commit, age_s=self.age.now_s())
            return commit

        return self._connections.run(job)

    def forget_evidence(self, row: MapRow, *, before_s: float, limit: int) -> int:
        """Drop the evidence and the meta of up to `limit` commits folded, and last pushed, before an age; how many."""
        return self._connections.run(
            lambda connection: forget_evidence(connection, row, before_s, limit, age_s=self.age.now_s())
        )

    def fold(self, row: MapRow, fold: Fold) -> bool:
        """Write a fold if the head is still its base; False (and nothing written) otherwise."""
        return self._connections.run(lambda connection: write_fold(connection, row, fold, age_s=self.age.now_s()))

    def register(self, row: MapRow, branch: Branch, token_hash: bytes, grounds: Grounds = OWN_WORD) -> None:
        """Make a branch, or give an existing one a new token, if its name is not bound to another key."""
        self.notes.register(row, branch, token_hash, grounds, age_s=self.age.now_s())
        self.tokens.forget_known()

    def seen(self, row: MapRow, name: str, cursor: Cursor | None) -> None:
        """Note that a branch was heard of, and where it stands; may be written later."""
        self.notes.seen(row, name, cursor)

    def deregister(self, row: MapRow, name: str) -> None:
        """Remove a branch and its token."""
        self.notes.deregister(row, name)
        self.tokens.forget_known()

    def branches(self, row: MapRow) -> list[Branch]:
        """All branches, by name."""
        return self.notes.all(row)

    def branch(self, row: MapRow, name: str) -> Branch | None:
        """One branch as it is stored."""
        return self.notes.one(row, name)

    def keep_age(self) -> None:
        """Keep the age of the store, for the next start; may be written later."""
        own_s = self.age.now_s()
        self._threads.note(lambda connection: self.age.follow(first(connection, TICK, {"own_s": own_s})[0]))

    def audit(self, what: str, detail: str, *, client: str = "") -> None:
        """Note something that an administrator may have to look into."""
        log.warning("%s: %r", what, detail, extra={"fields": {"client": client} if client else {}})
        with suppress(UnreachableError):
            self.audit_log.add("server", what, detail, client=client)

    def close(self) -> None:
        """Finish what was accepted and close."""
        self.notes.write_seen()
        self.tokens.write_used()
        self.keep_age()
        self._threads.close()
        self._noting.close()
        self._connections.close()
