"""`GET /metrics`: what is counted, and that it is the format that Prometheus reads."""

import math
import re
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from prometheus_client import CollectorRegistry, Counter, Histogram
from tests.fixtures.server.access import register
from tests.fixtures.server.epoch_contract import cell_of, fold_by_hand
from tests.fixtures.server.live import Live, until
from tests.fixtures.server.prometheus_text import families_of, value
from tests.fixtures.server.protocol_document import DOCUMENT, ROOT
from tests.fixtures.server.pushes import KEYS, MOLE, pushed

from cairn_server import metrics
from cairn_server.folding import fold_thread, group_folding
from cairn_server.metrics import Bounded, metrics_text
from cairn_server.store.backup_note import NOTE_NAME, note_backup

PUSH = "/maps/{name}/commits/{commit}"


@pytest.fixture
def fresh(tmp_path: Path) -> Iterator[Live]:
    """A server that has counted nothing yet."""
    with Live(tmp_path) as server:
        yield server


def text_of(live: Live) -> str:
    answer = live.http.get("/metrics")
    assert answer.headers["Content-Type"] == metrics.MEDIA_TYPE
    return answer.text


def test_the_names_in_the_document_are_those_of_the_page(live: Live) -> None:
    section = DOCUMENT.split("### 4.4")[1].split("## 5.")[0]
    named = [part.strip("` ") for line in section.splitlines() if "_" in line for part in line.split("|")[1:2]]
    names = {name for text in named for name in text.replace("`", "").split(", ") if name.startswith(("cairn", "proc"))}
    assert names == set(families_of(text_of(live)))


def test_the_alarms_in_the_handbook_are_about_figures_that_there_are(live: Live) -> None:
    names = set(re.findall(r"cairn_[a-z_]+", (ROOT / "docs" / "administrator.md").read_text()))
    assert names - {"cairn_server"} <= set(families_of(text_of(live)))


def test_pushes_are_counted_by_outcome_with_their_bytes(fresh: Live) -> None:
    row = fresh.new_map()
    commit = pushed(0, 0)
    for _ in range(3):
        fresh.push(row, commit)
    fresh.push(row, pushed(0, 1))
    fresh.http.put("/maps/no-such-map/commits/x", content=b"x")
    text = text_of(fresh)
    assert value(text, "cairn_pushes_total", map=row.name, outcome="new") == 1
    assert value(text, "cairn_pushes_total", map=row.name, outcome="known") == 2
    assert value(text, "cairn_pushes_total", map="", outcome="id_taken") == 1
    assert value(text, "cairn_pushes_total", map="", outcome="no_map") == 1
    assert value(text, "cairn_push_bytes_total", map=row.name) == len(commit.data)
    assert value(text, "cairn_errors_total", kind="id_taken") == 1
    assert value(text, "cairn_http_received_bytes_total", method="PUT", route=PUSH) >= 4 * len(commit.data)
    assert value(text, "cairn_http_requests_total", method="PUT", route=PUSH, status="200") == 2
    assert value(text, "cairn_http_request_duration_seconds_count", method="PUT", route=PUSH) == 5


def test_what_each_robot_brings_and_is_refused_is_counted_under_its_name(tmp_path: Path) -> None:
    admin = {"Authorization": "Bearer " + "a" * 20}
    with Live(tmp_path, admin_token="a" * 20, metrics_open=True) as live:
        row, other = live.new_map(), live.new_map()
        body = {"robot": "mole", "incarnation": MOLE.incarnation}
        token = live.http.post(f"/maps/{row.name}/branches", json=body, headers=admin).json()["token"]
        mole = {"Authorization": f"Bearer {token}"}
        commit = pushed(0, 0)
        for _ in range(2):
            live.push(row, commit, headers=mole)
        assert live.push(row, pushed(0, 1), headers=mole).status_code == 409
        assert live.push(other, commit, headers=mole).status_code == 401
        assert live.http.get(f"/maps/{row.name}/main/cells/9,9,9", headers=mole).status_code == 404
        live.push(row, pushed(1, 1), headers=admin)
        text = text_of(live)
    at = {"map": row.name, "robot": "mole"}
    assert value(text, "cairn_robot_commits_total", **at) == 1
    assert value(text, "cairn_robot_commit_bytes_total", **at) == len(commit.data)
    refusals = families_of(text)["cairn_robot_refusals_total"].samples
    assert [dict(labels) for _, labels in refusals] == [{**at, "kind": "id_taken"}]


def test_a_server_that_is_not_ready_says_so_in_its_figures(fresh: Live) -> None:
    assert value(text_of(fresh), "cairn_ready") == 1
    fresh.service.readiness.close()
    assert value(text_of(fresh), "cairn_ready") == 0


def test_frames_are_counted_by_kind(fresh: Live) -> None:
    row = fresh.new_map()
    fresh.push(row, pushed(0, 0))
    fresh.folded(row)
    reply = fresh.http.post(f"/maps/{row.name}/branches/mole/missing", json={})
    text = text_of(fresh)
    assert value(text, "cairn_fetch_frames_total", kind="full") == 2
    assert 0 < value(text, "cairn_fetch_frame_bytes_total", kind="full") < len(reply.content)
    assert value(text, "cairn_fetch_frames_total", kind="delta") == 0


