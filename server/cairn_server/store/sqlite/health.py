"""How the embedded store does (`store_health.StoreHealth`)."""

import os
from concurrent.futures import TimeoutError as FutureTimeoutError
from pathlib import Path

import apsw

from cairn_map.errors import UnreachableError
from cairn_server.store.sqlite.failures import disk_full
from cairn_server.store.sqlite.readers import Readers
from cairn_server.store.sqlite.writer import Writer, rows
from cairn_server.store.store_health import Backlog, StoreFigures
from cairn_server.store.store_rows import CellRow, MapRow

PROBE_S = 5.0
"""A writer that does not get to the probe in this time does not keep up."""
MAPS_MAX = 1000
"""Maps that are looked at one by one."""


class SqliteHealth:
    """`store_health.StoreHealth` over the writer and the readers of one file."""

    def __init__(self, path: Path, writer: Writer, readers: Readers) -> None:
        self._path = path
        self._writer = writer
        self._readers = readers

    def backlogs(self) -> list[Backlog]:
        """What is not folded yet, of every map."""
        # Both go along the index of what is pending: a folded log of any length costs nothing.
        query = (
            "SELECT name, (SELECT count(*) FROM commits WHERE map = map.number AND folded_seq IS NULL"
            " AND damaged IS NULL), (SELECT received_s FROM commits WHERE map = map.number AND folded_seq IS NULL"
            " AND damaged IS NULL ORDER BY number LIMIT 1) FROM map ORDER BY map.number LIMIT ?"
        )
        with self._readers.reading() as reader:
            return [Backlog(name, count, oldest_s) for name, count, oldest_s in rows(reader, query, (MAPS_MAX,))]

    def figures(self) -> StoreFigures:
        """Sizes and counts."""
        return StoreFigures(
            size_bytes=self._path.stat().st_size,
            ahead_bytes=self._writer.checkpoints.size_bytes(),
            free_bytes=self._free_bytes(),
            queued=self._writer.queued,
            written=self._writer.written,
            emptied=self._writer.checkpoints.count,
            failures=dict(self._writer.failures),
        )

    def check_space(self, free_bytes_min: int) -> None:
        """Refuse to take more while less than this is free."""
        if free_bytes_min <= 0:
            return
        free_bytes = self._free_bytes()
        if free_bytes < free_bytes_min:
            raise disk_full(
                f"{free_bytes} bytes are free on the server's disk, it keeps {free_bytes_min}; make room, or lower "
                "--disk-free-min"
            )

    def heal(self, row: MapRow, cell: CellRow) -> bool:
        """Put sound bytes in the place of a damaged cell; False if it changed meanwhile."""
        values = (cell.digest, cell.fingerprint.to_bytes(), cell.voxels, cell.size_bytes, cell.body, cell.hottest_k)

        def job(connection: apsw.Connection) -> bool:
            connection.execute(
                "UPDATE cell SET digest = ?, fingerprint = ?, voxels = ?, size_bytes = ?, body = ?, hottest_k = ?"
                " WHERE map = ? AND cell = ? AND lm = ?",
                (*values, row.number, cell.key, cell.lm),
            )
            return connection.changes() > 0

        return self._writer.run(job)

    def probe(self) -> None:
        """Write something that changes nothing, as durably as a commit."""
        if not self._writer.is_alive:
            raise UnreachableError("store_failed", "the store's writer has ended; start the server anew")
        try:
            self._writer.submit(_rewrite_version).result(PROBE_S)
        except FutureTimeoutError:
            raise UnreachableError("busy", f"the disk took nothing for {PROBE_S:.0f} s", retry_after_s=5.0) from None

    def _free_bytes(self) -> int:
        found = os.statvfs(self._path.parent)
        return found.f_bavail * found.f_frsize


def _rewrite_version(connection: apsw.Connection) -> None:
    connection.pragma("user_version", connection.pragma("user_version"))
