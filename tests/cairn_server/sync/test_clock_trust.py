"""Trust in a server's clock: nothing is handed out or judged by one that jumped or is behind, and no commit is lost."""

import math
import re
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.fixtures.clocks import DAY_S, NOW_S, HandClocks
from tests.fixtures.map.made import SMALL
from tests.fixtures.server.access import ADMIN, bearer
from tests.fixtures.server.answers import kind_of
from tests.fixtures.server.branch_contract import branch, token
from tests.fixtures.server.live import Live
from tests.fixtures.server.pushes import MOLE, WREN, pushed
from tests.memory_store.replicas import MemoryReplicaNotes
from tests.memory_store.store import MemoryStore

from cairn_map.commits.ids import Author
from cairn_map.epochs.epoch import BASE, Epoch, epoch_of
from cairn_map.errors import ConflictError, UnreachableError
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_server.metrics import RELEASED_S
from cairn_server.store.sqlite.store import SqliteStore
from cairn_server.store.store import Store
from cairn_server.store.store_age import JUMP_S
from cairn_server.store.store_rows import MapRow
from cairn_server.sync.clock_trust import ClockTrust

EPOCH_S = 120
ASKS_TIME = {"Cairn-Format": "2"}
JUMPS_S = {"ahead 40 days": 40 * DAY_S, "back 400 days": -400 * DAY_S, "three minutes": 180.0}


def epochs_map(store: Store, name: str = "lab", epoch_s: int = EPOCH_S) -> MapRow:
    """A map with epochs."""
    return store.create_map(name, SMALL, SensorModel(), epoch_s)[0]


def takes(trust: ClockTrust, row: MapRow, epoch: Epoch, author: Author = MOLE) -> bool:
    """True if a commit of this epoch is taken; else it is to be tried again later."""
    try:
        trust.check_push(row, author, epoch)
    except UnreachableError as exc:
        assert exc.kind == "bad_clock" and exc.retry_after_s is not None and 0 < exc.retry_after_s <= 3600
        return False
    return True


def at(time_s: float, ahead: int = 0) -> Epoch:
    return Epoch(epoch_of(time_s, EPOCH_S) + ahead)


def registered(store: Store, row: MapRow, author: Author) -> None:
    store.register(row, branch(author.robot), token(row, author.robot))


@contextmanager
def trusted_store(clocks: HandClocks) -> Iterator[tuple[MemoryStore, MapRow, ClockTrust]]:
    """A store whose clock is trusted and was used, with a map on which mole has registered long ago."""
    store = MemoryStore(clocks.of_store())
    row = epochs_map(store)
    registered(store, row, MOLE)
    clocks.pass_s(1.0)
    trust = ClockTrust(store)
    assert trust.now_s() == clocks.wall_s
    yield store, row, trust
    store.close()


def rebooted(store: MemoryStore, clocks: HandClocks, *, wall_s: float) -> ClockTrust:
    """Trust of the server after the machine was booted."""
    clocks.reboot(wall_s=wall_s)
    store.clock.boot = clocks.boot
    return ClockTrust(store)


def audited(store: Store) -> list[str]:
    page = store.audit_log.page(after=0, limit=1000)
    return [line.what for line in page if line.what in ("clock_doubt", "clock_trusted", "trust_clock")]


@given(epoch_s=st.integers(1, 366 * 86_400), ahead=st.integers(-1000, 1000), into=st.floats(0, 1, exclude_max=True))
def test_the_epoch_after_the_present_one_is_the_last_that_is_taken(epoch_s: int, ahead: int, into: float) -> None:
    clocks = HandClocks(wall_s=(math.ceil(NOW_S / epoch_s) + into) * epoch_s)
    store = MemoryStore(clocks.of_store())
    row, trust = epochs_map(store, epoch_s=epoch_s), ClockTrust(store)
    epoch = Epoch(epoch_of(clocks.wall_s, epoch_s) + ahead)
    assert takes(trust, row, epoch) == (ahead <= 1)
    if ahead > 1:
        with pytest.raises(UnreachableError, match=f"server's time is {clocks.wall_s:.3f}"):
            trust.check_push(row, MOLE, epoch)
        clocks.pass_s((ahead - 1) * epoch_s)
        assert takes(trust, row, epoch)


