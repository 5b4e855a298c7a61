"""State of a store in PostgreSQL, for administrators and probes, and robots' use of their quotas."""

import logging
import math
import time
from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import NamedTuple

from psycopg import errors

from cairn_map.errors import UnreachableError
from cairn_server.store.objects.cold_bytes import ColdReads, split_cell_object
from cairn_server.store.postgres.connections import Connection, Connections, first, rows
from cairn_server.store.postgres.failures import RETRY_FULL_S
from cairn_server.store.postgres.folds import heal_cell
from cairn_server.store.postgres.schema import IS_WAITING
from cairn_server.store.postgres.writing_threads import WritingThreads
from cairn_server.store.store_age import StoreAge
from cairn_server.store.store_rows import Backlog, CellRow, MapRow, Robot, StoreFigures, Use, relay_of

PROBE_S = 5
"""Time in which the database writes a probe, unless it does not keep up."""
MAPS_MAX = 1000
"""Most maps whose backlogs are listed."""
SIZE = "SELECT pg_database_size(current_database())"
CHUNK_BYTES = 2048
"""Part of a page that a chunk of a long value takes: four are on a page of 8 kB."""
USED = f"""
SELECT pg_database_size(current_database()) - coalesce((
    SELECT sum(greatest(0, pg_relation_size(long.oid) - (long.reltuples + stat.n_ins_since_vacuum) * {CHUNK_BYTES}))
    FROM pg_class AS own JOIN pg_class AS long ON long.oid = own.reltoastrelid
        JOIN pg_stat_all_tables AS stat ON stat.relid = long.oid
    WHERE own.oid IN ('cell'::regclass, 'diff'::regclass) AND long.reltuples >= 0
), 0)::bigint"""
"""SQL of the database's size less what bytes of cells and evidence left behind that went, to an object store mostly.

Files of PostgreSQL do not shrink: a row that goes makes room for others in them once VACUUM has seen it. Without this
a database that was full once would be full for ever.
"""
SIZE_EVERY_S = 5.0
"""Time between two looks at the database's size: pushes ask for it."""
ALARM_SHARE, FULL_SHARE = 0.7, 0.95
"""Shares of the room set for the database from which on a line is logged, and pushes are refused."""

log = logging.getLogger(__name__)


class _Size(NamedTuple):
    """Room that the database takes at an instant."""

    size_bytes: int
    at_s: float


class PgUses:
    """`store.Uses`."""

    def __init__(self, connections: Connections) -> None:
        self._connections = connections

    def since(self, time_s: float) -> Mapping[Robot, Use]:
        """Use by each robot's commits that came at or after a time, and by what each relay handed over."""
        query = (
            "SELECT map.map, u.* FROM map CROSS JOIN LATERAL ("
            " SELECT robot, via, sum(size_bytes)::bigint, sum(cells)::bigint,"
            " sum(greatest(0, bricks - size_bytes))::bigint"
            " FROM commits WHERE commits.map = map.map AND received_s >= %s::float8 GROUP BY 1, 2) AS u"
        )
        found: defaultdict[Robot, Use] = defaultdict(Use)
        with self._connections.lent() as connection:
            for number, robot, via, *sums in rows(connection, query, (time_s,)):
                found[number, relay_of(via) if via else robot] += Use(*sums)
        return found


