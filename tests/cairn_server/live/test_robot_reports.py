"""Status and picture of robots, and the list of branches: lag, incarnation, last status."""

from pathlib import Path
from typing import Any

import httpx
import pytest
from tests.fixtures.server.access import register
from tests.fixtures.server.answers import kind_of
from tests.fixtures.server.listening import by_socket, hello_of
from tests.fixtures.server.live import Live, until
from tests.fixtures.server.pushes import JPEG, MOLE, PNG, WREN, pushed
from tests.fixtures.server.stores import one_server

from cairn_map.wire.live_events import RobotHeard
from cairn_map.wire.messages import RobotStatus
from cairn_server import maps
from cairn_server.live import robot_reports
from cairn_server.store.store_rows import MapRow

STATUS = RobotStatus.model_validate(
    {
        "time_s": 1.5e9,
        "pose": {
            "time_s": 1.5e9,
            "t_map_rig": (1.0, 2.0, 0.4),
            "q_map_rig": (0.0, 0.0, 0.0, 1.0),
            "sigma_m": 0.05,
            "sigma_rad": 0.01,
        },
        "mode": "high-end",
        "waiting": 3,
        "waiting_bytes": 1234,
        "battery": 0.8,
        "note": "stairs",
    }
)


def put_status(live: Live, row: MapRow, status: RobotStatus = STATUS, branch: str = "mole") -> httpx.Response:
    url = f"/maps/{row.name}/branches/{branch}/status"
    return live.http.put(url, json=status.model_dump(mode="json"))


def branch_of(live: Live, row: MapRow, name: str = "mole") -> dict[str, Any]:
    found: list[dict[str, Any]] = live.http.get(f"/maps/{row.name}/branches").json()
    return next(branch for branch in found if branch["branch"] == name)


def view_url(row: MapRow, branch: str = "mole") -> str:
    return f"/maps/{row.name}/branches/{branch}/view"


def test_the_last_status_is_in_the_list_and_told_to_listeners(live: Live) -> None:
    row = live.new_map()
    register(live, row)
    with by_socket(live, row) as events:
        assert hello_of(events).robots[0].status is None
        before_s = branch_of(live, row)["last_seen_s"]
        for note in ("first", "second"):
            assert put_status(live, row, STATUS.model_copy(update={"note": note})).status_code == 204
        told = [event.robot.status for event in (next(events),) if isinstance(event, RobotHeard)]
        while told[-1] is None or told[-1].note != "second":
            event = next(events)
            assert isinstance(event, RobotHeard)
            told.append(event.robot.status)
        with by_socket(live, row) as others:
            assert hello_of(others).robots[0].status == told[-1]
    branch = branch_of(live, row)
    assert RobotStatus.model_validate(branch["status"]) == STATUS.model_copy(update={"note": "second"})
    assert branch["last_seen_s"] > before_s


