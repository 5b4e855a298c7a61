"""Memory of the server's caches: their share of the server's limit, which is said at the start."""

import signal
from pathlib import Path

import pytest
from tests.fixtures.server.live import Live, Process

from cairn_server.folding import fold_memory, read_cache
from cairn_server.memory_shares import CACHES_BYTES, CACHES_MIN_BYTES, LIMIT_MIN_BYTES, PROGRAMS_BYTES, memory_shares
from cairn_server.views import hot_spot_search, map_views


def test_the_standard_sizes_of_all_caches_add_up() -> None:
    of_reading = (read_cache.EVIDENCE_BYTES, read_cache.STAMPS_BYTES, read_cache.CHANGES_BYTES, read_cache.DIFFS_BYTES)
    of_spots = (hot_spot_search.PIECES_BYTES, hot_spot_search.WITNESSES_BYTES)
    of_views = (map_views.CELLS_BYTES, map_views.GROUND_BYTES, map_views.LISTS_BYTES, *of_spots)
    assert sum((fold_memory.CACHE_BYTES, *of_reading, read_cache.HISTORIES_BYTES, *of_views)) == CACHES_BYTES


def test_each_cache_has_its_share(tmp_path: Path) -> None:
    with Live(tmp_path, memory_bytes=LIMIT_MIN_BYTES) as live:
        service = live.service
        share = CACHES_MIN_BYTES / CACHES_BYTES
        caches = service.sync.replies._cache
        assert service._fold_thread._local._memory.cells_bytes == int(share * fold_memory.CACHE_BYTES)
        assert caches._evidence._limit_bytes == int(share * read_cache.EVIDENCE_BYTES)
        assert caches.changes._limit_bytes == int(share * read_cache.CHANGES_BYTES)
        assert service.views.pictures._read_cells._limit_bytes == int(share * map_views.CELLS_BYTES)
        assert service.views.hot_spots._pieces._limit_bytes == int(share * hot_spot_search.PIECES_BYTES)


def test_a_server_that_only_folds_keeps_cells_where_others_have_checks_bodies_and_caches(tmp_path: Path) -> None:
    shares = memory_shares()
    memory = fold_memory.FoldMemory.of_server(shares, tmp_path, is_all=True)
    rest_bytes = PROGRAMS_BYTES + shares.decoding_bytes + shares.folding_bytes
    assert memory.cells_bytes + rest_bytes == shares.sum_bytes <= shares.limit_bytes


@pytest.mark.processes
def test_the_limit_is_said_at_the_start(tmp_path: Path) -> None:
    server = Process(tmp_path / "data")
    try:
        assert server._process.stdout is not None
        assert server._process.stdout.readline() == f"{memory_shares().text()}\n"
    finally:
        server.send(signal.SIGTERM)
        server.end()
