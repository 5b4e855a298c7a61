"""Ages count only the time in which a server was seen to run: no jump of the time of day forgets anything."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import apsw
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.fixtures.server.answers import kind_of
from tests.fixtures.server.live import Live, until
from tests.fixtures.server.old_stores import OLD_COMMITS, unpacked
from tests.fixtures.server.pushes import pushed

from cairn_map.commits.commit import Commit
from cairn_map.commits.ids import CommitId
from cairn_map.wire.access_messages import CreateToken
from cairn_server.access import auth
from cairn_server.access.auth import ADMIN_FILE
from cairn_server.access.tokens import create_token
from cairn_server.settings import Settings
from cairn_server.store.sqlite.store import SqliteStore
from cairn_server.store.store_age import JUMP_S, AgeMark, Clocks, StoreAge
from cairn_server.store.store_rows import MapRow, Token
from cairn_server.sync.replies import StableVectors

DAY_S = 86_400.0
JUMPS_S = {"ahead 40 days": 40 * DAY_S, "back 400 days": -400 * DAY_S, "1970 to now": 56 * 365.25 * DAY_S}


@dataclass(slots=True)
class TestClocks:
    """The machine's clocks, set by hand."""

    __test__ = False
    wall_s: float = 1.7e9
    steady_s: float = 12_345.0

    def pass_s(self, seconds: float) -> None:
        """Time goes by."""
        self.wall_s += seconds
        self.steady_s += seconds

    def clocks(self) -> Clocks:
        """Both, to be read."""
        return Clocks(lambda: self.wall_s, lambda: self.steady_s)


@contextmanager
def served(folder: Path, clocks: TestClocks, **settings: Any) -> Iterator[Live]:
    """A server on a folder, by these clocks."""
    with Live(folder, store=SqliteStore(folder, clocks.clocks()), **settings) as live:
        yield live


def look(live: Live) -> None:
    """The server looks at its clocks, and for what it may forget, as it does each minute."""
    thread = live.service._fold_thread
    assert thread is not None
    due_s = thread.upkeep._next_s
    thread._clocks_next_s = 0.0
    thread.wake()
    until(lambda: thread._clocks_next_s > 0, "it looks at its clocks")
    due_s[thread.upkeep._forget] = 0.0
    thread.wake()
    until(lambda: due_s[thread.upkeep._forget] > 0, "it looked at them, and for what it may forget")


def jumps(live: Live) -> list[str]:
    page = live.service.store.audit_log.page(after=0, limit=1000)
    return [line.detail for line in page if line.what == "clock_jump"]


def kept(live: Live, row: MapRow, commits: list[Commit]) -> list[bool]:
    return [live.http.get(f"/maps/{row.name}/commits/{commit.id}").status_code == 200 for commit in commits]


def stable(live: Live, row: MapRow) -> set[CommitId]:
    """Commits that are stable now."""
    vectors = StableVectors(live.service.store.age, live.service.settings.stable_after_s)
    with live.service.store.snapshot(row) as snapshot:
        return set(vectors.of(snapshot))


@pytest.mark.parametrize("jump_s", JUMPS_S.values(), ids=JUMPS_S)
def test_a_jump_of_the_clock_forgets_nothing_and_makes_nothing_stable_and_is_reported(
    jump_s: float, tmp_path: Path
) -> None:
    clocks = TestClocks(wall_s=1.7e9 if jump_s < 1e9 else 12.0)
    with served(tmp_path, clocks) as live:
        row, commits = live.new_map(), [pushed(n, n) for n in range(3)]
        for commit in commits:
            assert live.push(row, commit).status_code == 201
        live.folded(row)
        clocks.wall_s += jump_s
        look(live)
        assert kept(live, row, commits) == [True] * 3 and stable(live, row) == set()
        assert len(jumps(live)) == 1 and f"{abs(jump_s):.0f} s" in jumps(live)[0]
        way = "ahead" if jump_s > 0 else "back"
        assert f'cairn_clock_jumps_total{{direction="{way}"}} 1' in live.http.get("/metrics").text
        assert live.http.get("/readyz").status_code == 200
        clocks.pass_s(2 * DAY_S)
        look(live)
        assert kept(live, row, commits) == [True] * 3
        assert stable(live, row) == {commit.id for commit in commits}
        clocks.wall_s -= jump_s  # right again
        clocks.pass_s(29 * DAY_S)
        look(live)
        assert kept(live, row, commits) == [False] * 3, "30 days were seen to pass"
        assert live.http.get("/readyz").status_code == 200


def test_a_kept_stable_vector_grows_with_time_that_passes_though_the_clock_was_set_back(tmp_path: Path) -> None:
    clocks = TestClocks()
    with served(tmp_path, clocks) as live:
        row, commit, vectors = live.new_map(), pushed(0, 1), live.service.sync.replies._stable
        live.push(row, commit)
        live.folded(row)
        with live.service.store.snapshot(row) as snapshot:
            assert set(vectors.of(snapshot)) == set()
            clocks.wall_s -= 400 * DAY_S
            clocks.pass_s(DAY_S + 1)
            assert set(vectors.of(snapshot)) == {commit.id}


