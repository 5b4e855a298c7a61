"""`GET /readyz` says no, and why, whenever a push would not come into the map."""

from collections.abc import Iterator
from pathlib import Path

import apsw
import pytest
from tests.fixtures.server.answers import kind_of
from tests.fixtures.server.damage import raising
from tests.fixtures.server.live import Live, until
from tests.fixtures.server.pushes import pushed

from cairn_map.errors import DamagedDataError
from cairn_server.folding import fold_thread, group_folding, readiness
from cairn_server.store.sqlite import store as sqlite_store
from cairn_server.store.sqlite.store import SqliteStore


@pytest.fixture
def live(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Live]:
    """A server that looks again at every request."""
    monkeypatch.setattr(readiness, "KEEP_S", 0.0)
    monkeypatch.setattr(fold_thread, "RETRY_S", 0.01)
    with Live(tmp_path, fold_lag_max_s=30.0) as server:
        yield server


def reasons(live: Live) -> str:
    """Empty if it is ready."""
    answer = live.http.get("/readyz")
    if answer.status_code == 200:
        return ""
    assert (answer.status_code, kind_of(answer)) == (503, "not_ready")
    assert int(answer.headers["Retry-After"]) > 0
    return str(answer.json()["detail"])


def store_of(live: Live) -> SqliteStore:
    assert isinstance(live.service.store, SqliteStore)
    return live.service.store


def test_it_writes_durably_and_changes_nothing(live: Live) -> None:
    store = store_of(live)
    row = live.new_map()
    before, info = store.health.figures(), live.http.get(f"/maps/{row.name}").json()
    assert reasons(live) == ""
    after = store.health.figures()
    assert after.written == before.written + 1
    assert after.ahead_bytes > before.ahead_bytes
    assert live.http.get(f"/maps/{row.name}").json() == info


def test_an_answer_is_kept_for_a_while_so_that_strangers_cannot_wear_out_the_disk(
    live: Live, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(readiness, "KEEP_S", 60.0)
    reasons(live)
    before = store_of(live).health.figures().written
    for _ in range(5):
        assert reasons(live) == ""
    assert store_of(live).health.figures().written == before


def test_folding_that_fails_makes_it_not_ready_until_it_goes_again(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    row = live.new_map()
    with monkeypatch.context() as broken:
        broken.setattr(group_folding, "fold_around", raising(MemoryError()))
        live.push(row, pushed(0, 0))
        until(lambda: reasons(live) == "fold_failing: MemoryError", "it says that folding fails")
    until(lambda: reasons(live) == "", "it is ready again")


def test_a_map_with_a_damaged_cell_does_not_take_the_server_away_from_the_others(
    live: Live, monkeypatch: pytest.MonkeyPatch
) -> None:
    row = live.new_map()
    monkeypatch.setattr(group_folding, "fold_around", raising(DamagedDataError("damaged_store", "one cell")))
    live.push(row, pushed(0, 0))
    until(lambda: row.name in live.service.readiness._folds.held_up(), "the fold failed")
    store_of(live)._writer.run(lambda c: c.execute("UPDATE commits SET received_age_s = -1e9").fetchall())
    assert reasons(live) == ""


def test_a_commit_that_waits_too_long_makes_it_not_ready(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    row = live.new_map()
    monkeypatch.setattr(group_folding, "fold_around", lambda *arguments, **options: 0)  # as if it hung
    live.push(row, pushed(0, 0))
    assert reasons(live) == ""
    store_of(live)._writer.run(
        lambda c: c.execute(
            "UPDATE commits SET received_age_s = received_age_s - 60 WHERE folded_seq IS NULL"
        ).fetchall()
    )
    assert reasons(live).startswith("fold_lag: a commit has waited for 6")


def test_a_disk_that_takes_nothing_makes_it_not_ready(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(connection: apsw.Connection) -> None:
        raise apsw.FullError("database or disk is full")

    with monkeypatch.context() as broken:
        broken.setattr(sqlite_store, "_rewrite_version", full)
        assert reasons(live).startswith("disk_full: ")
    assert reasons(live) == ""
    assert store_of(live).health.figures().failures == {"disk_full": 1}


def test_threads_that_ended_make_it_not_ready(live: Live) -> None:
    live.service._fold_thread.close()
    assert reasons(live) == "fold_dead: the thread that folds has ended; restart the server"
    store_of(live)._writer.close()
    assert "store_failed: the store's writer has ended" in reasons(live)


def test_a_server_told_to_stop_is_not_ready(live: Live) -> None:
    live.service.readiness.close()
    assert reasons(live).startswith("shutting_down: ")


def test_a_disk_at_its_bound_does_not_come_and_go(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    """Free space around the bound, look by look: ready until it is below, then not until it is a quarter above."""
    least, health = live.service.settings.disk_free_min_bytes, store_of(live).health
    seen: list[bool] = []
    for part in (1.3, 1.0, 0.99, 1.0, 1.24, 1.1, 1.25, 1.0, 0.5, 1.24, 2.0):
        monkeypatch.setattr(health, "_free_bytes", lambda part=part: round(part * least))
        said = reasons(live)
        seen.append(said == "")
        assert said == "" or said.startswith("disk_full: ")
    ready, short = True, False
    assert seen == [ready, ready, short, short, short, short, ready, ready, short, short, ready]


def test_a_change_is_one_line_of_the_log_however_often_probes_ask(
    live: Live, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    assert reasons(live) == ""
    with monkeypatch.context() as broken:
        broken.setattr(sqlite_store, "_rewrite_version", raising(apsw.FullError("database or disk is full")))
        for _ in range(5):
            assert reasons(live).startswith("disk_full: ")
    for _ in range(5):
        assert reasons(live) == ""
    lines = [(record.name, record.getMessage().partition(":")[0]) for record in caplog.records]
    of_readiness = [text for name, text in lines if name == readiness.__name__]
    assert of_readiness == ["not ready", "ready again"]
    assert not [name for name, _ in lines if name.endswith("request_trail")]
