"""Listener to a server's live events, across broken links (PROTOCOL.md 4.6).

connect -> events -> the link breaks -> Lost -> wait -> connect, from the last id on -> ...
"""

import json
import time
from collections.abc import Callable, Generator
from dataclasses import dataclass

from pydantic import ValidationError

from cairn_client.http.api import MapApi
from cairn_client.http.backoff import Backoff
from cairn_client.http.event_stream import stream_events
from cairn_map.errors import DamagedDataError, UnreachableError, first_error
from cairn_map.wire.live_events import LIVE_EVENT, LiveEvent
from cairn_map.wire.messages import check_json_size

TYPES = frozenset(["hello", "cells", "marks", "log", "head", "robot", "beat"])


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
    for kind, event_id, data in stream_events(api.stream(f"/maps/{map_name}/events", headers=headers)):
        if kind not in TYPES:
            continue
        check_json_size(data)
        try:
            yield LIVE_EVENT.validate_python({"type": kind, "id": event_id, **json.loads(data)})
        except (ValidationError, ValueError, TypeError, RecursionError) as exc:
            said = first_error(exc) if isinstance(exc, ValidationError) else str(exc)
            raise DamagedDataError("bad_message", f"the server's {kind} event is not sound: {said}") from exc
