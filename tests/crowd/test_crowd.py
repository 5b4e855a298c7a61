"""A few seconds of `make soak`'s crowd: everybody is answered, and what they are sent is the server's map."""

import asyncio
from collections import Counter
from pathlib import Path

import pytest
from tests.crowd.building import survey
from tests.crowd.crowd import Crowd
from tests.crowd.figures import fold_lags, rise_of
from tests.crowd.link import BadAnswerError, Link, Told
from tests.crowd.soak import soak
from tests.crowd.verdict import findings, summary

from cairn_map.commits.cursor import Cursor, cursor_from_text
from cairn_map.evidence.fingerprint import ZERO
from cairn_map.evidence.grid import CellKey
from cairn_map.wire.frames import CellFrame, FrameKind, encode_frame, start_of_reply
from cairn_map.wire.messages import Done, More, ReplyHeader

CURSOR = str(Cursor(bytes(16), 7, bytes(16)))
HEADER = encode_frame(ReplyHeader(to=CURSOR, vector={}, stable={}))
DONE = encode_frame(Done(to=CURSOR, rest=ZERO.hex()))


@pytest.mark.processes
def test_a_small_crowd_is_served_without_an_error_and_ends_with_the_servers_map(tmp_path: Path) -> None:
    crowd = Crowd(robots=6, listeners=2, seconds=3.0, sync_s=0.5, push_s=1.0)
    seen_by = survey(robot="tof", voxel_m=0.08, stops=2)
    outcome = soak(crowd, seen_by, tmp_path, whole_robots=1, every_s=60.0, progress=lambda *_: None)
    assert [line for line in findings(outcome) if "p99" not in line and "skipped" not in line] == []
    assert outcome.seen.events["head"] and outcome.seen.frames[FrameKind.DELTA]
    assert len(outcome.seen.pushes) + len(outcome.whole.pushed_s) + len(seen_by.stops) == outcome.info.commits
    assert any("compared byte for byte, 0 different" in line for line in summary(outcome))


def test_a_reply_is_read_as_far_as_its_cursor_and_its_end() -> None:
    told = Told.by(start_of_reply() + HEADER + DONE)
    assert (told.cursor, told.kinds, told.brought) == (CURSOR, Counter([FrameKind.HEADER, FrameKind.DONE]), None)


def test_a_reply_that_ends_early_names_the_cells_it_brought() -> None:
    to = cursor_from_text(CURSOR)
    cell = CellFrame(kind=FrameKind.FULL, cell=CellKey(5), from_cursor=None, to_cursor=to, fingerprint=ZERO)
    assert Told.by(start_of_reply() + HEADER + encode_frame(cell) + encode_frame(More(to=CURSOR))).brought == (5,)


def test_an_answer_in_chunks_is_read_to_its_end() -> None:
    """However they are cut on their way."""

    async def told() -> bytearray:
        async def answer(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            await reader.readuntil(b"\r\n\r\n")
            for part in (
                b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chun",
                b"ked\r\n\r\n3\r\nab",
                b"c\r\n1",
                b"0\r\n" + b"d" * 16,
            ):
                writer.write(part)
                await writer.drain()
            writer.write(b"\r\n0\r\n\r\n")
            writer.close()
            await writer.wait_closed()

        async with await asyncio.start_server(answer, "127.0.0.1") as server:
            link = Link(server.sockets[0].getsockname()[1], "token")
            await link.open()
            try:
                return await link.ask("GET", "/", b"")
            finally:
                link.close()

    assert asyncio.run(told()) == b"abc" + b"d" * 16


@pytest.mark.parametrize("reply", [b"", DONE, HEADER, HEADER + DONE[:-1], HEADER + DONE + b"x"])
def test_a_reply_that_is_not_whole_is_an_error(reply: bytes) -> None:
    with pytest.raises(BadAnswerError):
        Told.by(start_of_reply() + reply)


def test_the_lag_of_a_push_ends_with_the_first_head_that_has_so_many_entries() -> None:
    heads = [(11.0, 6), (12.0, 6), (13.5, 8)]
    assert fold_lags([10.0, 12.5, 13.0, 14.0], heads, before=5).seconds == [1.0, 1.0, 0.5]


def test_the_rise_of_a_line_is_told_from_what_lies_beside_it() -> None:
    rise, beside = rise_of([0.0, 1.0, 2.0, 3.0], [10.0, 12.0, 12.0, 14.0])
    assert rise == pytest.approx(3.6) and beside == pytest.approx(0.447, abs=1e-3)
