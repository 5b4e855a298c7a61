"""What branches of any age cost: finding what they miss, the answer, the space of stamps, and of commits that went."""

import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import apsw
from tests.bench.pushing import Bodies, Diff
from tests.bench.timing import cpu_s

from cairn_map.commits.cursor import Cursor
from cairn_map.evidence.grid import Geometry
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_map.wire.frames import CellFrame, frames_of
from cairn_map.wire.messages import MissingRequest
from cairn_server.folding.cell_cache import CellCache
from cairn_server.folding.folding import fold_pending
from cairn_server.folding.read_cache import ReadCache
from cairn_server.service import Service
from cairn_server.settings import Settings
from cairn_server.store.sqlite.store import FILE_NAME, SqliteStore
from cairn_server.store.stamps import blocks_after
from cairn_server.store.store_rows import MapRow
from cairn_server.sync.asked_cells import Asked, asked_of

Row = tuple[str, str, str]


def fetching_rows(diffs: list[Diff], geometry: Geometry, smoke: bool) -> Iterator[Row]:
    """One line each."""
    ages = (1, 10) if smoke else (1, 10, 100, 1000)
    with tempfile.TemporaryDirectory() as folder:
        store = SqliteStore(Path(folder))
        row, _ = store.create_map("lab", geometry, SensorModel())
        bodies = Bodies(diffs, geometry)
        cursors = _folded(store, row, bodies, len(diffs), max(ages))
        with store.snapshot(row) as snapshot:
            cells = [cell for listed in snapshot.cells() if (cell := snapshot.cell(listed.key))]
        voxels, size_bytes = sum(cell.voxels for cell in cells), sum(cell.size_bytes for cell in cells)
        yield f"a map of {len(cells)} cells, {max(ages) + len(diffs)} commits", f"{voxels}", f"voxels, {size_bytes} B"
        stamps = sum(len(cell.stamps) for cell in cells)
        yield "  stamps of its blocks", f"{stamps}", f"B = {100 * stamps / size_bytes:.1f} % of it; 0 a branch"
        store.close()
        service = Service(SqliteStore(Path(folder)), Settings(folder=Path(folder)))
        try:
            last_bytes = len(bodies.body("mole", len(diffs) + max(ages) - 1))
            for age in ages:
                yield from _age_rows(service, row, cursors[-1 - age], age, last_bytes)
        finally:
            service.close()
    yield from _growth_rows(bodies, geometry, commits=200 if smoke else 10_000)


def _folded(store: SqliteStore, row: MapRow, bodies: Bodies, first: int, more: int) -> list[Cursor]:
    """The head after each commit: the first ones in one group, the others one by one."""
    cache, cursors = CellCache(row.geometry), []
    for n in range(first + more):
        store.append(row, bodies.commit("mole", n))
        if n >= first - 1:
            fold_pending(store, row, cache, limit=first)
            with store.snapshot(row) as snapshot:
                cursors.append(snapshot.head)
    return cursors


def _answer(service: Service, row: MapRow, asked: Asked) -> bytes:
    return b"".join(service.sync.replies.missing(row, "wren", asked).parts())


def _age_rows(service: Service, row: MapRow, cursor: Cursor, age: int, last_bytes: int) -> Iterator[Row]:
    asked = asked_of(MissingRequest(cursor=str(cursor), kinds=["delta", "state", "full"]))
    start_s = time.process_time()
    answer = _answer(service, row, asked)
    cold_s = time.process_time() - start_s
    warm_s = cpu_s(lambda: _answer(service, row, asked), 3)
    frames = [frame for frame in frames_of(answer) if isinstance(frame, CellFrame)]
    kinds = {frame.kind.name.lower(): 0 for frame in frames}
    for frame in frames:
        kinds[frame.kind.name.lower()] += 1
    shown = ", ".join(f"{count} {kind}" for kind, count in sorted(kinds.items()))
    own = f"; {len(answer) / last_bytes:.2f} of the commit" if age == 1 else ""
    times = f"ms ({1e3 * cold_s:.0f} at first), {len(answer)} B: {shown}{own}"
    yield f"  {age} commits behind, the whole answer", f"{1e3 * warm_s:.0f}", times
    with service.store.snapshot(row) as snapshot:
        cache = ReadCache()
        listed = [cell for cell in snapshot.cells() if cell.lm > cursor.seq]

        def find() -> int:
            found = 0
            for cell in listed:
                stamps = cache.stamps(snapshot, cell, row.geometry)
                changed = cache.evidence(snapshot, cell, row.layer).of_blocks(blocks_after(stamps, cursor.seq))
                found += sum(map(len, changed.rows.values()))
            return found

        start_s = time.process_time()
        found = find()
        first_s = time.process_time() - start_s
        found_s = cpu_s(find, 5)
    how = f"ms, {found} of them ({1e3 * first_s:.0f} ms with cells from disk)"
    yield "    finding the changed voxels", f"{1e3 * found_s:.1f}", how


def _growth_rows(bodies: Bodies, geometry: Geometry, *, commits: int) -> Iterator[Row]:
    """With nothing kept but the last version: what each commit leaves behind beside the cells."""
    with tempfile.TemporaryDirectory() as folder:
        store = SqliteStore(Path(folder))
        row, _ = store.create_map("lab", geometry, SensorModel())
        cache = CellCache(geometry)
        sizes = []
        for n in range(commits + 200):
            store.append(row, bodies.commit("mole", n))
            if n % 50 == 49:
                fold_pending(store, row, cache, limit=50)
                store.forget_evidence(row, before_s=float("inf"), limit=50)
            if n in (199, commits + 199):
                sizes.append(_used_bytes(Path(folder)))
        store.close()
    yield (
        f"bytes of all but cells, per commit of {commits} with nothing kept",
        f"{(sizes[1] - sizes[0]) / commits:.0f}",
        "B",
    )


def _used_bytes(folder: Path) -> int:
    """Pages in use, without those of the cells, as they would be after VACUUM."""
    connection = apsw.Connection(str(folder / FILE_NAME))
    copy = apsw.Connection(":memory:")
    with copy.backup("main", connection, "main") as backup:
        backup.step()
    copy.execute("UPDATE cell SET body = x'', stamps = x''")
    copy.execute("VACUUM")
    used = copy.pragma("page_count") * copy.pragma("page_size")
    connection.close()
    copy.close()
    return int(used)