class PgHealth:
    """`store.StoreHealth`."""

    def __init__(
        self,
        connections: Connections,
        threads: WritingThreads,
        age: StoreAge,
        *,
        objects: ColdReads,
        size_bytes_max: int | None,
        steady_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._connections = connections
        self._threads = threads
        self._age = age
        self._objects = objects
        self._size_bytes_max = size_bytes_max
        self._steady_s = steady_s
        self._size = _Size(0, -math.inf)
        self._is_alarmed = False

    def backlogs(self) -> list[Backlog]:
        """Commits that are not folded yet, or whose retract is under way, of the maps that have any."""
        count = f"SELECT map, count(*) FROM commits WHERE {IS_WAITING} GROUP BY map ORDER BY map LIMIT %s"
        query = (
            f"SELECT name, waiting.count, oldest.received_age_s FROM ({count}) AS waiting JOIN map USING (map)"
            " CROSS JOIN LATERAL (SELECT received_age_s FROM commits"
            f"   WHERE commits.map = waiting.map AND {IS_WAITING} ORDER BY number LIMIT 1) AS oldest"
        )
        with self._connections.lent() as connection:
            found = rows(connection, query, (MAPS_MAX,))
        now_s = self._age.now_s()
        return [Backlog(name, count, max(0.0, now_s - oldest_s)) for name, count, oldest_s in found]

    def figures(self) -> StoreFigures:
        """Sizes and counts."""
        with self._connections.lent() as connection:
            size_bytes, used = first(connection, SIZE), first(connection, USED)
            sums = ", ".join(f"coalesce(sum({each}), 0)::bigint" for each in ("cells_bytes", "history_bytes", "seq"))
            cells_bytes, history_bytes, entries = first(connection, f"SELECT {sums} FROM head")
            evidence_bytes = first(connection, "SELECT coalesce(sum(kept_bytes), 0)::bigint FROM author")
        return StoreFigures(
            size_bytes=size_bytes,
            ahead_bytes=0,
            free_bytes=None if self._size_bytes_max is None else max(0, self._size_bytes_max - used),
            queued=self._threads.queued,
            written=self._connections.written,
            emptied=0,
            failures=dict(self._connections.failures),
            cells_bytes=cells_bytes,
            history_bytes=history_bytes,
            evidence_bytes=evidence_bytes,
            log_entries=entries,
            unused_bytes=max(0, size_bytes - used),
        )

    def check_space(self, free_bytes_min: int) -> None:
        """Refuse pushes once the room that was set for the database is nearly full.

        The disk is the database's, which says when it is full only once nothing can be written, folds neither. So
        without that room nothing is refused here.

        Raises:
            UnreachableError: kind `disk_full`.
        """
        room = self._size_bytes_max
        if room is None:
            return
        if self._steady_s() - self._size.at_s > SIZE_EVERY_S:
            with self._connections.lent() as connection:
                self._size = _Size(first(connection, USED), self._steady_s())
        used, text = self._size.size_bytes, f"{self._size.size_bytes >> 20} of {room >> 20} MB"
        is_alarmed = used > ALARM_SHARE * room
        if is_alarmed and not self._is_alarmed:
            log.warning("the database has %s: give it room, or move evidence out of it (docs/scale.md)", text)
        self._is_alarmed = is_alarmed
        if used > FULL_SHARE * room or room - used < free_bytes_min:
            raise UnreachableError("disk_full", f"the database has {text}", retry_after_s=RETRY_FULL_S)

    def shrink(self) -> bool:
        """Nothing: VACUUM, which the database runs itself, makes room for other rows."""
        return False

    def heal(self, row: MapRow, cell: CellRow) -> bool:
        """Put sound bytes in the place of a damaged cell; False if it changed meanwhile."""
        sound = replace(cell, stamps=self._cold_stamps(row, cell))
        return self._connections.run(lambda connection: heal_cell(connection, row, sound, age_s=self._age.now_s()))

    def _cold_stamps(self, row: MapRow, cell: CellRow) -> bytes:
        """Stamps of a cell that are in the object store; empty if they are not, or are lost with the cell's bytes."""
        query = "SELECT object FROM cell WHERE map = %s AND layer = 0 AND cell = %s AND lm = %s"
        with self._connections.lent() as connection:
            name = first(connection, query, (row.number, cell.key, cell.lm))
        return b"" if name is None else split_cell_object(self._objects.get(name))[1]

    def probe(self) -> None:
        """Write something that changes nothing, as durably as a commit."""
        try:
            self._connections.run(_rewrite_age)
        except UnreachableError as exc:
            if isinstance(exc.__cause__, errors.QueryCanceled):
                text = f"the database took nothing for {PROBE_S} s"
                raise UnreachableError("busy", text, retry_after_s=5.0) from exc
            raise


def _rewrite_age(connection: Connection) -> None:
    connection.execute(f"SET LOCAL statement_timeout TO '{PROBE_S}s'".encode())
    connection.execute("UPDATE age SET age_s = age_s")
