"""Replies in parts: the bytes of one part, no snapshot open between two, and an early end where the map moved."""

import pytest
from tests.fixtures.server.fetching import ask_missing, fetch
from tests.fixtures.server.live import Live
from tests.fixtures.server.pushes import MOLE, WREN, pushed, read, sum_of
from tests.naive.asker import NaiveAsker, cell_frames

from cairn_map.wire.frames import frames_of
from cairn_map.wire.messages import Done, MissingRequest, More
from cairn_map.wire.resumed_replies import reply_digest
from cairn_server.store.store_rows import MapRow
from cairn_server.sync import reply_parts
from cairn_server.sync.asked_cells import asked_of


@pytest.fixture
def filled(live: Live) -> MapRow:
    """A map of three cells."""
    row = live.new_map()
    for n in range(4):
        live.push(row, pushed(n, n, WREN))
    live.folded(row)
    return row


@pytest.fixture
def short_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every part ends with its first cell."""
    monkeypatch.setattr(reply_parts, "FIRST_PART_BYTES", 1)
    monkeypatch.setattr(reply_parts, "PART_BYTES_MAX", 1)


def parts_of(live: Live, row: MapRow, request: MissingRequest) -> "reply_parts.MissingReply":
    return live.service.sync.replies.missing(row, "mole", asked_of(request))


def test_a_reply_in_parts_has_the_bytes_of_one_part(live: Live, filled: MapRow, request: pytest.FixtureRequest) -> None:
    asked = NaiveAsker(MOLE).request()
    whole = parts_of(live, filled, asked)
    assert whole.rest is None
    request.getfixturevalue("short_parts")
    parts = list(parts_of(live, filled, asked).parts())
    assert b"".join(parts) == whole.first
    assert len(parts) == 4  # header and a cell, a cell, a cell, the end


@pytest.mark.usefixtures("short_parts")
def test_parts_go_out_in_chunks_and_an_asker_has_the_whole_map(live: Live, filled: MapRow) -> None:
    answer = ask_missing(live, filled, NaiveAsker(MOLE).request())
    assert "Content-Length" not in answer.headers
    asker = NaiveAsker(MOLE)
    assert asker.take(frames_of(answer.content))
    assert asker.map() == read(live.cells(filled))


@pytest.mark.usefixtures("short_parts")
def test_a_reply_ends_with_more_where_the_map_moves_between_two_parts(live: Live, filled: MapRow) -> None:
    asker = NaiveAsker(MOLE)
    parts = parts_of(live, filled, asker.request()).parts()
    sent = [next(parts)]
    live.push(filled, pushed(9, 9, WREN))
    live.folded(filled)
    frames = frames_of(b"".join([*sent, *parts]))
    assert isinstance(frames[-1], More)
    assert len(cell_frames(frames)) == 1
    assert not asker.take(frames)
    fetch(live, filled, asker)
    assert asker.map() == read(live.cells(filled)) == sum_of(pushed(n, n, WREN) for n in (0, 1, 2, 3, 9))


@pytest.mark.usefixtures("short_parts")
def test_a_reply_ends_with_more_where_the_map_cannot_be_read_any_more(live: Live, filled: MapRow) -> None:
    parts = parts_of(live, filled, NaiveAsker(MOLE).request()).parts()
    sent = [next(parts)]
    live.http.delete(f"/maps/{filled.name}", params={"confirm": filled.name}).raise_for_status()
    frames = frames_of(b"".join([*sent, *parts]))
    assert isinstance(frames[-1], More)
    assert len(cell_frames(frames)) == 1


@pytest.mark.usefixtures("short_parts")
def test_fingerprints_come_in_one_part_since_they_answer_all_that_was_listed(live: Live, filled: MapRow) -> None:
    asker = NaiveAsker(MOLE)
    fetch(live, filled, asker)
    reply = parts_of(live, filled, asker.request(compare=True))
    assert reply.rest is None
    assert isinstance(frames_of(reply.first)[-1], Done)


@pytest.mark.usefixtures("short_parts")
def test_a_reply_without_cells_is_still_known_by_its_digest(live: Live, filled: MapRow) -> None:
    asker = NaiveAsker(MOLE)
    fetch(live, filled, asker)
    reply = parts_of(live, filled, asker.request())
    assert reply.rest is None
    assert not parts_of(live, filled, asker.request(known=reply_digest(reply.first))).first
