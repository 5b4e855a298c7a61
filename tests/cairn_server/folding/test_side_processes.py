"""The server's side processes: what they do is what it does without them, and it can be without them."""

import os
import shutil
import signal
import subprocess
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from multiprocessing import Pipe
from pathlib import Path

import httpx
import pytest
from tests.fixtures.map.made import SMALL
from tests.fixtures.server.damage import BROKEN, damage, raising
from tests.fixtures.server.live import DEADLINE_S, Live, Process, until
from tests.fixtures.server.processes import children_of
from tests.fixtures.server.pushes import KEYS, pushed

from cairn_map.commits.commit import Commit
from cairn_map.errors import UnreachableError
from cairn_map.evidence.grid import cell_of_key
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_map.wire.messages import CreateMap, MapInfo
from cairn_server.folding.damaged_cells import DamagedCells
from cairn_server.folding.fold_memory import FoldMemory
from cairn_server.folding.fold_process import FoldProcess, LostProcessError, answer_folds
from cairn_server.store.sqlite.reads import SqliteReads
from cairn_server.store.sqlite.store import SqliteStore

pytestmark = pytest.mark.processes

COMMITS = [pushed(n, n) for n in range(12)]
JSON = {"Content-Type": "application/json"}


@pytest.fixture
def process(tmp_path: Path) -> Iterator[Process]:
    """A server with its processes, and a map called lab."""
    made = Process(tmp_path)
    assert made.url
    body = CreateMap(geometry=SMALL).model_dump_json().encode()
    httpx.put(f"{made.url}/maps/lab", content=body, headers=JSON).raise_for_status()
    yield made
    made.send(signal.SIGTERM)
    made.end()


def push(process: Process, *commits: Commit) -> None:
    for commit in commits:
        answer = httpx.put(f"{process.url}/maps/lab/commits/{commit.id}", content=commit.data, timeout=DEADLINE_S)
        assert answer.status_code == 201


def cells_when_folded(process: Process, entries: int) -> dict[int, bytes]:
    def seq() -> int:
        info = MapInfo.model_validate_json(httpx.get(f"{process.url}/maps/lab").content)
        return int(info.cursor.split(".")[1])

    until(lambda: seq() == entries, "all is folded")
    found: dict[int, bytes] = {}
    for key in KEYS:
        i, j, k = cell_of_key(key)
        answer = httpx.get(f"{process.url}/maps/lab/main/cells/{i},{j},{k}")
        if answer.status_code == 200:
            found[key] = answer.content
    return found


def cells_of(live: Live, *commits: Commit) -> dict[int, bytes]:
    row = live.new_map()
    for commit in commits:
        assert live.push(row, commit).status_code == 201
    return live.cells(row)


def test_cells_are_those_of_a_server_without_processes(process: Process, live: Live) -> None:
    push(process, *COMMITS)
    assert cells_when_folded(process, len(COMMITS)) == cells_of(live, *COMMITS)
    gone = {"commits": [str(COMMITS[3].id), str(COMMITS[7].id)]}
    httpx.post(f"{process.url}/maps/lab/retracts", json=gone).raise_for_status()
    left = [commit for n, commit in enumerate(COMMITS) if n not in (3, 7)]
    assert cells_when_folded(process, len(COMMITS) + 3) == cells_of(live, *left)


def test_a_server_whose_processes_were_killed_goes_on(process: Process, live: Live) -> None:
    push(process, *COMMITS[:4])
    cells_when_folded(process, 4)
    for child in children_of(process.pid):
        os.kill(child, signal.SIGKILL)
    push(process, *COMMITS[4:])
    assert cells_when_folded(process, len(COMMITS)) == cells_of(live, *COMMITS)
    cut = COMMITS[0].data[:-1]
    assert httpx.put(f"{process.url}/maps/lab/commits/{COMMITS[0].id}", content=cut).status_code == 400
    assert httpx.get(f"{process.url}/readyz").status_code == 200


def test_they_work_for_the_first_process_of_a_container(tmp_path: Path) -> None:
    alone = ("unshare", "--pid", "--fork", "--kill-child")
    if shutil.which("unshare") is None or subprocess.run([*alone, "true"], check=False).returncode:
        pytest.skip("this machine makes no namespace of processes for us")
    made = Process(tmp_path, under=alone)
    (server,) = children_of(made.pid)
    assert len(children_of(server)) == 2  # the one that folds, and the one that parses long bodies
    httpx.put(f"{made.url}/maps/lab", content=CreateMap(geometry=SMALL).model_dump_json().encode(), headers=JSON)
    push(made, *COMMITS)
    cells_when_folded(made, len(COMMITS))
    assert len(children_of(server)) == 2
    os.kill(server, signal.SIGTERM)
    assert "killed" not in made.end()[1]


