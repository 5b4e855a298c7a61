"""Foxglove's protocol over loopback: who joins late, who is slow, who asks for nonsense."""

import socket
import threading
from collections.abc import Iterator
from contextlib import ExitStack

import pytest
from tests.fixtures.client.foxglove_viewer import WAIT_S, FoxgloveViewer
from websockets.exceptions import ConnectionClosed, InvalidStatus

from cairn_client.publish.foxglove_server import CLIENTS_MAX, REQUEST_BYTES_MAX, FoxgloveServer
from cairn_fusion.ros.map_messages import GRID, PATH, MapMessage
from cairn_map.errors import BadInputError


@pytest.fixture
def shown() -> Iterator[FoxgloveServer]:
    with FoxgloveServer("lab") as server:
        yield server


def message(data: bytes, *, topic: str = "/map", time_ns: int = 7) -> MapMessage:
    return MapMessage(topic, GRID, data, time_ns)


@pytest.mark.parametrize("subprotocol", ["foxglove.sdk.v1", "foxglove.websocket.v1"])
def test_who_joins_late_gets_the_newest_message_and_then_each_that_comes(
    shown: FoxgloveServer, subprotocol: str
) -> None:
    shown.send(message(b"old"))
    shown.send(message(b"newer", time_ns=1_795_824_000_250_000_000))
    with FoxgloveViewer(shown.url, subprotocol=subprotocol) as viewer:
        assert (viewer.socket.subprotocol, viewer.info["op"], viewer.info["name"]) == (subprotocol, "serverInfo", "lab")
        viewer.subscribe("/map")
        channel = viewer.channels["/map"]
        assert channel["schemaName"] == "nav_msgs/msg/OccupancyGrid"
        assert channel["schema"].startswith("std_msgs/Header header\n")
        found = None
        while found is None:
            found = viewer.read()
        assert found == ("/map", 1_795_824_000_250_000_000, b"newer")
        shown.send(message(b"newest"))
        assert viewer.next_data() == b"newest"


def test_a_topic_that_is_new_is_announced_to_those_who_are_there(shown: FoxgloveServer) -> None:
    with FoxgloveViewer(shown.url) as viewer:
        shown.send(MapMessage("/cairn/robots/mole/path", PATH, b"way", 1))
        viewer.subscribe("/cairn/robots/mole/path")
        assert viewer.next_data() == b"way"


def test_nothing_comes_of_a_topic_that_is_not_asked_for(shown: FoxgloveServer) -> None:
    shown.send(message(b"a", topic="/a"))
    shown.send(message(b"b", topic="/b"))
    with FoxgloveViewer(shown.url) as viewer:
        viewer.subscribe("/a")
        assert viewer.next_data() == b"a"
        viewer.ask(op="unsubscribe", subscriptionIds=[100])
        viewer.subscribe("/b")
        assert viewer.next_data() == b"b"
        shown.send(message(b"a2", topic="/a"))
        shown.send(message(b"b2", topic="/b"))
        assert viewer.next_data() == b"b2"


def test_a_slow_viewer_misses_messages_and_gets_the_newest(shown: FoxgloveServer) -> None:
    shown.send(message(b"first"))
    with FoxgloveViewer(shown.url) as viewer:
        viewer.subscribe("/map")
        assert viewer.next_data() == b"first"
        sent = 96
        for n in range(sent):
            shown.send(message(bytes([n]) * (1 << 20)))
        found = [viewer.next_data()]
        while found[-1][0] != sent - 1:
            found.append(viewer.next_data())
        numbers = [data[0] for data in found]
        assert numbers == sorted(numbers)
        # The viewer's queue and the sockets' buffers hold some, not all.
        assert len(numbers) < sent


@pytest.mark.parametrize(
    "request_text",
    [
        "nonsense",
        "[]",
        "{}",
        '{"op": "subscribe"}',
        '{"op": "subscribe", "subscriptions": [7]}',
        '{"op": "subscribe", "subscriptions": [{"id": 1, "channelId": 999}]}',
        '{"op": "subscribe", "subscriptions": [{"id": -1, "channelId": 1}]}',
        '{"op": "subscribe", "subscriptions": [{"id": 1e400, "channelId": 1}]}',
        '{"op": "unsubscribe", "subscriptionIds": [null]}',
        '{"op": "advertise", "channels": []}',
        "[" * 30_000,
    ],
)
def test_nonsense_is_answered_and_does_no_harm(shown: FoxgloveServer, request_text: str) -> None:
    shown.send(message(b"a"))
    with FoxgloveViewer(shown.url) as viewer:
        viewer.socket.send(request_text)
        while not viewer.statuses:
            assert viewer.read() is None
        assert viewer.statuses[0].startswith("cairn: ")
        viewer.subscribe("/map")
        assert viewer.next_data() == b"a"