def test_what_waits_to_be_folded_shows_until_it_is(fresh: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    row = fresh.new_map()
    monkeypatch.setattr(fold_thread, "RETRY_S", 0.01)
    with monkeypatch.context() as broken:
        broken.setattr(group_folding, "fold_around", _no_memory)
        fresh.push(row, pushed(0, 0))
        begin_s = time.monotonic()
        while not value(text := text_of(fresh), "cairn_fold_failures_total", map=row.name):
            assert time.monotonic() < begin_s + 20
        assert value(text, "cairn_pending_commits", map=row.name) == 1
        assert 0 < value(text, "cairn_pending_oldest_age_seconds", map=row.name) < 20
    fresh.folded(row)
    until(lambda: value(text_of(fresh), "cairn_folded_commits_total", map=row.name) == 1, "it is counted")
    text = text_of(fresh)
    assert value(text, "cairn_pending_oldest_age_seconds", map=row.name) == 0
    assert value(text, "cairn_fold_duration_seconds_count", map=row.name) == 1


def test_the_store_and_the_process_show_their_sizes(live: Live) -> None:
    row, before = live.new_map(), text_of(live)
    fold_by_hand(live.service.store, row, [cell_of(KEYS[0], lm=0, history_bytes=50, present_bytes=7)])
    text = text_of(live)
    for part, size_bytes in (("present", 7), ("history", 50)):
        name = "cairn_cells_size_bytes"
        assert value(text, name, part=part) - value(before, name, part=part) == size_bytes
    for name in ("cairn_store_size_bytes", "cairn_wal_size_bytes", "cairn_disk_free_bytes", "process_open_fds"):
        assert value(text, name) > 0
    assert value(text, "cairn_writer_failures_total", kind="disk_full") == 0
    assert 0 < value(text, "process_open_fds") <= value(text, "process_max_fds")
    assert 0 < time.time() - value(text, "process_start_time_seconds") < 86_400


def test_a_robot_that_is_silent_shows_and_so_does_a_store_without_a_backup(fresh: Live, tmp_path: Path) -> None:
    row = fresh.new_map()
    register(fresh, row)
    text = text_of(fresh)
    assert 0 <= value(text, "cairn_robot_silence_seconds", map=row.name, robot="mole") < 20
    assert value(text, "cairn_backup_age_seconds") == math.inf
    assert families_of(text)["cairn_certificate_expiry_seconds"].samples == {}
    note_backup(tmp_path, "/backup/nightly.cairn", 1000)
    assert 0 <= value(text_of(fresh), "cairn_backup_age_seconds") < 20
    (tmp_path / NOTE_NAME).write_text('{"time_s": ')  # as a power cut leaves it
    assert value(text_of(fresh), "cairn_backup_age_seconds") == math.inf


def test_names_that_strangers_try_make_no_series(tmp_path: Path) -> None:
    with Live(tmp_path, admin_token="a" * 20, metrics_open=True) as live:
        before = text_of(live).count("\n")
        for n in range(20):
            live.http.put(f"/maps/guess{n}/commits/{pushed(n, 0).id}", content=b"x")
            live.http.request(f"ODD{n}", f"/guess{n}")
        assert text_of(live).count("\n") < before + 120
        assert "guess" not in text_of(live)
        assert "ODD" not in text_of(live)


def test_a_family_has_a_bound_and_escapes_what_is_in_labels(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(metrics, "SERIES_MAX", 3)
    registry = CollectorRegistry()
    counter = Bounded(Counter("cairn_test_total", "A test.", ("a", "b"), registry=registry))
    histogram = Bounded(Histogram("cairn_test_seconds", "A test.", ("a",), registry=registry, buckets=(1.0, 2.0)))
    ugly = 'quote " back \\ line \n {brace},'
    counter.labels(ugly, "").inc(2)
    for n in range(5):
        counter.labels(str(n), "x").inc()
        histogram.labels(str(n)).observe(float(n))
    text = metrics_text(registry.collect())
    assert value(text, "cairn_test_total", a=ugly, b="") == 2
    assert value(text, "cairn_test_total", a="other", b="other") == 3
    assert value(text, "cairn_test_seconds_bucket", a="other", le="+Inf") == 2
    assert value(text, "cairn_test_seconds_bucket", a="1", le="1.0") == 1


def test_counting_costs_microseconds() -> None:
    counter = Bounded(Counter("cairn_test_total", "A test.", ("a",), registry=None))
    begin_s = time.perf_counter()
    for _ in range(10_000):
        counter.labels("x").inc()
    assert (time.perf_counter() - begin_s) / 10_000 < 50e-6  # 0.4 us where it was written


def _no_memory(*arguments: object, **options: object) -> int:
    raise MemoryError


def test_who_registered_may_not_read_the_figures_of_all_maps(tmp_path: Path) -> None:
    with Live(tmp_path, admin_token="a" * 20) as live:
        row = live.new_map()
        headers = {"Authorization": "Bearer " + "a" * 20}
        body = {"robot": "mole", "incarnation": MOLE.incarnation}
        token = live.http.post(f"/maps/{row.name}/branches", json=body, headers=headers).json()["token"]
        assert live.http.get("/metrics", headers={"Authorization": f"Bearer {token}"}).status_code == 403
        assert live.http.get("/metrics").status_code == 401
        assert live.http.get("/metrics", headers=headers).status_code == 200