@pytest.mark.parametrize("jump_s", JUMPS_S.values(), ids=JUMPS_S)
def test_a_clock_that_jumped_says_nothing_until_it_comes_back(jump_s: float) -> None:
    clocks = HandClocks()
    with trusted_store(clocks) as (store, row, trust):
        clocks.wall_s += jump_s
        registered(store, row, WREN)
        assert trust.now_s() is None and "clock_jumped" in (trust.complaint() or "")
        clocks.pass_s(30.0)
        right_s = clocks.wall_s - jump_s
        # Who had an offset before is judged by the steady clock; who may have any other waits.
        for ahead in (-30_000, 0, 1, 2, 30_000):
            assert takes(trust, row, at(right_s, ahead)) == (ahead <= 1)
            assert not takes(trust, row, at(right_s, ahead), WREN)
        assert all(takes(trust, row, BASE, author) for author in (MOLE, WREN))
        clocks.wall_s -= jump_s
        assert trust.now_s() == clocks.wall_s and trust.complaint() is None
        assert takes(trust, row, at(right_s, 1), WREN) and not takes(trust, row, at(right_s, 2), WREN)
        assert audited(store) == ["clock_doubt", "clock_trusted"]


def test_steps_of_less_than_the_shortest_epoch_are_followed_and_without_epochs_those_of_a_minute() -> None:
    clocks = HandClocks()
    store = MemoryStore(clocks.of_store())
    trust = ClockTrust(store)
    for jump_s in (59.0, -59.0, 30.0):
        clocks.wall_s += jump_s
        assert trust.now_s() == clocks.wall_s
    clocks.wall_s += JUMP_S + 1
    assert trust.now_s() is None
    clocks.wall_s -= JUMP_S + 1
    for name, epoch_s in (("long", 600), ("short", 120), ("longer", 900)):
        row = epochs_map(store, name, epoch_s)
        takes(trust, row, Epoch(0))
    for jump_s, is_trusted in ((119.0, True), (-119.0, True), (121.0, False)):
        clocks.wall_s += jump_s
        assert (trust.now_s() is not None) == is_trusted


def test_a_clock_that_nobody_went_by_may_be_set(tmp_path: Path) -> None:
    clocks = HandClocks()
    trust = ClockTrust(MemoryStore(clocks.of_store()))
    clocks.wall_s += 5000.0  # set by NTP before the first request
    assert trust.now_s() == clocks.wall_s


def test_a_server_that_starts_in_1970_waits_for_its_clock_and_takes_what_robots_of_before_measured() -> None:
    clocks = HandClocks()
    with trusted_store(clocks) as (store, row, _):
        right_s = clocks.wall_s
        again = rebooted(store, clocks, wall_s=12.0)
        assert again.now_s() is None and "clock_behind" in (again.complaint() or "")
        registered(store, row, WREN)
        assert takes(again, row, at(right_s, 5)) and not takes(again, row, at(right_s), WREN)
        clocks.wall_s = right_s + 100
        assert again.now_s() == clocks.wall_s
        assert takes(again, row, at(right_s), WREN)


def test_a_clock_before_the_program_or_the_newest_commit_is_behind() -> None:
    clocks = HandClocks(wall_s=RELEASED_S - 1.0)
    store = MemoryStore(clocks.of_store())
    assert "clock_behind" in (ClockTrust(store).complaint() or "")
    clocks.pass_s(2.0)
    assert ClockTrust(store).complaint() is None
    # Another server's commits came with a backup: the newest may have been an epoch ahead.
    row, newest = epochs_map(store), at(clocks.wall_s, 50)
    trust = ClockTrust(store)
    assert trust.now_s() == clocks.wall_s
    trust.note_push(row, newest)
    for left_s, is_behind in ((40 * EPOCH_S, True), (1.0, True), (-1.0, False)):
        clocks.pass_s((newest - 1) * EPOCH_S - left_s - clocks.wall_s)
        assert ("clock_behind" in (trust.complaint() or "")) == is_behind
    assert trust.now_s() == clocks.wall_s


