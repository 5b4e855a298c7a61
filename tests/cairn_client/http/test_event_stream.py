"""Event streams of a hostile server: an event is bounded, and no byte is looked at twice."""

from collections.abc import Iterator
from itertools import pairwise, repeat

import pytest

from cairn_client.http.event_stream import EVENT_BYTES_MAX, EVENT_LINES_MAX, stream_events
from cairn_map.errors import DamagedDataError

STREAM = b"retry: 500\n\nevent: head\nid: 5.aa\ndata: {\ndata: }\n\n: a comment\r\n\r\nevent: beat\r\ndata: {}\r\n\r\n"
EVENTS = [("head", "5.aa", "{\n}"), ("beat", "5.aa", "{}")]


@pytest.mark.parametrize("size", range(1, 20))
def test_events_are_the_same_however_their_bytes_are_cut(size: int) -> None:
    cuts = range(0, len(STREAM) + size, size)
    assert list(stream_events(STREAM[a:b] for a, b in pairwise(cuts))) == EVENTS


@pytest.mark.parametrize(
    "lines",
    [b"data:\n", b"data\n", b":\n", b"id: 1\n", b"event: x\n", b"x\n", b"data: x\r\n"],
    ids=lambda lines: lines.decode().strip(),
)
def test_an_event_of_endless_lines_is_refused_after_a_bounded_number_of_them(lines: bytes) -> None:
    taken = 0

    def parts() -> Iterator[bytes]:
        nonlocal taken
        for part in repeat(lines):
            taken += 1
            yield part

    with pytest.raises(DamagedDataError, match=str(EVENT_LINES_MAX)):
        list(stream_events(parts()))
    assert taken == EVENT_LINES_MAX + 1


@pytest.mark.parametrize("start", [b"data: ", b"", b": ", b"id: ", b"data: x\ndata: "], ids=repr)
@pytest.mark.parametrize("part", [bytes(1 << 16), b"data: " + b"x" * (1 << 16) + b"\n"], ids=["one line", "lines"])
def test_an_event_of_endless_bytes_is_refused_after_a_bounded_number_of_them(start: bytes, part: bytes) -> None:
    taken = 0

    def parts() -> Iterator[bytes]:
        nonlocal taken
        yield start
        for taken, one in enumerate(repeat(part)):  # noqa: B007
            yield one

    with pytest.raises(DamagedDataError, match=str(EVENT_BYTES_MAX)):
        list(stream_events(parts()))
    assert taken * len(part) <= EVENT_BYTES_MAX + 2 * len(part)


def test_a_line_that_comes_byte_by_byte_is_read_in_linear_time() -> None:
    """Searched again from its start with each byte, this line took half an hour."""
    size = 1 << 20
    [event] = stream_events([b"data:", *repeat(b"x", size), b"\n\n"])
    assert len(event.data) == size


def test_comments_without_end_between_events_are_only_signs_of_life() -> None:
    stream = stream_events([*repeat(b": still here\n\n", 2 * EVENT_LINES_MAX), b"data: x\n\n"])
    assert [event.data for event in stream] == ["x"]
