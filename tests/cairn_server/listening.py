"""Listeners of live events, as a program (SSE) and as a browser (WebSocket) would be."""

import base64
import json
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import httpx
from tests.cairn_server.live.hub import DEADLINE_S, Live
from websockets.sync.client import connect

from cairn_map.wire.live_events import LIVE_EVENT, Hello, LiveEvent
from cairn_server.http.routes.live import PROTOCOL, TOKEN_PREFIX
from cairn_server.store.store_rows import MapRow

Events = Iterator[LiveEvent]


def sse_events(answer: httpx.Response) -> Events:
    """Events as they come; an event without an id has the last one's, as in a browser."""
    fields: dict[str, str] = {}
    last_id = ""
    for line in answer.iter_lines():
        if line:
            name, _, value = line.partition(": ")
            fields[name] = value
            last_id = fields.get("id", last_id)
        elif "data" in fields:
            data = {"type": fields["event"], **json.loads(fields["data"])}
            if "id" in fields:
                assert fields["id"] == data["id"]
            yield LIVE_EVENT.validate_python(data)
            fields = {}


@contextmanager
def by_sse(live: Live, row: MapRow, *, after: str = "", headers: dict[str, str] | None = None) -> Iterator[Events]:
    sent = {**(headers or {}), **({"Last-Event-ID": after} if after else {})}
    with live.http.stream("GET", f"/maps/{row.name}/events", headers=sent) as answer:
        assert answer.status_code == 200, answer.read()
        assert answer.headers["Content-Type"].startswith("text/event-stream")
        yield sse_events(answer)


def socket_url(live: Live, row: MapRow, *, after: str = "") -> str:
    return f"ws://127.0.0.1:{live.port}/maps/{row.name}/live" + (f"?after={after}" if after else "")


@contextmanager
def by_socket(
    live: Live, row: MapRow, *, after: str = "", token: str | None = None, **options: Any
) -> Iterator[Events]:
    offered = [PROTOCOL]
    if token:
        offered.append(TOKEN_PREFIX + base64.urlsafe_b64encode(token.encode()).decode().rstrip("="))
    url = socket_url(live, row, after=after)
    with connect(url, subprotocols=offered, open_timeout=DEADLINE_S, **options) as socket:  # type: ignore[arg-type]
        assert socket.subprotocol == PROTOCOL
        yield (LIVE_EVENT.validate_json(text) for text in socket)


def hello_of(events: Events) -> Hello:
    first = next(events)
    assert isinstance(first, Hello)
    return first


def up_to_head(events: Events, seq: int) -> list[LiveEvent]:
    """Events to the one that tells of this head."""
    found: list[LiveEvent] = []
    for event in events:
        found.append(event)
        if event.type == "head" and int(event.cursor.split(".")[1]) >= seq:
            return found
    raise AssertionError(f"the stream ended before {seq}: {found}")