@one_server("each writes for itself")
def test_a_status_is_written_at_once_and_then_once_in_a_while(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    row = live.new_map()
    register(live, row)
    written: list[str] = []
    real = live.service.store.notes.put_status

    def noted(row: MapRow, branch: str, status: str) -> None:
        written.append(status)
        real(row, branch, status)

    monkeypatch.setattr(live.service.store.notes, "put_status", noted)
    for _ in range(5):
        put_status(live, row)
    assert len(written) == 1
    monkeypatch.setattr(robot_reports, "WRITE_EVERY_S", 0.0)
    put_status(live, row)
    assert len(written) == 2
    until(lambda: live.service.store.notes.statuses(row) == {"mole": written[0]}, "it is on the disk")


def test_the_last_status_survives_a_restart_and_goes_with_the_robot(tmp_path: Path) -> None:
    with Live(tmp_path) as live:
        row = live.new_map()
        register(live, row)
        put_status(live, row, STATUS.model_copy(update={"note": "first"}))
        put_status(live, row)
    with Live(tmp_path) as live:
        assert RobotStatus.model_validate(branch_of(live, row)["status"]) == STATUS
        live.http.delete(f"/maps/{row.name}/branches/mole").raise_for_status()
        assert live.service.store.notes.statuses(row) == {}
        register(live, row)
        assert branch_of(live, row)["status"] is None


@pytest.mark.parametrize(
    "change",
    [
        {"battery": 1.1},
        {"note": "x" * 257},
        {"waiting": -1},
        {"time_s": 1e12},
        {"pose": {"t_map_rig": [0, 0, 0]}},
        {"mode": "flying"},
        {"more": 1},
    ],
)
def test_a_status_out_of_range_is_refused(live: Live, change: dict[str, Any]) -> None:
    row = live.new_map()
    register(live, row)
    answer = live.http.put(f"/maps/{row.name}/branches/mole/status", json=STATUS.model_dump(mode="json") | change)
    assert (answer.status_code, kind_of(answer)) == (422, "bad_message")


def test_who_is_not_registered_has_neither_status_nor_picture(live: Live) -> None:
    row = live.new_map()
    for answer in (put_status(live, row), live.http.put(view_url(row), content=JPEG), live.http.get(view_url(row))):
        assert (answer.status_code, kind_of(answer)) == (404, "no_branch")


@one_server("the other one shows it a second later")
@pytest.mark.parametrize(("picture", "media_type"), [(JPEG, "image/jpeg"), (PNG, "image/png")])
def test_a_picture_is_shown_until_the_next_one(live: Live, picture: bytes, media_type: str) -> None:
    row = live.new_map()
    register(live, row)
    assert kind_of(live.http.get(view_url(row))) == "no_view"
    sent = live.http.put(view_url(row), content=picture, headers={"Content-Type": "text/html"})
    assert sent.status_code == 204
    answer = live.http.get(view_url(row))
    assert (answer.content, answer.headers["Content-Type"]) == (picture, media_type)
    assert answer.headers["X-Content-Type-Options"] == "nosniff"
    assert "Last-Modified" in answer.headers
    etag = answer.headers["ETag"]
    same = live.http.get(view_url(row), headers={"If-None-Match": etag})
    assert (same.status_code, same.content, same.headers["ETag"]) == (304, b"", etag)
    live.http.put(view_url(row), content=picture + b"2")
    assert live.http.get(view_url(row), headers={"If-None-Match": etag}).content == picture + b"2"
    assert branch_of(live, row)["view_s"] > 1.5e9
    live.http.delete(f"/maps/{row.name}/branches/mole").raise_for_status()
    register(live, row)
    assert kind_of(live.http.get(view_url(row))) == "no_view"


@pytest.mark.parametrize("picture", [b"", b"GIF89a", b"<svg/>", b"\x89PNG\r\n", b"\xff\xd8"])
def test_what_is_no_picture_is_refused(live: Live, picture: bytes) -> None:
    row = live.new_map()
    register(live, row)
    answer = live.http.put(view_url(row), content=picture)
    assert (answer.status_code, kind_of(answer)) == (400, "bad_picture")


def test_a_picture_that_is_too_large_is_refused(live: Live) -> None:
    row = live.new_map()
    register(live, row)
    answer = live.http.put(view_url(row), content=JPEG + bytes(1 << 20))
    assert (answer.status_code, kind_of(answer)) == (413, "too_large")


@one_server("each has its own bound")
def test_all_pictures_together_stay_within_a_bound(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    row = live.new_map()
    monkeypatch.setattr(robot_reports, "VIEWS_BYTES_MAX", 2 * len(JPEG))
    for name in ("r1", "r2", "r3"):
        register(live, row, name)
        live.http.put(view_url(row, name), content=JPEG).raise_for_status()
    assert [live.http.get(view_url(row, name)).status_code for name in ("r1", "r2", "r3")] == [404, 200, 200]


def test_lag_counts_entries_and_the_bytes_of_others(live: Live) -> None:
    row = live.new_map()
    mine, theirs, more = pushed(0, 0), pushed(0, 1, WREN), pushed(1, 2, WREN)
    for name, author in (("mole", MOLE), ("wren", WREN), ("bat", MOLE)):
        register(live, row, name, author.incarnation)
    assert (branch_of(live, row)["behind"], branch_of(live, row)["behind_bytes"]) == (None, None)
    live.push(row, theirs)
    live.folded(row)
    cursor = live.http.get(f"/maps/{row.name}").json()["cursor"]
    for name in ("mole", "wren", "bat"):
        live.http.post(f"/maps/{row.name}/branches/{name}/missing", json={"cursor": cursor}).raise_for_status()
    until(lambda: branch_of(live, row, "wren")["behind"] == 0, "cursors are written")
    assert branch_of(live, row)["behind_bytes"] == 0
    live.push(row, mine)
    live.push(row, more)
    live.folded(row)
    lags = {name: branch_of(live, row, name) for name in ("mole", "wren", "bat")}
    assert {branch["behind"] for branch in lags.values()} == {2}
    assert lags["mole"]["behind_bytes"] == len(more.data)
    assert lags["wren"]["behind_bytes"] == len(mine.data)
    assert lags["bat"]["behind_bytes"] == len(mine.data) + len(more.data)
    before = {name: branch["behind_bytes"] for name, branch in lags.items()}
    live.retract(row, mine)
    live.folded(row)
    retract = next(entry for entry in live.http.get(f"/maps/{row.name}/log").json() if entry["retracts"])
    for name, size_bytes in before.items():  # the retract itself, and what it takes out, which its author must hear of
        branch = branch_of(live, row, name)
        assert (branch["behind"], branch["behind_bytes"]) == (4, size_bytes + retract["size_bytes"] + len(mine.data))


def test_a_lag_beyond_the_bound_is_told_in_entries_only(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(maps, "LAG_ENTRIES_MAX", 1)
    row = live.new_map()
    start = live.http.get(f"/maps/{row.name}").json()["cursor"]
    for name in ("mole", "wren"):
        register(live, row, name)
    live.http.post(f"/maps/{row.name}/branches/mole/missing", json={"cursor": start})
    for n in range(2):
        live.push(row, pushed(n, n, WREN))
        live.folded(row)
        if n == 0:
            cursor = live.http.get(f"/maps/{row.name}").json()["cursor"]
            live.http.post(f"/maps/{row.name}/branches/wren/missing", json={"cursor": cursor})
    until(lambda: branch_of(live, row, "wren")["behind"] == 1, "cursors are written")
    assert (branch_of(live, row)["behind"], branch_of(live, row)["behind_bytes"]) == (2, None)
    assert branch_of(live, row, "wren")["behind_bytes"] == len(pushed(1, 1, WREN).data)


def test_registering_again_keeps_the_row_and_a_new_incarnation_forgets_where_it_stood(live: Live) -> None:
    row = live.new_map()
    register(live, row)
    put_status(live, row)
    cursor = live.http.get(f"/maps/{row.name}").json()["cursor"]
    live.http.post(f"/maps/{row.name}/branches/mole/missing", json={"cursor": cursor})
    until(lambda: branch_of(live, row)["cursor"] == cursor, "the cursor is written")
    register(live, row)
    again = branch_of(live, row)
    assert (again["cursor"], again["incarnation"]) == (cursor, MOLE.incarnation)
    register(live, row, incarnation=WREN.incarnation)
    anew = branch_of(live, row)
    assert (anew["cursor"], anew["behind"], anew["incarnation"]) == (None, None, WREN.incarnation)
    assert RobotStatus.model_validate(anew["status"]) == STATUS


@one_server("each has its own pace")
def test_a_flood_of_pictures_is_held_back_and_others_show_theirs(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    row = live.new_map()
    register(live, row)
    register(live, row, "wren", WREN.incarnation)
    monkeypatch.setattr(robot_reports, "VIEWS_PER_S", 1 / 64)
    monkeypatch.setattr(robot_reports, "VIEWS_AT_ONCE", 2)
    answers = [live.http.put(view_url(row), content=JPEG) for _ in range(3)]
    assert [answer.status_code for answer in answers] == [204, 204, 429]
    assert kind_of(answers[-1]) == "too_many_views"
    assert 32 < int(answers[-1].headers["Retry-After"]) <= 64
    assert live.http.put(view_url(row, "wren"), content=JPEG).status_code == 204
