"""Server-Sent Events (WHATWG HTML 9.2.6), read from a stream that may be hostile.

Each byte is looked at once, and kept at most twice: the time is linear in what came, however it is cut, and the
memory is bounded by one event's. A stream itself has no end, so nothing else of it is counted.
"""

from collections.abc import Iterable, Iterator
from typing import NamedTuple

from cairn_map.errors import DamagedDataError

EVENT_BYTES_MAX = 4 << 20
"""Bytes of one line, and of one event's data: more than 100 log entries and the signs of 10 000 robots take."""
EVENT_LINES_MAX = 1 << 12
"""Lines of one event, comments included: JSON in indented lines would have fewer."""


class StreamEvent(NamedTuple):
    """One event of a stream."""

    kind: str
    id: str
    """The last id that came, with this event or one before it; empty before the first."""
    data: str


def stream_events(parts: Iterable[bytes]) -> Iterator[StreamEvent]:
    """Events of a stream's bytes, however they are cut.

    Raises:
        DamagedDataError: an event has too many lines or bytes.
    """
    kind, event_id = "message", ""
    data, lines = bytearray(), 0
    for line in _lines(parts):
        # An empty line ends an event; without data it was none.
        if not line:
            if data:
                yield StreamEvent(kind, event_id, data[:-1].decode(errors="replace"))
            kind, data, lines = "message", bytearray(), 0
            continue
        lines += 1
        if lines > EVENT_LINES_MAX:
            raise DamagedDataError("bad_message", f"the server's event has more than {EVENT_LINES_MAX} lines")
        name, _, value = line.partition(b":")
        value = value.removeprefix(b" ")
        if name == b"event":
            kind = value.decode(errors="replace")
        elif name == b"id":
            event_id = value.decode(errors="replace")
        elif name == b"data":
            data += value + b"\n"
            _check_size(data)


def _lines(parts: Iterable[bytes]) -> Iterator[bytes]:
    """Lines by LF or CR LF; a bare CR, which the standard allows, our server does not send."""
    rest = bytearray()
    for part in parts:
        # Only the new part is searched: a line that comes byte by byte is not read again with each of them.
        start = 0
        while (end := part.find(b"\n", start)) >= 0:
            rest += part[start:end]
            _check_size(rest)
            yield bytes(rest).removesuffix(b"\r")
            rest.clear()
            start = end + 1
        rest += part[start:]
        _check_size(rest)


def _check_size(text: bytearray) -> None:
    if len(text) > EVENT_BYTES_MAX:
        raise DamagedDataError("bad_message", f"the server's event is longer than {EVENT_BYTES_MAX} bytes")
