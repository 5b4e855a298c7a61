"""Publishing through a bridge: the server inside foxglove_bridge hands on the very bytes, after a restart too."""

import queue
from collections.abc import Iterator
from contextlib import contextmanager

import foxglove
import numpy as np
import pytest
from foxglove import Context
from foxglove.websocket import Capability, Client, ClientChannel, ServerListener
from tests.fixtures.client.live_server import WAIT_S, wait_until
from tests.fixtures.fusion.cdr_reader import read_message
from tests.fixtures.server.live import free_port, is_free_port

from cairn_client.cli.maps.command import main
from cairn_client.publish.bridge_sink import REPEAT_S, BridgeSink
from cairn_fusion.ros.map_messages import GRID, MapMessage, definition_of, grid_message
from cairn_map.errors import BadInputError
from cairn_map.queries.floor_grid import FloorGrid


class Bridge(ServerListener):
    """A bridge that takes messages of its clients."""

    def __init__(self, port: int, capabilities: list[Capability]) -> None:
        self.came: queue.Queue[tuple[str, str, bytes]] = queue.Queue()
        self._channels: dict[int, ClientChannel] = {}
        self._port = port
        self._server = foxglove.start_server(
            name="bridge", host="127.0.0.1", port=port, context=Context(), server_listener=self,
            capabilities=capabilities, supported_encodings=["cdr"],
        )  # fmt: skip

    def on_client_advertise(self, client: Client, channel: ClientChannel) -> None:
        self._channels[channel.id] = channel

    def on_message_data(self, client: Client, client_channel_id: int, data: bytes) -> None:
        channel = self._channels[client_channel_id]
        self.came.put((channel.topic, channel.schema_name, bytes(data)))

    def next(self) -> tuple[str, str, bytes]:
        return self.came.get(timeout=WAIT_S)

    def stop(self) -> None:
        """End it; its port comes free a little later."""
        self._server.stop()
        wait_until(lambda: is_free_port(self._port))


@contextmanager
def bridge_at(port: int, *capabilities: Capability) -> Iterator[Bridge]:
    bridge = Bridge(port, list(capabilities))
    try:
        yield bridge
    finally:
        bridge.stop()


def grid(value: int) -> MapMessage:
    floor = FloorGrid(np.full((2, 3), value, np.int8), edge_m=0.05, origin_m=(0.0, 1.0), ground_m=0.0)
    return grid_message("/map", floor, "map", 1_700_000_000_000_000_000)


@pytest.fixture
def port() -> int:
    return free_port("127.0.0.1")


def test_nodes_get_the_very_messages_but_transforms_and_the_floor_again(port: int) -> None:
    times_s = [0.0]
    url = f"ws://127.0.0.1:{port}"
    with bridge_at(port, Capability.ClientPublish) as bridge, BridgeSink(url, steady_s=lambda: times_s[0]) as sink:
        sink.send(grid(0)._replace(topic="/tf"))
        sink.send(grid(7))
        topic, kind, data = bridge.next()
        assert (topic, kind, data) == ("/map", GRID, grid(7).data)
        assert list(read_message(definition_of(GRID), GRID, data)["data"]) == [7] * 6
        times_s[0] = REPEAT_S
        assert bridge.next() == ("/map", GRID, data)
        assert bridge.came.empty()


def test_a_bridge_that_starts_again_gets_the_newest_of_each_topic(port: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cairn_client.publish.bridge_sink.AGAIN_S", (0.05,))
    first = Bridge(port, [Capability.ClientPublish])
    with BridgeSink(f"ws://127.0.0.1:{port}") as sink:
        sink.send(grid(1))
        assert first.next()[2] == grid(1).data
        first.stop()
        sink.send(grid(2))
        with bridge_at(port, Capability.ClientPublish) as bridge:
            assert bridge.next()[2] == grid(2).data


def test_no_bridge_and_one_that_takes_nothing_are_told_apart(port: int) -> None:
    with pytest.raises(BadInputError, match="no Foxglove bridge answers"), BridgeSink(f"ws://127.0.0.1:{port}"):
        pass
    with (
        bridge_at(port),
        pytest.raises(BadInputError, match="clientPublish") as caught,
        BridgeSink(f"ws://127.0.0.1:{port}"),
    ):
        pass
    assert caught.value.kind == "no_client_publish"
    with pytest.raises(BadInputError, match="give --through"):
        main(["publish", "http://127.0.0.1:9/maps/lab", "--mcap", "lab.mcap", "--ca", "x.pem"])