def test_time_without_a_server_does_not_count_and_a_clock_behind_it_is_reported(tmp_path: Path) -> None:
    clocks, commits = TestClocks(), [pushed(0, 1)]
    with served(tmp_path, clocks) as live:
        row = live.new_map()
        assert live.push(row, commits[0]).status_code == 201
        live.folded(row)
        clocks.pass_s(DAY_S / 2)
    clocks.wall_s += 100 * DAY_S  # switched off for long
    clocks.steady_s = 3.0
    with served(tmp_path, clocks) as live:
        look(live)
        assert kept(live, row, commits) == [True] and stable(live, row) == set() and jumps(live) == []
        clocks.pass_s(DAY_S * 0.6)
        assert stable(live, row) == {commits[0].id}, "what passed before the pause still counts"
        look(live)
        assert jumps(live) == []
    clocks.wall_s, clocks.steady_s = 9.0, 3.0  # a battery that is empty
    with served(tmp_path, clocks) as live:
        look(live)
        assert len(jumps(live)) == 1 and "back (or it is not set yet)" in jumps(live)[0]
        assert kept(live, row, commits) == [True]


@given(st.lists(st.tuples(st.floats(0, 1e6), st.floats(-1e9, 1e9), st.booleans())))
def test_an_age_is_the_sum_of_all_steady_time_and_jumps_alone_are_reported(
    steps: list[tuple[float, float, bool]],
) -> None:
    clocks, passed_s = TestClocks(), 0.0
    age = StoreAge(AgeMark(), clocks.clocks())
    for seconds, jump_s, is_restarted in steps:
        clocks.pass_s(seconds)
        passed_s += seconds
        assert age.now_s() == pytest.approx(passed_s, abs=1e-3)
        assert age.jump_s() == 0.0
        clocks.wall_s += jump_s
        if is_restarted:
            mark = AgeMark(age.now_s(), clocks.wall_s)
            clocks.steady_s = 0.0
            age = StoreAge(mark, clocks.clocks())
        else:
            assert age.jump_s() == (pytest.approx(jump_s, abs=1e-3) if abs(jump_s) > JUMP_S else 0.0)


@pytest.mark.parametrize("ahead_s", [0.0, 40 * DAY_S, -400 * DAY_S])
def test_commits_of_a_store_from_before_ages_count_from_its_first_start(ahead_s: float, tmp_path: Path) -> None:
    path = unpacked("v1.sqlite.zst", tmp_path)
    connection = apsw.Connection(str(path))
    connection.execute("UPDATE commits SET received_s = received_s + ?, folded_s = folded_s + ?", (ahead_s, ahead_s))
    connection.close()
    clocks = TestClocks(wall_s=4e9)
    with served(tmp_path, clocks) as live:
        row = live.service.store.map("lab")
        live.folded(row)
        look(live)
        assert all(kept(live, row, OLD_COMMITS)) and stable(live, row) == set()
        clocks.pass_s(2 * DAY_S)
        assert {commit.id for commit in OLD_COMMITS} <= stable(live, row)
        clocks.pass_s(29 * DAY_S)
        look(live)
        assert not any(kept(live, row, OLD_COMMITS))


def token_of(expires_s: float | None, *, role: str = "reader") -> Token:
    return Token(
        name="eye",
        role=role,  # type: ignore[arg-type]
        map_number=None,
        map_name=None,
        robot=None,
        created_s=1.7e9,
        expires_s=expires_s,
        created_age_s=500.0,
        used_age_s=600.0,
    )


def test_a_clock_set_back_gives_a_token_no_second_life_and_one_set_ahead_ends_it_only_meanwhile() -> None:
    hour, settings = token_of(1.7e9 + 3600), Settings(branch_expiry_s=3600)

    def ended(wall_s: float, age_s: float, token: Token = hour) -> bool:
        return auth.has_ended(token, settings, now_s=wall_s, age_s=age_s)

    assert not ended(1.7e9 + 3599, 500 + 3599)
    assert ended(1.7e9 + 3600, 501), "a pause counts for a date"
    assert ended(1.6e9, 500 + 3600), "set back"
    assert ended(1.8e9, 501) and not ended(1.7e9 + 9, 510), "set ahead, and right again"
    silent = token_of(None, role="robot")
    assert not ended(9e9, 600 + 3599, silent) and ended(0.0, 600 + 3600, silent)


def test_a_token_that_ended_stays_so_when_the_clock_is_set_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clocks = TestClocks()
    monkeypatch.setattr("cairn_server.access.auth.time.time", lambda: clocks.wall_s)
    with served(tmp_path, clocks, admin_token="a" * 16) as live:
        row = live.new_map()
        secret = create_token(live.service.store, "eye", CreateToken(role="reader", lifetime_s=3600), by=ADMIN_FILE)

        def answer() -> str:
            found = live.http.get(f"/maps/{row.name}", headers={"Authorization": f"Bearer {secret.token}"})
            return "ok" if found.status_code == 200 else kind_of(found)

        assert answer() == "ok"
        clocks.wall_s += 40 * DAY_S
        assert answer() == "bad_token"
        clocks.wall_s -= 40 * DAY_S
        assert answer() == "ok", "the clock is right again"
        clocks.pass_s(3600)
        assert answer() == "bad_token"
        clocks.wall_s -= 400 * DAY_S
        assert answer() == "bad_token", "the clock was set back"
