"""Memory of the server's caches: a quarter of the machine's at most, unless told otherwise, and said at the start."""

import signal
from pathlib import Path

import pytest
from tests.fixtures.server.live import Live, Process

from cairn_map.machine_memory import memory_bytes
from cairn_server.folding import cell_cache, read_cache
from cairn_server.settings import CACHES_BYTES, Settings
from cairn_server.views import map_views


def test_the_standard_sizes_of_all_caches_add_up() -> None:
    of_reading = (read_cache.EVIDENCE_BYTES, read_cache.STAMPS_BYTES, read_cache.CHANGES_BYTES)
    of_views = (map_views.CELLS_BYTES, map_views.LISTS_BYTES)
    assert sum((cell_cache.CACHE_BYTES, *of_reading, read_cache.HISTORIES_BYTES, *of_views)) == CACHES_BYTES


def test_caches_take_a_quarter_of_the_memory_at_most(monkeypatch: pytest.MonkeyPatch) -> None:
    assert Settings().caches_bytes == min(CACHES_BYTES, memory_bytes() // 4)
    monkeypatch.setattr("cairn_map.machine_memory.memory_bytes", lambda: 1 << 30)
    assert Settings().caches_bytes == 1 << 28
    assert Settings(memory_bytes=1 << 27).cache_share == (1 << 27) / CACHES_BYTES
    assert Settings(memory_bytes=1 << 40).cache_share == 1


def test_each_cache_has_its_share(tmp_path: Path) -> None:
    with Live(tmp_path, memory_bytes=CACHES_BYTES // 4) as live:
        service = live.service
        caches = service.sync.replies._cache
        assert service._fold_thread._local._cells_bytes == cell_cache.CACHE_BYTES // 4
        assert caches._evidence._limit_bytes == read_cache.EVIDENCE_BYTES // 4
        assert caches.changes._limit_bytes == read_cache.CHANGES_BYTES // 4
        assert service.views.pictures._read_cells._limit_bytes == map_views.CELLS_BYTES // 4


@pytest.mark.processes
def test_the_limit_is_said_at_the_start(tmp_path: Path) -> None:
    server = Process(tmp_path / "data")
    try:
        assert server._process.stdout is not None
        most_mb = min(CACHES_BYTES, memory_bytes() // 4) / 1e6
        assert server._process.stdout.readline() == f"memory for decoded cells: at most {most_mb:.0f} MB\n"
    finally:
        server.send(signal.SIGTERM)
        server.end()
