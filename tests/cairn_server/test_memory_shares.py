"""One memory limit for all processes of the server: a law of its shares, and a real server under load within it."""

import re
import signal
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import httpx
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.fixtures.map.costly import air, dust
from tests.fixtures.map.made import made_meta
from tests.fixtures.server.live import PROGRAM, Live, Process, until
from tests.fixtures.server.memory_watch import MemoryWatch

from cairn_map.commits.commit import make_commit
from cairn_map.commits.cursor import cursor_from_text
from cairn_map.errors import BadInputError
from cairn_map.evidence.evidence import Evidence, packed_evidence
from cairn_map.evidence.grid import Geometry, cell_key
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_map.wire.messages import CreateMap
from cairn_server import memory_shares
from cairn_server.memory_shares import LIMIT_MIN_BYTES
from cairn_server.settings import Settings

GB = 10**9
PLAIN = Geometry(channels=())
FULL = Geometry()
"""Of which a full cell needs all the memory that the smallest server has for it."""
QUARTERS = 4


@pytest.fixture(autouse=True, scope="module")
def _large_machine() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(memory_shares, "memory_bytes", lambda: 1 << 44)
        yield


@given(st.integers(LIMIT_MIN_BYTES, 1 << 42))
def test_the_shares_add_up_to_the_limit_at_most_and_none_is_too_small_to_work(limit_bytes: int) -> None:
    shares = memory_shares.memory_shares(limit_bytes)
    assert shares.sum_bytes <= shares.limit_bytes == limit_bytes
    assert shares.bodies_bytes // 2 >= 1 << 26  # a commit of one token
    assert shares.check_bytes >= memory_shares.CHECKS_MIN_BYTES
    assert shares.caches_bytes >= memory_shares.CACHES_MIN_BYTES
    more = memory_shares.memory_shares(2 * limit_bytes)
    assert more.bodies_bytes >= shares.bodies_bytes
    assert more.caches_bytes >= shares.caches_bytes
    assert more.check_workers * more.check_bytes >= shares.check_workers * shares.check_bytes


