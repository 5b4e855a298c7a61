"""Listener to a server's live events, across broken links (PROTOCOL.md 4.6).

connect -> events -> the link breaks -> Lost -> wait -> connect, from the last id on -> ...
"""

import json
import time
from collections.abc import Callable, Generator, Iterable, Iterator
from dataclasses import dataclass

from pydantic import ValidationError

from cairn_client.http.api import MapApi
from cairn_client.http.backoff import Backoff
from cairn_map.errors import DamagedDataError, UnreachableError, first_error
from cairn_map.wire.live_events import LIVE_EVENT, LiveEvent

LINE_BYTES_MAX = 4 << 20
"""More than 100 log entries and the signs of 10 000 robots take."""
TYPES = frozenset(["hello", "cells", "log", "head", "robot", "beat"])


@dataclass(frozen=True, slots=True)
class Lost:
    """The link broke; it is tried again."""

    reason: str
    retry_in_s: float


def listen(
    api: MapApi, map_name: str, *, sleep: Callable[[float], None] = time.sleep, backoff: Backoff | None = None
) -> Generator[LiveEvent | Lost, None, None]:
    """Events of a map, without an end; after a cut from where it was cut.

    Args:
        api: the server.
        map_name: the map.
        sleep: waits between two tries.
        backoff: the waits; None: half a second to half a minute.

    Raises:
        CairnError: the server refuses: no such map, or the token is not good (any more).
        DamagedDataError: its messages are no events.
    """
    waits, last_id = backoff or Backoff(), None
    while True:
        try:
            for event in events(api, map_name, after=last_id):
                last_id = event.id
                waits.reset()
                yield event
            wait_s, reason = waits.next_s(None), "the server ended the stream"
        except UnreachableError as exc:
            wait_s, reason = waits.next_s(exc.retry_after_s), exc.message
        yield Lost(reason, wait_s)
        sleep(wait_s)


def events(api: MapApi, map_name: str, *, after: str | None = None) -> Generator[LiveEvent, None, None]:
    """The events of one connection; types that are not known are left out.

    Raises:
        UnreachableError: the link broke.
        CairnError: as `listen`.
    """
    headers = {"Accept": "text/event-stream"} | ({"Last-Event-ID": after} if after else {})
    for kind, event_id, data in messages_of(api.stream(f"/maps/{map_name}/events", headers=headers)):
        if kind not in TYPES:
            continue
        try:
            yield LIVE_EVENT.validate_python({"type": kind, "id": event_id, **json.loads(data)})
        except (ValidationError, ValueError, TypeError, RecursionError) as exc:
            said = first_error(exc) if isinstance(exc, ValidationError) else str(exc)
            raise DamagedDataError("bad_message", f"the server's {kind} event is not sound: {said}") from exc


def messages_of(parts: Iterable[bytes]) -> Iterator[tuple[str, str, str]]:
    """Type, id and data of each Server-Sent Event (WHATWG HTML 9.2.6); the id lasts until another one comes."""
    kind, event_id, data = "message", "", list[str]()
    for line in _lines(parts):
        if not line:
            if data:
                yield kind, event_id, "\n".join(data)
            kind, data = "message", []
            continue
        name, _, value = line.partition(":")
        value = value.removeprefix(" ")
        kind = value if name == "event" else kind
        event_id = value if name == "id" else event_id
        if name == "data":
            data.append(value)
            if sum(map(len, data)) > LINE_BYTES_MAX:
                raise DamagedDataError("bad_message", f"the server's event is longer than {LINE_BYTES_MAX} bytes")


def _lines(parts: Iterable[bytes]) -> Iterator[str]:
    """Lines by LF or CR LF; a bare CR, which the standard allows, our server does not send."""
    rest = bytearray()
    for part in parts:
        rest += part
        *whole, tail = rest.split(b"\n")
        for line in whole:
            yield line.removesuffix(b"\r").decode(errors="replace")
        rest = bytearray(tail)
        if len(rest) > LINE_BYTES_MAX:
            raise DamagedDataError("bad_message", f"the server's event is longer than {LINE_BYTES_MAX} bytes")
