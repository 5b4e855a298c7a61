"""Links to a bridge: whatever ends the first one before its thread begins closes it."""

import threading
from contextlib import ExitStack

import pytest
from websockets.sync.client import ClientConnection

from cairn_client.links import bridge_link
from cairn_client.links.bridge_link import BridgeLinks
from cairn_map.errors import BadInputError


@pytest.mark.parametrize("error", [BadInputError("no_foxglove", "no"), OSError("gone"), KeyboardInterrupt()])
@pytest.mark.parametrize("where", ["greeting", "thread"])
def test_a_start_that_fails_closes_the_link(error: BaseException, where: str, monkeypatch: pytest.MonkeyPatch) -> None:
    closed = list[str]()

    def connect(stack: ExitStack, *_: object) -> None:
        stack.callback(closed.append, "link")

    def fail(*_: object) -> None:
        raise error

    def greet(link: ClientConnection) -> None:
        if where == "greeting":
            raise error

    monkeypatch.setattr(bridge_link, "connect_bridge", connect)
    links = BridgeLinks("ws://127.0.0.1:9", None, fail, pauses_s=(0.0,), name="cairn-test")
    with monkeypatch.context() as failing:
        failing.setattr(threading.Thread, "start", fail)
        with pytest.raises(type(error)):
            links.start(greet)
    assert closed == ["link"]
    links.stop()