def test_the_limit_is_a_quarter_of_the_machine_and_never_too_small(monkeypatch: pytest.MonkeyPatch) -> None:
    for machine_bytes, limit_bytes in ((16 * GB, 4 * GB), (11 * GB, 11 * GB // 4), (1 * GB, LIMIT_MIN_BYTES)):
        monkeypatch.setattr("cairn_map.machine_memory.memory_bytes", lambda found=machine_bytes: found)
        assert Settings().memory.limit_bytes == limit_bytes
    with pytest.raises(BadInputError, match="memory_bytes is 1000000000; the server's processes need"):
        Settings(memory_bytes=GB).memory  # noqa: B018 - it raises
    with pytest.raises(BadInputError, match="more than the 17592186044416 bytes of this machine"):
        Settings(memory_bytes=1 << 45).memory  # noqa: B018 - it raises
    assert "(the least that it needs)" in memory_shares.memory_shares(LIMIT_MIN_BYTES).text()


def test_a_map_of_cells_that_do_not_fit_is_not_made_and_one_that_exists_goes_on(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    deep = Geometry(depth=8)
    body, as_json = CreateMap(geometry=deep).model_dump_json(), {"Content-Type": "application/json"}
    with Live(tmp_path, memory_bytes=LIMIT_MIN_BYTES) as live:
        refused = live.http.put("/maps/deep", content=body, headers=as_json)
        assert (refused.status_code, refused.json()["kind"]) == (400, "cell_too_large")
        assert live.http.get("/maps").json() == []
        # As a server with more memory made it.
        live.service.store.create_map("deep", deep, SensorModel())
        assert live.http.put("/maps/deep", content=body, headers=as_json).status_code == 200
    with Live(tmp_path, memory_bytes=LIMIT_MIN_BYTES):
        assert [text for text in caplog.messages if "map deep may take more memory than memory_bytes" in text]


def test_parts_that_are_set_are_taken_from_the_caches_or_refused() -> None:
    plain = Settings(memory_bytes=4 * GB).memory
    own = Settings(memory_bytes=4 * GB, check_workers=1, check_memory_bytes=GB, body_memory_bytes=1 << 20).memory
    assert (own.check_workers, own.check_bytes, own.bodies_bytes) == (1, GB, 1 << 20)
    assert own.caches_bytes == plain.caches_bytes
    wide = Settings(memory_bytes=4 * GB, body_memory_bytes=plain.bodies_bytes + 10**8).memory
    assert wide.sum_bytes <= 4 * GB
    with pytest.raises(BadInputError, match="leave no memory"):
        Settings(memory_bytes=4 * GB, check_workers=9).memory  # noqa: B018 - it raises


def sampled(geometry: Geometry, quarter: int) -> Evidence:
    """A quarter of a cell, with a sample of each channel in each voxel, no two alike."""
    count, rng = 8**geometry.depth // QUARTERS, np.random.default_rng(quarter)
    counts, samples = np.zeros((count, 2), np.int64), rng.integers(1, 200, (count, geometry.plane_count))
    counts[np.arange(count), rng.integers(0, 2, count)] = 1
    for channel in geometry.channels:
        own = samples[:, geometry.planes_of(channel.name)]
        own[:, -1] = 1
        if "square_sum" in channel.planes:
            own[:, 1] = own[:, 0] ** 2
    return packed_evidence(np.arange(count, dtype=np.uint32) + quarter * count, counts, samples, geometry)


@pytest.mark.processes
def test_all_processes_stay_within_the_limit_that_was_said(tmp_path: Path) -> None:
    settings = tmp_path / "server.toml"
    settings.write_text(f"memory_bytes = {LIMIT_MIN_BYTES}\n")
    server = Process(tmp_path / "data", "--settings", str(settings), under=PROGRAM)
    assert server.url is not None
    watch = MemoryWatch(server.pid)
    try:
        with httpx.Client(base_url=server.url, timeout=120) as http:
            work: list[tuple[str, bytes]] = []
            for name, geometry, cells in (
                ("plain", PLAIN, [{cell_key((0, 0, 0)): air(PLAIN)}, {cell_key((1, 0, 0)): dust(PLAIN)}]),
                (
                    "full",
                    FULL,
                    [{cell_key((n // QUARTERS, 0, 0)): sampled(FULL, n % QUARTERS)} for n in range(QUARTERS + 1)],
                ),
            ):
                body = CreateMap(geometry=geometry).model_dump_json()
                http.put(f"/maps/{name}", content=body, headers={"Content-Type": "application/json"}).raise_for_status()
                for n, diff in enumerate(cells):
                    commit = make_commit(made_meta(geometry, n), diff, geometry)
                    work.append((f"/maps/{name}/commits/{commit.id}", commit.data))

            def push(path: str, data: bytes) -> None:
                until(lambda: http.put(path, content=data).status_code == 201, f"{path} is taken")

            def look(path: str) -> None:
                answer = http.get(path)
                assert answer.status_code in (200, 503), answer.text

            with ThreadPoolExecutor(8) as pool:
                list(pool.map(lambda each: push(*each), work))
                until(lambda: _folded(http) == len(work), "all are folded")
                views = [f"/maps/{name}/main/cells/{n},0,0.view" for name in ("plain", "full") for n in range(2)]
                list(pool.map(look, views * 2))
            said = http.get("/metrics").text
        found = re.search(r"^cairn_memory_limit_bytes (\S+)$", said, re.MULTILINE)
        assert found
        assert float(found[1]) == LIMIT_MIN_BYTES
        assert 200e6 < watch.end() < LIMIT_MIN_BYTES
    finally:
        watch.end()
        server.send(signal.SIGTERM)
        server.end()


def _folded(http: httpx.Client) -> int:
    return sum(cursor_from_text(http.get(f"/maps/{name}").json()["cursor"]).seq for name in ("plain", "full"))
