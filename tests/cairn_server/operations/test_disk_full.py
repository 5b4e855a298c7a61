"""A disk that fills up under a real server: pushes are refused, reading goes on, and it recovers by itself."""

import resource
import signal
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from tests.fixtures.server.answers import kind_of
from tests.fixtures.server.live import Process, until
from tests.fixtures.server.processes import all_folded, client, make_map
from tests.fixtures.server.pushes import KEYS, pushed, read, sum_of
from tests.fixtures.server.tiny_disk import TinyDisk, tiny_disk

from cairn_client.http.api import MapApi
from cairn_map.commits.commit import Commit
from cairn_map.errors import BadInputError, UnreachableError
from cairn_map.evidence.grid import cell_of_key
from cairn_server.operations.serve import main

pytestmark = pytest.mark.processes


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[TinyDisk]:
    """Room for a store, and not for much more."""
    with tiny_disk(tmp_path / "disk", size_mb=6) as found:
        yield found


def settings_file(folder: Path, line: str) -> Path:
    """A settings file of one line."""
    path = folder / "settings.toml"
    path.write_text(line)
    return path


@pytest.mark.parametrize("line", ["disk_free_min_bytes = -1", "disk_free_min_bytes = nan", "fold_lag_max_s = 0"])
def test_a_bound_that_is_none_is_refused(line: str, tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match=line.split(" = ")[0]) as refused:
        main(["--data", str(tmp_path), "--settings", str(settings_file(tmp_path, line))])
    assert refused.value.kind == "bad_setting"


def push(http: httpx.Client, commit: Commit) -> httpx.Response:
    return http.put(f"/maps/lab/commits/{commit.id}", content=commit.data)


def push_until_full(http: httpx.Client, first: int) -> tuple[list[Commit], httpx.Response]:
    """Acknowledged commits, and the first refusal."""
    acked: list[Commit] = []
    for n in range(first, first + 3000):
        answer = push(http, commit := pushed(n, n % 5))
        if answer.status_code != 201:
            return acked, answer
        acked.append(commit)
    raise AssertionError("the disk never became full")


def assert_refusal(answer: httpx.Response) -> None:
    assert (answer.status_code, kind_of(answer)) == (507, "disk_full")
    assert int(answer.headers["Retry-After"]) > 0


def assert_map_is(http: httpx.Client, commits: list[Commit]) -> None:
    """The map is the sum of these, once all is folded."""
    vector = all_folded(http).coverage
    assert all(commit.id in vector for commit in commits)
    bodies = {key: http.get(f"/maps/lab/main/cells/{cell_of_key(key)}").content for key in KEYS}
    assert read(bodies) == sum_of(commits)


def test_a_full_disk_refuses_pushes_keeps_what_was_acknowledged_and_recovers(disk: TinyDisk, tmp_path: Path) -> None:
    settings = settings_file(tmp_path, "disk_free_min_bytes = 0")
    process = Process(disk.folder / "data", "--settings", str(settings))
    with client(process) as http:
        make_map(http)
        kept = [pushed(n, n) for n in range(5)]
        assert {push(http, commit).status_code for commit in kept} == {201}
        all_folded(http)
        disk.fill()
        more, refusal = push_until_full(http, 5)
        assert_refusal(refusal)
        assert "disk_full" in ready_reasons(http)
        assert http.get("/maps/lab").status_code == 200
        assert http.get(f"/maps/lab/main/cells/{cell_of_key(KEYS[0])}").status_code == 200
        assert http.post("/maps/lab/branches/mole/missing", json={}).status_code == 200
        with MapApi(str(process.url)) as api, pytest.raises(UnreachableError) as told:
            api.push("lab", pushed(9000, 0))
        assert (told.value.kind, told.value.retry_after_s) == ("disk_full", 30.0)
        disk.make_room()
        until(lambda: push(http, pushed(4000, 4)).status_code in (200, 201), "there is room again")
        until(lambda: http.get("/readyz").status_code == 200, "it is ready again")
        assert_map_is(http, [*kept, *more, pushed(4000, 4)])
    process.send(signal.SIGTERM)
    code, complaints = process.end()
    assert code == 0
    assert "the server's disk is full" in complaints
    assert "Traceback" not in complaints


def ready_reasons(http: httpx.Client) -> str:
    """Complaints of `/readyz`, which looks again every second."""
    until(lambda: http.get("/readyz").status_code == 503, "it is not ready")
    answer = http.get("/readyz")
    assert kind_of(answer) == "not_ready"
    return str(answer.json()["detail"])


def test_space_is_kept_free_in_which_what_was_acknowledged_is_folded(disk: TinyDisk, tmp_path: Path) -> None:
    settings = settings_file(tmp_path, "disk_free_min_bytes = 4_718_592")
    process = Process(disk.folder / "data", "--settings", str(settings))
    with client(process) as http:
        make_map(http)
        assert http.get("/readyz").json() == {"status": "ready"}
        acked, refusal = push_until_full(http, 0)
        assert_refusal(refusal)
        assert "keeps 4718592" in refusal.json()["detail"]
        assert ready_reasons(http).startswith("disk_full: ")
        assert_map_is(http, acked)
    process.send(signal.SIGTERM)
    assert process.end()[0] == 0


def test_a_file_that_may_not_grow_is_a_full_disk_too(tmp_path: Path) -> None:
    """Everywhere, and another error of the system than a full disk's: quotas and limits fail so."""
    process = Process(tmp_path)
    with client(process) as http:
        make_map(http)
        assert push(http, pushed(0, 0)).status_code == 201
        all_folded(http)
        before = resource.prlimit(process.pid, resource.RLIMIT_FSIZE)
        resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (400_000, before[1]))
        acked, refusal = push_until_full(http, 1)
        assert_refusal(refusal)
        assert "disk_full" in ready_reasons(http)
        assert http.get(f"/maps/lab/main/cells/{cell_of_key(KEYS[0])}").status_code == 200
        resource.prlimit(process.pid, resource.RLIMIT_FSIZE, before)
        until(lambda: push(http, pushed(4000, 4)).status_code in (200, 201), "it may grow again")
        assert_map_is(http, [pushed(0, 0), *acked, pushed(4000, 4)])
    process.send(signal.SIGTERM)
    assert process.end()[0] == 0