def test_a_request_of_megabytes_ends_its_connection_alone(shown: FoxgloveServer) -> None:
    shown.send(message(b"a"))
    with FoxgloveViewer(shown.url) as one, FoxgloveViewer(shown.url) as other:
        with pytest.raises(ConnectionClosed):
            one.socket.send(b"x" * (REQUEST_BYTES_MAX + 1))
            while True:
                one.socket.recv(timeout=WAIT_S)
        other.subscribe("/map")
        assert other.next_data() == b"a"


def test_too_many_viewers_are_turned_away(shown: FoxgloveServer) -> None:
    with ExitStack() as viewers:
        for _ in range(CLIENTS_MAX):
            viewers.enter_context(FoxgloveViewer(shown.url))
        with pytest.raises(ConnectionClosed, match="too many viewers"):
            FoxgloveViewer(shown.url)


def test_all_that_was_sent_before_the_end_arrives() -> None:
    server = FoxgloveServer("lab")
    server.send(message(b"a"))
    with FoxgloveViewer(server.url) as viewer:
        viewer.subscribe("/map")
        assert viewer.next_data() == b"a"
        server.send(message(b"last"))
        server.close()
        assert viewer.next_data() == b"last"
        with pytest.raises(ConnectionClosed):
            viewer.read()


def test_a_port_that_is_used_is_said(shown: FoxgloveServer) -> None:
    with pytest.raises(BadInputError, match=f"cannot listen on 127.0.0.1:{shown.port}: .*another port"):
        FoxgloveServer("lab", port=shown.port)


@pytest.mark.parametrize(
    ("origin", "is_let_in"),
    [
        (None, True),
        ("file://", True),
        ("https://app.foxglove.dev", True),
        ("http://viewer:8080", True),
        ("http://viewer:8081", False),
        ("https://evil.example", False),
        ("https://app.foxglove.dev.evil.example", False),
        ("http://127.0.0.1:8766", False),
        ("null", False),
    ],
)
def test_a_page_in_a_browser_joins_if_its_origin_is_named(origin: str | None, is_let_in: bool) -> None:
    with FoxgloveServer("lab", origins=["http://viewer:8080"]) as server:
        if is_let_in:
            with FoxgloveViewer(server.url, origin=origin) as viewer:
                assert viewer.info["name"] == "lab"
        else:
            with pytest.raises(InvalidStatus, match="403"):
                FoxgloveViewer(server.url, origin=origin)


def test_an_address_of_ipv6_stands_in_brackets() -> None:
    try:
        server = FoxgloveServer("lab", host="::1")
    except BadInputError as exc:
        assert exc.message.startswith("cannot listen on [::1]:0: ")  # a machine without IPv6
        return
    with server, FoxgloveViewer(server.url) as viewer:
        assert server.url == f"ws://[::1]:{server.port}"
        assert viewer.info["name"] == "lab"


def test_viewers_that_do_not_say_goodbye_are_sent_away_together(shown: FoxgloveServer) -> None:
    """One after the other the second one's goodbye would come after the first one's connection was given up."""
    with ExitStack() as connections:
        viewers = [connections.enter_context(silent_viewer(shown.port)) for _ in range(2)]
        closing = threading.Thread(target=shown.close)
        closing.start()
        for viewer in viewers:
            assert read_until(viewer, GOODBYE)
        for viewer in viewers:
            viewer.setblocking(False)
            with pytest.raises(BlockingIOError):
                viewer.recv(1)
    closing.join(WAIT_S)
    assert not closing.is_alive()


GOODBYE = b"\x88\x02\x03\xe8"
"""A close frame of RFC 6455: code 1000, no reason."""


def silent_viewer(port: int) -> socket.socket:
    """A viewer that joins, and then says nothing: no goodbye either."""
    connection = socket.create_connection(("127.0.0.1", port), WAIT_S)
    head = (
        "GET / HTTP/1.1",
        "Host: 127.0.0.1",
        "Upgrade: websocket",
        "Connection: Upgrade",
        "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==",
        "Sec-WebSocket-Version: 13",
        "Sec-WebSocket-Protocol: foxglove.sdk.v1",
    )
    connection.sendall("".join(f"{line}\r\n" for line in (*head, "")).encode())
    assert read_until(connection, b"advertise")
    return connection


def read_until(connection: socket.socket, mark: bytes) -> bool:
    """Read on until a mark; False: the connection ended before."""
    came = b""
    while mark not in came:
        part = connection.recv(1)
        if not part:
            return False
        came += part
    return True
