"""Commits made to take long or much: refused by their heads, or in a worker that is replaced; no other is harmed."""

import os
import resource
import signal
import struct
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import httpx
import numpy as np
import pytest
import zstandard
from tests.fixtures.server.live import DEADLINE_S, Live, Process, until
from tests.fixtures.server.processes import children_of
from tests.fixtures.server.pushes import KEYS, MOLE, WREN, pushed

from cairn_map.codec.cell_code import Profile
from cairn_map.codec.octree.cell_head import decode_head
from cairn_map.commits.commit import Commit, CommitMeta, ScanPose, make_commit
from cairn_map.commits.ids import Author, CommitId
from cairn_map.errors import UnreachableError
from cairn_map.evidence.evidence import Evidence, packed_evidence
from cairn_map.evidence.grid import Geometry, cell_key
from cairn_map.wire.messages import CreateMap
from cairn_server.sync.checks import check_pool, worker_nursery

LARGE = Geometry(depth=6, channels=())
DEEP = Geometry(depth=7, channels=())
LIMIT_S = 2.0
"""Seconds of processor time in a worker: enough for every sound commit here."""


@pytest.fixture(scope="module")
def strict(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Live]:
    """A server that sends everything to its one worker."""
    with Live(tmp_path_factory.mktemp("strict"), check_workers=1, check_cpu_s=LIMIT_S) as server:
        server.service.sync.pushes.checks.ordinary_s = 0.0
        yield server


def noise(geometry: Geometry, *, share: float = 0.02) -> Evidence:
    """A cell full of misses, with a hit in every 50th voxel: it takes long, and a model pays."""
    counts = np.ones((8**geometry.depth, 2), np.int64)
    counts[:, 0] = np.random.default_rng(0).random(len(counts)) < share
    return packed_evidence(np.arange(len(counts), dtype=np.uint32), counts, np.zeros((len(counts), 0)), geometry)


def of_cells(
    cells: int,
    *,
    n: int = 0,
    profile: Profile = Profile.FAST,
    author: Author = MOLE,
    geometry: Geometry = LARGE,
    share: float = 0.02,
) -> Commit:
    """A commit of many expensive cells."""
    pose = ScanPose(time_s=1.5e9, t_map_rig=(0.0, 0.0, 0.4), q_map_rig=(0.0, 0.0, 0.0, 1.0))
    meta = CommitMeta(id=str(CommitId(author, n)), geometry=geometry.digest().hex(), scans=(pose,) * 2)
    evidence = noise(geometry, share=share)
    return make_commit(meta, {cell_key((i, 0, 0)): evidence for i in range(cells)}, geometry, profile=profile)


def put(live: Live, name: str, commit: str, data: bytes) -> httpx.Response:
    return live.http.put(f"/maps/{name}/commits/{commit}", content=data)


def kind_of(answer: httpx.Response) -> tuple[int, str]:
    return answer.status_code, str(answer.json().get("kind"))