def test_what_the_process_refuses_is_refused_in_the_same_words(process: Process, live: Live) -> None:
    live.service.maps.create("lab", CreateMap(geometry=SMALL))
    row = live.service.store.map("lab")
    for at in range(0, len(COMMITS[0].data), 41):
        data = bytearray(COMMITS[0].data)
        data[at] ^= 0x55
        there = httpx.put(f"{process.url}/maps/lab/commits/{COMMITS[0].id}", content=bytes(data))
        here = live.http.put(f"/maps/{row.name}/commits/{COMMITS[0].id}", content=bytes(data))
        assert (there.status_code, there.content) == (here.status_code, here.content)


@pytest.fixture
def far(tmp_path: Path) -> Iterator[tuple[SqliteStore, FoldProcess]]:
    """A store, and what folds it from the other end of a pipe, through which no encoded cell comes, only their file."""
    store = SqliteStore(tmp_path)
    ours, theirs = Pipe()
    thread = threading.Thread(
        target=answer_folds, args=(theirs, SqliteReads(store._readers), FoldMemory(spool_bytes=0, folder=tmp_path))
    )
    thread.start()
    process = FoldProcess(ours, pid=None)
    yield store, process
    process.close()
    thread.join()
    theirs.close()
    store.close()


def test_a_fold_that_cannot_be_written_is_told_as_it_is_and_tried_again(
    far: tuple[SqliteStore, FoldProcess], live: Live, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store, process = far
    with Live(tmp_path, store=store) as served:
        monkeypatch.setattr(served.service._fold_thread, "_fold_group", lambda *arguments: 0)
        row = served.new_map()
        for commit in COMMITS:
            served.push(row, commit)
        with monkeypatch.context() as full:
            full.setattr(store, "fold", raising(UnreachableError("disk_full", "the disk is full")))
            with pytest.raises(UnreachableError, match="the disk is full"):
                process.fold(row, store, DamagedCells())
        assert process.fold(row, store, DamagedCells()).commits == len(COMMITS)
        assert process.fold(row, store, DamagedCells()).commits == 0
        assert served.cells(row) == cells_of(live, *COMMITS)


def test_a_process_that_is_gone_is_told_from_a_fold_that_fails(far: tuple[SqliteStore, FoldProcess]) -> None:
    store, process = far
    row, _ = store.create_map("lab", SMALL, SensorModel())
    assert process.fold(row, store, DamagedCells()).commits == 0
    process._link.close()
    with pytest.raises(LostProcessError):
        process.fold(row, store, DamagedCells())


def test_damage_is_noted_and_folded_around_from_afar(
    far: tuple[SqliteStore, FoldProcess], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store, process = far
    with Live(tmp_path, store=store) as served:
        row, damaged = served.new_map(), DamagedCells()
        served.push(row, COMMITS[0])
        served.folded(row)
        monkeypatch.setattr(served.service._fold_thread, "_fold_group", lambda *arguments: 0)
        for commit in COMMITS[1:]:
            served.push(row, commit)
        damage(served, "UPDATE cell SET body = x'00' WHERE map = ? AND cell = ?", row.number, BROKEN)
        damage(
            served,
            "UPDATE diff SET body = NULL WHERE cell = ? AND commit_number = (SELECT min(number) FROM commits)",
            BROKEN,
        )
        folded = process.fold(row, store, damaged)
        assert folded.commits == sum(BROKEN not in commit.cells for commit in COMMITS[1:])
        assert folded.waits_for is not None
        assert folded.waits_for.kind == "damaged_store"
        assert damaged.of(row.name) == {BROKEN}
        served.push(row, pushed(40, 1))  # in the other two cells, and damaged at rest before it is folded
        damage(served, "UPDATE diff SET body = x'00' WHERE commit_number = (SELECT max(number) FROM commits)")
        process.fold(row, store, damaged)
        noted = lambda: [entry.what for entry in store.audit_log.page(after=0, limit=100)]  # noqa: E731
        until(lambda: "damaged_commit" in noted(), "the audit log says so")


def test_robots_that_come_at_the_same_moment_do_not_end_the_process(process: Process) -> None:
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda commit: push(process, commit), COMMITS[:8]))
    before = children_of(process.pid)
    push(process, *COMMITS[8:])
    assert len(before) == len(children_of(process.pid)) == 2
    assert "killed" not in process.said()