def test_an_operators_word_makes_the_new_time_the_right_one_and_no_commit_of_before_speaks_against_it() -> None:
    clocks = HandClocks()
    with trusted_store(clocks) as (store, row, trust):
        ahead_s = clocks.wall_s
        trust.note_push(row, at(ahead_s))
        right_s = ahead_s - 40 * DAY_S
        clocks.wall_s = 1000.0
        assert trust.now_s() is None
        with pytest.raises(ConflictError) as refused:
            trust.trust(by="chief")
        assert refused.value.kind == "clock_behind"
        clocks.wall_s = right_s
        assert trust.trust(by="chief") == trust.now_s() == right_s
        assert takes(trust, row, at(right_s, 1)) and not takes(trust, row, at(right_s, 2))
        assert ClockTrust(store).now_s() == right_s
        assert audited(store)[-1] == "trust_clock"
        clocks.wall_s -= DAY_S
        assert trust.now_s() is None


@pytest.mark.parametrize("is_other_boot", [False, True])
def test_a_doubt_outlives_the_process(is_other_boot: bool, tmp_path: Path) -> None:
    clocks = HandClocks()
    store = SqliteStore(tmp_path, clocks.of_store())
    row = epochs_map(store)
    trust = ClockTrust(store)
    assert trust.now_s() is not None
    clocks.wall_s += 40 * DAY_S
    assert trust.now_s() is None
    store.close()
    if is_other_boot:
        clocks.reboot(wall_s=clocks.wall_s)
    store = SqliteStore(tmp_path, clocks.of_store())
    trust = ClockTrust(store)
    assert trust.now_s() is None
    assert not takes(trust, row, at(clocks.wall_s)) and not takes(trust, row, at(NOW_S))
    clocks.wall_s -= 40 * DAY_S
    # After another boot nobody can tell a clock that came back from one that jumped again.
    assert (trust.now_s() is None) == is_other_boot
    trust.trust(by="chief")
    store.close()
    store = SqliteStore(tmp_path, clocks.of_store())
    assert ClockTrust(store).now_s() == clocks.wall_s
    store.close()


def test_servers_of_one_store_share_doubt_and_word() -> None:
    clocks = HandClocks()
    store = MemoryStore(clocks.of_store(), make_notes=MemoryReplicaNotes)
    row = epochs_map(store)
    first, second = ClockTrust(store), ClockTrust(store)

    def look(*trusts: ClockTrust) -> list[bool]:
        for trust in trusts:
            trust.look()
        return [trust.now_s() is not None for trust in trusts]

    assert look(first, second) == [True, True]
    clocks.wall_s += 40 * DAY_S
    assert first.now_s() == clocks.wall_s - 40 * DAY_S, "between two looks it goes on by the steady clock"
    assert look(first) == [False]
    late = ClockTrust(store)
    assert look(late, second, first) == [False] * 3
    assert not takes(late, row, at(NOW_S))
    clocks.wall_s -= 40 * DAY_S
    assert look(late) == [False], "it never saw the clock right"
    assert look(second, late, first) == [True] * 3
    clocks.wall_s += 40 * DAY_S
    assert look(late, first, second) == [False] * 3
    second.trust(by="chief")
    assert look(late, first, second) == [True] * 3
    assert late.now_s() == clocks.wall_s


Step = tuple[str, float]
STEPS = st.lists(
    st.tuples(st.sampled_from(["pass", "jump", "right", "restart", "reboot", "1970"]), st.floats(-1, 1)), max_size=25
)


