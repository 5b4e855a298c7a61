"""Replies that are cut anywhere, again and again: no byte of a payload is sent twice, and no frame is another one."""

from collections.abc import Iterable
from dataclasses import replace
from random import Random

import pytest
from tests.fixtures.map.made import KEY, made_frames

from cairn_map.errors import DamagedDataError, UnreachableError
from cairn_map.evidence.grid import CellKey, cell_of_key
from cairn_map.wire import resumed_replies
from cairn_map.wire.frames import CellFrame, Frame, encode_frame, start_of_reply
from cairn_map.wire.messages import MissingRequest
from cairn_map.wire.resumed_replies import BEGUN_BYTES_MIN, Replies, reply_digest, without_begun

HEADER, *CELLS = made_frames()
CELL = next(frame for frame in CELLS if isinstance(frame, CellFrame) and frame.payload)
REST = [frame for frame in CELLS if not isinstance(frame, CellFrame)]


def cell(key: int, size: int, *, seed: int = 0) -> CellFrame:
    return replace(CELL, cell=CellKey(KEY + key), payload=Random(seed + key).randbytes(size))


def reply_of(request: MissingRequest, frames: Iterable[Frame]) -> bytes:
    """Reply to a request of a server that has these frames to send."""
    sent = [HEADER, *frames, REST[0]]
    return start_of_reply() + b"".join(map(encode_frame, without_begun(sent, request.begun)))


def fetched(replies: Replies, frames: list[CellFrame], *, cut_at: int | None = None) -> tuple[list[CellFrame], int]:
    """Cell frames that came whole, and the bytes that did."""
    reply = replies.reply_to(MissingRequest())
    data = reply_of(reply.request, frames)[:cut_at]
    got: list[CellFrame] = []
    try:
        frames = reply.frames(data[n : n + 100] for n in range(0, len(data), 100))
        got.extend(frame for frame in frames if isinstance(frame, CellFrame))
    except UnreachableError:
        assert cut_at is not None
    return got, len(data)


@pytest.mark.parametrize("seed", range(20))
def test_no_byte_of_a_payload_comes_twice_wherever_replies_are_cut(seed: int) -> None:
    random = Random(seed)
    wanted = [cell(n, random.randint(0, 40_000)) for n in range(4)]
    heads = len(reply_of(MissingRequest(), [replace(frame, payload=b"") for frame in wanted]))
    replies, left, came, cuts = Replies(), list(wanted), 0, 0
    while left:
        cut_at = random.randint(1, 20_000) if cuts < 30 else None
        got, size = fetched(replies, left, cut_at=cut_at)
        assert [(f.cell, f.payload, f.continues) for f in got] == [(f.cell, f.payload, False) for f in left[: len(got)]]
        left, came, cuts = left[len(got) :], came + size, cuts + 1
    assert came <= sum(len(frame.payload) for frame in wanted) + cuts * (heads + BEGUN_BYTES_MIN)


def test_a_cell_that_changed_after_the_cut_comes_whole() -> None:
    replies = Replies()
    assert fetched(replies, [cell(0, 9000)], cut_at=5000)[0] == []
    changed = cell(0, 9000, seed=1)
    assert fetched(replies, [changed])[0] == [changed]
    assert fetched(replies, [changed])[1] > 9000


def test_only_the_frame_that_was_begun_goes_on() -> None:
    replies = Replies()
    fetched(replies, [cell(0, 9000)], cut_at=5000)
    others = [cell(1, 3000), cell(0, 9000)]
    got, size = fetched(replies, others)
    assert got == others
    assert size < 9000


def test_a_frame_that_goes_on_from_what_is_not_here_is_refused() -> None:
    data = start_of_reply() + encode_frame(HEADER) + encode_frame(replace(cell(0, 900), continues=True))
    with pytest.raises(DamagedDataError, match="goes on"):
        list(Replies().reply_to(MissingRequest()).frames([data]))


def going_on(replies: Replies, size: int, *, cut: int = 0) -> list[Frame]:
    """Result of a reply that continues with so many bytes, whatever was received before."""
    data = start_of_reply() + encode_frame(replace(cell(0, size), continues=True))
    return list(replies.reply_to(MissingRequest()).frames([data[: len(data) - cut]]))


def test_a_cell_that_goes_on_beyond_its_limit_is_no_cell(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(resumed_replies, "CELL_BYTES_MAX", 10_000)
    replies = Replies()
    fetched(replies, [cell(0, 9000)], cut_at=5000)
    for _ in range(20):
        with pytest.raises((UnreachableError, DamagedDataError)):
            going_on(replies, 1500, cut=100)
        assert replies.begun is None or len(replies.begun[1]) <= 10_000
    fetched(replies, [cell(0, 9000)], cut_at=5000)
    with pytest.raises(DamagedDataError, match="at most 10000 bytes"):
        going_on(replies, 6000)
    assert fetched(replies, [cell(0, 9000)])[0] == [cell(0, 9000)]


def test_a_digest_that_is_not_that_of_the_beginning_gets_the_whole_frame() -> None:
    frame = cell(0, 900)
    wrong = (cell_of_key(frame.cell), 600, "0" * 64)
    assert list(without_begun([frame], wrong)) == [frame]
    too_long = (cell_of_key(frame.cell), 901, "0" * 64)
    assert list(without_begun([frame], too_long)) == [frame]


def test_the_last_reply_without_cells_is_named_and_read_again() -> None:
    replies = Replies()
    data = reply_of(MissingRequest(), [])
    first = replies.reply_to(MissingRequest())
    assert first.request.known is None
    frames = list(first.frames([data]))
    second = replies.reply_to(MissingRequest())
    assert second.request.known == reply_digest(data)
    assert list(second.again()) == frames


def test_a_reply_with_cells_and_one_that_was_cut_are_not_known() -> None:
    replies = Replies()
    fetched(replies, [cell(0, 9000)])
    assert replies.reply_to(MissingRequest()).request.known is None
    fetched(replies, [])
    assert replies.reply_to(MissingRequest()).request.known is not None
    fetched(replies, [], cut_at=20)
    assert replies.reply_to(MissingRequest()).request.known is None
