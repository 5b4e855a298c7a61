"""A map of very many cells, commits and authors: what a request costs to an asker who lacks the last minute.

Cells and commits are rows as folds would have left them; those that are missing were pushed and folded.
"""

import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import apsw
import numpy as np
from tests.bench.timing import cpu_s
from tests.fixtures.map.made import random_evidence
from tests.fixtures.server.pushes import pushed
from tests.fixtures.server.store_contract import new_of

from cairn_map.codec.cell_code import encode_cell
from cairn_map.commits.cursor import ENTRY_FOLD, next_chain
from cairn_map.commits.ids import Author, CommitId, Incarnation, RobotName
from cairn_map.evidence.fingerprint import fingerprint
from cairn_map.evidence.grid import CellKey, Geometry, cell_keys
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_map.wire.frames import encode_frame, frames_of
from cairn_map.wire.messages import MissingRequest, ReplyHeader
from cairn_server.folding.cell_cache import CellCache
from cairn_server.folding.folding import fold_pending
from cairn_server.service import Service
from cairn_server.settings import Settings
from cairn_server.store.sqlite.store import SqliteStore
from cairn_server.store.store_rows import MapRow
from cairn_server.sync.asked_cells import asked_of

Row = tuple[str, str, str]
GEOMETRY = Geometry(depth=5)
CHANGED, COMMITS = 100, 20
"""Cells that the asker misses, and the commits that changed them."""


def large_map_rows(smoke: bool) -> Iterator[Row]:
    """One line each."""
    cells, commits, authors = (4_000, 10_000, 200) if smoke else (200_000, 1_000_000, 2_000)
    with tempfile.TemporaryDirectory() as name:
        service = Service(SqliteStore(Path(name)), Settings(folder=Path(name)))
        try:
            store = service.store
            assert isinstance(store, SqliteStore)
            row, _ = store.create_map("lab", GEOMETRY, SensorModel())
            start_s = time.monotonic()
            _fill(store, row, cells=cells, commits=commits, authors=[_author(n) for n in range(authors)])
            yield (
                f"a map of {cells} cells, {commits} commits, {authors} authors",
                f"{time.monotonic() - start_s:.0f}",
                "s",
            )
            yield from _asked_rows(service, store, row)
        finally:
            service.close()


def _asked_rows(service: Service, store: SqliteStore, row: MapRow) -> Iterator[Row]:
    # Kernels are loaded at a server's start.
    service.sync.replies.missing(row, "wren", asked_of(MissingRequest(size_bytes_max=1)))
    with store.snapshot(row) as snapshot:
        before = str(snapshot.head)
    keys, cache, fold_s = _places(CHANGED), CellCache(row.geometry), []
    for n in range(COMMITS):
        cells = {key: random_evidence(n, GEOMETRY) for key in keys[n::COMMITS]}
        store.append(row, new_of(pushed(n, n, _author(10**6 + n % 10), geometry=GEOMETRY, cells=cells)))
        start_s = time.process_time()
        fold_pending(store, row, cache, limit=1)
        fold_s.append(time.process_time() - start_s)
    yield f"  fold of one commit of {len(cells)} cells", f"{1e3 * sorted(fold_s)[COMMITS // 2]:.1f}", "ms of CPU"
    for asked, what in (({"since": "cursor"}, "of who was there before"), ({}, "of one without a vector")):
        request = asked_of(MissingRequest(cursor=before, kinds=["delta", "state", "full"], **asked))
        start_s = time.process_time()
        answer = b"".join(service.sync.replies.missing(row, "wren", request).parts())
        first_s = time.process_time() - start_s
        took_s = cpu_s(lambda request=request: service.sync.replies.missing(row, "wren", request), 5)  # type: ignore[misc]
        header, *frames = frames_of(answer)
        assert isinstance(header, ReplyHeader)
        assert len(frames) == CHANGED + 1
        size_bytes = len(encode_frame(header))
        what = f"ms of CPU ({1e3 * first_s:.0f} at first), header {size_bytes} B {what}"
        yield f"  missing, {CHANGED} cells behind", f"{1e3 * took_s:.1f}", what
    box = ((-40, -40, -40), (0, 40, 40))
    request = asked_of(MissingRequest(cursor=before, since="cursor", box=box))
    took_s = cpu_s(lambda: service.sync.replies.missing(row, "wren", request), 5)
    yield "  missing in a box of half of the map", f"{1e3 * took_s:.1f}", "ms of CPU"
    yield "  facts of the map", f"{1e3 * cpu_s(lambda: service.maps.info(row), 5):.2f}", "ms of CPU"


def _author(n: int) -> Author:
    return Author(RobotName(f"robot{n}"), Incarnation(f"{n:016x}"))


def _places(count: int, seed: int = 0) -> list[CellKey]:
    """Cells of a rough surface around the origin, each once."""
    chance = np.random.default_rng(seed)
    side = int(np.ceil(np.sqrt(count) / 2)) + 2
    xy = np.stack(np.meshgrid(*[np.arange(-side, side)] * 2), axis=-1).reshape(-1, 2)[:count]
    height = np.rint(4 * np.sin(xy[:, 0] / 9) + chance.normal(0, 0.5, count)).astype(int)
    return [CellKey(key) for key in cell_keys(np.column_stack([xy, height]).tolist()).tolist()]


def _fill(store: SqliteStore, row: MapRow, *, cells: int, commits: int, authors: Sequence[Author]) -> None:
    """Cells, of which the first `CHANGED` can be read, and commits with their entries of the log."""
    first = encode_cell(CellKey(0), evidence := random_evidence(0, GEOMETRY), GEOMETRY)
    places = _places(CHANGED)
    bodies = {key: (encode_cell(key, evidence, GEOMETRY), fingerprint(evidence, key)) for key in places}
    keys = [*places, *sorted(set(_places(cells)) - set(places))][:cells]
    with store.snapshot(row) as snapshot:
        head = snapshot.head
    chain = head.chain

    def entries() -> Iterator[tuple[CommitId, bytes]]:
        nonlocal chain
        for n in range(commits):
            commit = CommitId(authors[n % len(authors)], n // len(authors))
            chain = next_chain(chain, ENTRY_FOLD, commit, bytes(32))
            yield commit, chain

    def job(connection: apsw.Connection) -> None:
        for seq, (commit, after) in enumerate(entries(), start=1):
            values = (row.number, *commit.author, commit.n, seq)
            connection.execute(
                "INSERT INTO commits (map, robot, incarnation, n, sha, size_bytes, cells, meta, retracts, received_s,"
                " folded_seq, folded_age_s) VALUES (?, ?, ?, ?, zeroblob(32), 60000, 0, x'7b7d', '', 1e9, ?, 0)",
                values,
            )
            number = connection.last_insert_rowid()
            connection.execute("INSERT INTO log VALUES (?, ?, ?, ?, ?)", (row.number, seq, ENTRY_FOLD, number, after))
        query = "UPDATE map SET seq = ?, chain = ? WHERE number = ?"
        connection.execute(query, (commits, chain, row.number))
        query = (
            "INSERT INTO cell (map, cell, lm, digest, fingerprint, voxels, size_bytes, body)"
            " VALUES (?, ?, 1, ?, ?, ?, ?, ?)"
        )
        connection.executemany(
            query,
            (
                (row.number, key, coded.digest, sums.to_bytes(), len(evidence), len(coded.data), coded.data)
                for key in keys
                for coded, sums in [bodies.get(key, (first, fingerprint(evidence, CellKey(0))))]
            ),
        )

    store._writer.run(job)
    store.recount()