def bomb(commit: Commit, size_bytes: int) -> bytes:
    """Eight cells like the commit's only one, each with zeros of an eighth of this size as its first stream, and a head
    that has room for them."""
    at = commit.data.index(b"CRNC")
    body = commit.data[at:]
    head = decode_head(body)[1]
    packed = zstandard.ZstdCompressor(write_content_size=False).compress(bytes(size_bytes // 8))
    _, _, _, stored_bytes = struct.unpack_from("<BBII", body, len(head))
    rest = struct.pack("<BBII", 1, 1, size_bytes // 8, len(packed)) + packed + body[len(head) + 10 + stored_bytes :]
    sizes = struct.pack("<II", 8**7, 8**7)
    cells = [head[:12] + struct.pack("<iii", i, 0, 0) + sizes + head[32:] + rest for i in range(8)]
    return commit.data[: at - 8] + struct.pack("<I", 8) + b"".join(struct.pack("<I", len(c)) + c for c in cells)


def peak_bytes() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def test_a_zstd_bomb_is_refused_by_its_heads_without_memory(live: Live) -> None:
    geometry = Geometry(depth=7)
    row = live.new_map(geometry)
    commit = pushed(0, 1, geometry=geometry, cells={KEYS[0]: pushed_evidence(geometry)})
    data = bomb(commit, 1 << 30)
    assert len(data) < 40_000
    put(live, row.name, str(commit.id), commit.data)  # kernels and connection are warm
    before_bytes, start_s = peak_bytes(), time.process_time()
    answer = put(live, row.name, str(commit.id), data)
    assert time.process_time() - start_s < 0.5  # some 3 ms; tests/bench/server.py has the figure
    assert kind_of(answer) == (400, "too_costly")
    assert peak_bytes() - before_bytes < 64 << 20


def pushed_evidence(geometry: Geometry) -> Evidence:
    return packed_evidence(
        np.array([3, 9], np.uint32), np.array([[1, 0], [0, 1]]), np.zeros((2, geometry.plane_count)), geometry
    )


def test_modelled_numbers_are_bounded_by_the_bytes_pushed(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    row = live.new_map(LARGE)
    commit = of_cells(1, profile=Profile.SMALL)
    monkeypatch.setattr("cairn_server.sync.checks.commit_checks.NUMBERS_MAX", 1000)
    assert kind_of(live.push(row, commit)) == (400, "too_costly")
    assert live.push(row, of_cells(1)).status_code == 201


def test_a_dear_commit_is_checked_in_a_worker_and_an_ordinary_one_is_not(strict: Live, live: Live) -> None:
    row, commit = strict.new_map(), pushed(0, 1)
    assert strict.push(row, commit).status_code == 201
    assert len(workers_of(strict)) == 1
    assert strict.push(row, commit).json()["state"] == "known"
    assert kind_of(strict.push(row, pushed(0, 2))) == (409, "id_taken")
    assert live.push(live.new_map(), commit).status_code == 201
    assert workers_of(live) == []
    mirror = live.new_map()
    live.push(mirror, commit)
    assert strict.cells(row) == live.cells(mirror)


def test_what_a_worker_finds_wrong_is_the_same_problem_as_in_a_thread(strict: Live, live: Live) -> None:
    sound = pushed(0, 1)
    wrong = [sound.data[:-1], sound.data[:-40] + bytes(40), pushed(0, 1, scans=0).data]
    for data in wrong:
        answers = [put(at, at.new_map().name, str(sound.id), data) for at in (strict, live)]
        assert answers[0].status_code == 400
        assert answers[0].content == answers[1].content


def test_a_commit_that_takes_long_is_refused_and_the_worker_replaced(
    strict: Live, monkeypatch: pytest.MonkeyPatch
) -> None:
    row = strict.new_map(LARGE)
    strict.push(strict.new_map(), pushed(0, 1))
    (worker,) = workers_of(strict)
    monkeypatch.setattr(pool_of(strict), "_limit_s", 0.03)
    assert kind_of(strict.push(row, of_cells(15, profile=Profile.SMALL))) == (400, "too_costly")
    monkeypatch.undo()
    until(lambda: not is_alive(worker), "the worker is gone")
    assert strict.push(row, of_cells(3)).status_code == 201
    assert worker not in workers_of(strict)


@pytest.mark.slow
def test_a_commit_that_takes_much_memory_is_refused_and_large_workers_are_not_kept(tmp_path: Path) -> None:
    with Live(tmp_path, check_workers=1, check_memory_bytes=1 << 26) as server:
        server.service.sync.pushes.checks.ordinary_s = 0.0
        small, large, deep = server.new_map(), server.new_map(LARGE), server.new_map(DEEP)
        assert kind_of(server.push(deep, of_cells(1, geometry=DEEP, share=0.5))) == (400, "too_costly")
        assert server.push(small, pushed(0, 1)).status_code == 201
        until(lambda: len(workers_of(server)) == 1, "the one that took too much is gone")
        (before,) = workers_of(server)
        # Any number of cells takes the memory of the largest one.
        assert server.push(large, of_cells(60)).status_code == 201
        assert server.push(deep, of_cells(1, geometry=DEEP, share=0.05)).status_code == 201
        until(lambda: not is_alive(before), "it retired")
        assert server.push(small, pushed(1, 1)).status_code == 201


def test_a_worker_that_is_killed_in_the_middle_costs_one_more_try(strict: Live) -> None:
    row = strict.new_map(LARGE)
    strict.push(strict.new_map(), pushed(0, 1))
    (worker,) = workers_of(strict)
    commit = of_cells(4, profile=Profile.SMALL)
    answers: list[httpx.Response] = []
    pusher = threading.Thread(target=lambda: answers.append(strict.push(row, commit)))
    start_s = cpu_s(worker)
    pusher.start()
    until(lambda: cpu_s(worker) > start_s, "it works")
    os.kill(worker, signal.SIGKILL)
    pusher.join()
    assert answers[0].status_code == 201
    assert strict.push(row, commit).status_code == 200


def test_who_waits_too_long_for_a_worker_is_told_to_come_later(strict: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    row = strict.new_map()
    strict.push(row, pushed(0, 1))
    monkeypatch.setattr(check_pool, "WAIT_S", 0.01)
    pool = pool_of(strict)
    taken = pool._idle.get()
    try:
        answer = strict.push(row, pushed(1, 1))
        assert kind_of(answer) == (503, "busy")
        assert answer.headers["Retry-After"] == "5"
    finally:
        pool._idle.put(taken)
    others = [f"robot{n}" for n in range(1 + check_pool.WAITING_MAX)]
    for other in others:
        pool._take_place(other)
    assert kind_of(strict.push(row, pushed(2, 1))) == (503, "busy")
    for other in others:
        pool._leave_place(other)
    assert strict.push(row, pushed(1, 1, WREN)).status_code == 201


def test_one_token_leaves_places_of_expensive_checks_to_others(strict: Live) -> None:
    pool, taken = pool_of(strict), dict.fromkeys(("mole", "wren", "dove"), 0)
    for robot in taken:
        with pytest.raises(UnreachableError) as refused:
            while True:
                pool._take_place(robot)
                taken[robot] += 1
        assert refused.value.kind == "busy"
    assert list(taken.values()) == sorted(taken.values(), reverse=True)
    assert 0 < taken["dove"] <= taken["mole"] <= (1 + check_pool.WAITING_MAX + 1) // 2
    for robot, count in taken.items():
        for _ in range(count):
            pool._leave_place(robot)
    assert not pool._taken


def test_workers_that_are_always_killed_are_told_of(strict: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    row = strict.new_map()
    strict.push(row, pushed(0, 1))
    answer = check_pool._Worker.answer

    def killed(worker: check_pool._Worker, data: bytes, limit_s: float) -> dict[str, object]:
        os.kill(worker.pid, signal.SIGKILL)
        return answer(worker, data, limit_s)

    monkeypatch.setattr(check_pool._Worker, "answer", killed)
    answered = strict.push(row, pushed(1, 1))
    assert kind_of(answered) == (503, "check_failed")
    monkeypatch.undo()
    assert strict.push(row, pushed(1, 1)).status_code == 201


@pytest.mark.slow
def test_a_nursery_that_was_killed_is_made_anew(strict: Live) -> None:
    row = strict.new_map()
    strict.push(row, pushed(0, 1))
    nursery = pool_of(strict)._nursery
    assert nursery is not None
    workers = workers_of(strict)
    nursery.kill()
    until(lambda: not any(map(is_alive, workers)), "workers end with it")
    assert strict.push(row, pushed(1, 1)).status_code == 201


@pytest.mark.slow
def test_what_workers_write_to_standard_error_is_in_the_log(
    strict: Live, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    nursery = pool_of(strict)._nursery
    if nursery is not None:
        nursery.kill()
        nursery.wait()
    monkeypatch.setenv("PYTHONPROFILEIMPORTTIME", "1")
    assert strict.push(strict.new_map(), pushed(0, 1)).status_code == 201
    until(lambda: "worker: import time:" in caplog.text, "its lines are there")


@pytest.mark.processes
def test_workers_end_with_a_server_that_was_killed(tmp_path: Path) -> None:
    process = Process(tmp_path)
    assert process.url
    with httpx.Client(base_url=process.url, timeout=DEADLINE_S) as http:
        body = CreateMap(geometry=LARGE).model_dump_json().encode()
        http.put("/maps/lab", content=body, headers={"Content-Type": "application/json"}).raise_for_status()
        commit = of_cells(4, profile=Profile.SMALL)
        assert http.put(f"/maps/lab/commits/{commit.id}", content=commit.data).status_code == 201
    children = children_of(process.pid)
    name = worker_nursery.__name__.encode()
    (nursery,) = (pid for pid in children if name in Path(f"/proc/{pid}/cmdline").read_bytes())
    workers = children_of(nursery)
    assert len(workers) == 1
    process.send(signal.SIGKILL)
    process.end()
    until(lambda: not any(map(is_alive, [*children, *workers])), "all ended")


def pool_of(live: Live) -> check_pool.CheckPool:
    return live.service.sync.pushes.checks._pool


def workers_of(live: Live) -> list[int]:
    """Numbers of the processes that check commits."""
    nursery = pool_of(live)._nursery
    return children_of(nursery.pid) if nursery else []


def is_alive(pid: int) -> bool:
    return Path(f"/proc/{pid}").exists()


def cpu_s(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / check_pool.TICKS_PER_S
