"""Vectors of headers that begin at a state which the asker holds: with what it holds, they are whole (rule 3)."""

from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from tests.fixtures.server.crowded_map import add_commits, long_author
from tests.fixtures.server.fetching import ask_missing
from tests.fixtures.server.live import Live
from tests.fixtures.server.pushes import MOLE, WREN, pushed

from cairn_map.commits.ids import CommitId
from cairn_map.commits.version_vector import EMPTY
from cairn_map.errors import DamagedDataError
from cairn_map.wire.frames import frames_of
from cairn_map.wire.messages import CellIndex, MissingRequest, ReplyHeader
from cairn_server.store.history import MARK_EVERY
from cairn_server.store.store_rows import MapRow
from cairn_server.sync import missing

COMMITS = [*(pushed(n, n, author) for author in (MOLE, WREN) for n in range(4)), pushed(4, 0, retracts=[pushed(1, 1)])]


@pytest.fixture
def live(tmp_path: Path) -> Live:
    with Live(tmp_path) as own:
        yield own


def header_for(live: Live, row: MapRow, **asked: str | None) -> ReplyHeader:
    """Header of a reply."""
    header = frames_of(ask_missing(live, row, MissingRequest(**asked)).raise_for_status().content)[0]
    assert isinstance(header, ReplyHeader)
    return header


@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(order=st.permutations(COMMITS), sizes=st.lists(st.integers(1, 4), min_size=1, max_size=5))
def test_what_is_held_and_what_came_since_is_the_whole_vector(
    live: Live, order: list[object], sizes: list[int]
) -> None:
    row, waiting = live.new_map(), list(order)
    held = [header_for(live, row)]
    for size in sizes:
        for commit in waiting[:size]:
            assert live.push(row, commit).status_code == 201
        live.folded(row)
        del waiting[:size]
        held.append(header_for(live, row))
    whole = held[-1]
    for earlier in held:
        for asked in ({"since": earlier.to}, {"since": "cursor", "cursor": earlier.to}):
            news = header_for(live, row, **asked)
            assert news.since == asked["since"]
            assert news.coverage == whole.coverage.minus(earlier.coverage)
            assert news.whole(earlier, since=asked["since"]) == whole
        index = CellIndex.model_validate_json(live.http.get(f"/maps/{row.name}/main/cells?since={earlier.to}").content)
        assert index.header.whole(earlier, since=earlier.to) == whole


def test_a_state_that_the_log_does_not_prove_gets_the_whole_vector(live: Live) -> None:
    row = live.new_map()
    for commit in COMMITS[:3]:
        live.push(row, commit)
    live.folded(row)
    whole = header_for(live, row)
    log_id, seq, chain = whole.to.split(".")
    for text in (f"{log_id}.{seq}.{'0' * 32}", f"{'0' * 32}.{seq}.{chain}", f"{log_id}.99.{chain}"):
        assert header_for(live, row, since=text) == whole
    assert header_for(live, row, since="cursor") == whole  # without a cursor


def test_a_vector_that_begins_elsewhere_is_refused(live: Live) -> None:
    row = live.new_map()
    empty = header_for(live, row)
    live.push(row, COMMITS[0])
    live.folded(row)
    news = header_for(live, row, since=empty.to)
    for held, since in ((None, empty.to), (empty, None), (empty, "cursor")):
        with pytest.raises(DamagedDataError, match="which was not stated"):
            news.whole(held, since=since)


def test_an_asker_far_behind_gets_the_whole_vector(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(missing, "SINCE_ENTRIES_MAX", 1)
    row = live.new_map()
    empty = header_for(live, row)
    for commit in COMMITS[:2]:
        live.push(row, commit)
    live.folded(row)
    assert header_for(live, row, since=empty.to) == header_for(live, row)


def test_vectors_between_marks_are_those_of_their_entries(live: Live) -> None:
    row, store = live.new_map(), live.service.store
    commits = [CommitId(long_author(n % 7), n) for n in range(2 * MARK_EVERY + 50)]
    add_commits(store, row, commits[:1500])
    add_commits(store, row, commits[1500:])
    for seq in (2050, 1, 999, 1000, 1001, 2000, 1500, 0):
        with store.snapshot(row) as snapshot:
            assert snapshot.vector_at(seq) == EMPTY.with_commits(commits[:seq])


def test_a_fold_over_a_thousandth_entry_stores_the_vector_there(live: Live) -> None:
    row, store = live.new_map(), live.service.store
    commits = [CommitId(long_author(0), n) for n in range(MARK_EVERY - 2)]
    add_commits(store, row, commits)
    for commit in COMMITS[:4]:
        live.push(row, commit)
    live.folded(row)
    with store.snapshot(row) as snapshot:
        assert MARK_EVERY <= snapshot.newest_mark(snapshot.head.seq) <= snapshot.head.seq
        assert snapshot.vector_at(snapshot.head.seq) == EMPTY.with_commits(
            [*commits, *(commit.id for commit in COMMITS[:4])]
        )