@given(steps=STEPS)
def test_no_time_that_is_handed_out_is_wrong_and_no_epoch_of_the_future_is_taken_whatever_the_clock_does(
    steps: list[Step],
) -> None:
    clocks = HandClocks()
    with trusted_store(clocks) as (store, row, trust):
        right_s = clocks.wall_s
        for what, amount in steps:
            if what == "pass":
                clocks.pass_s(abs(amount) * 1000)
                right_s += abs(amount) * 1000
            elif what == "jump":
                # By whole days: what several of them leave wrong is none, or more than a clock may be off.
                clocks.wall_s += round(amount * 100) * DAY_S + math.copysign(EPOCH_S + 1, amount)
            elif what == "right":
                clocks.wall_s = right_s
            elif what == "restart":
                trust = ClockTrust(store)
            elif what == "reboot":  # with the time that it had: a wrong one of a machine that was off is not noticed
                trust = rebooted(store, clocks, wall_s=clocks.wall_s)
            elif clocks.wall_s == right_s:
                trust = rebooted(store, clocks, wall_s=12.0)
                assert trust.now_s() is None
                clocks.wall_s = right_s
            now_s, ahead = trust.now_s(), round(3 * amount)
            assert now_s is None or abs(now_s - right_s) < 0.01
            assert takes(trust, row, at(right_s, ahead), WREN) == (now_s is not None and ahead <= 1)


def served(folder: Path, clocks: HandClocks, **settings: Any) -> Live:
    """A server on a folder, by these clocks."""
    return Live(folder, store=SqliteStore(folder, clocks.of_store()), **settings)


def test_answers_say_the_time_where_it_is_asked_for_and_trusted_and_an_admin_says_when_it_is(
    tmp_path: Path,
) -> None:
    clocks = HandClocks()
    with served(tmp_path, clocks, admin_token=ADMIN, metrics_open=True) as live:
        chief = bearer(ADMIN)
        for path, status in (("/healthz", 200), ("/maps", 401), ("/nowhere", 404)):
            answer = live.http.get(path, headers=ASKS_TIME)
            assert "Cairn-Time" not in live.http.get(path).headers, "bytes for nothing"
            assert (answer.status_code, float(answer.headers["Cairn-Time"])) == (status, clocks.wall_s)
        assert "clock" not in live.http.get("/servers", headers=chief).json()
        assert live.http.get("/readyz").json() == {"status": "ready"}
        assert "cairn_clock_doubt_seconds 0.0\n" in live.http.get("/metrics").text

        clocks.wall_s += 40 * DAY_S
        answer = live.http.get("/readyz", headers=ASKS_TIME)
        assert "Cairn-Time" not in answer.headers and answer.status_code == 200
        assert answer.json()["degraded"].startswith("clock_jumped: ")
        assert live.http.get("/servers", headers=chief).json()["clock"] == answer.json()["degraded"]
        clocks.pass_s(70.0)
        assert "cairn_clock_doubt_seconds 70.0\n" in live.http.get("/metrics").text
        row = live.new_map()
        assert live.push(row, pushed(0, 0), headers=chief).status_code == 201, "without epochs no time counts"

        assert kind_of(live.http.post("/clock")) == "no_token"
        assert live.http.post("/clock", headers=chief).json() == {"time_s": clocks.wall_s}
        assert float(live.http.get("/healthz", headers=ASKS_TIME).headers["Cairn-Time"]) == clocks.wall_s
        clocks.wall_s = 12.0
        assert kind_of(live.http.post("/clock", headers=chief)) == "clock_behind"


def newest_release_s(changelog: str) -> float:
    """Day of the newest release, as its heading says it; minus infinity before the first one."""
    days = re.findall(r"^## .+ - (\d{4}-\d\d-\d\d)$", changelog, re.MULTILINE)
    return max((datetime.fromisoformat(f"{day}T00:00Z").timestamp() for day in days), default=-math.inf)


def test_the_date_of_this_program_is_past_and_moves_with_each_release() -> None:
    changelog = Path(__file__).parents[3] / "CHANGELOG.md"
    assert (
        newest_release_s("## Unreleased\n\n## 0.2.0 - 1970-01-03\n\n### Added\n\n## 0.1.0 - 1970-01-02\n") == 2 * DAY_S
    )
    assert newest_release_s(changelog.read_text()) <= RELEASED_S <= changelog.stat().st_mtime
    assert datetime.fromtimestamp(RELEASED_S, UTC).hour == 0
