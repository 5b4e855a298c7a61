"""Door of this machine's ROS 2 where rclpy fails after the node is there: the link is lost, the node closed."""

import sys
from types import SimpleNamespace

import pytest
from tests.fixtures.client.live_server import wait_until

from cairn_client.live.rclpy_source import RclpySource


class Executor:
    """An executor of rclpy that fails as it is made, takes a node, or spins."""

    fails_at = "make"
    closed = 0

    def __init__(self, *, context: object) -> None:
        self._fail("make")

    def add_node(self, node: object) -> None:
        self._fail("add")

    def spin_once(self, *, timeout_sec: float) -> None:
        self._fail("spin")

    def shutdown(self) -> None:
        Executor.closed += 1

    def _fail(self, where: str) -> None:
        if where == self.fails_at:
            raise RuntimeError("the context is over")


@pytest.mark.parametrize("fails_at", ["make", "add", "spin"])
def test_an_executor_that_fails_ends_the_link_and_closes_the_node(
    fails_at: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Executor, "fails_at", fails_at)
    monkeypatch.setattr(Executor, "closed", 0)
    closed = list[str]()
    node = SimpleNamespace(get_topic_names_and_types=list, destroy_node=lambda: closed.append("node"))
    context = SimpleNamespace(try_shutdown=lambda: closed.append("context"))
    rclpy = SimpleNamespace(Context=lambda: context, init=lambda **_: None, create_node=lambda *_, **__: node)
    for name, module in (
        ("rclpy", rclpy),
        ("rclpy.qos", SimpleNamespace()),
        ("rclpy.executors", SimpleNamespace(SingleThreadedExecutor=Executor)),
    ):
        monkeypatch.setitem(sys.modules, name, module)
    source = RclpySource("ros2:")
    source.open(lambda topic: True)
    try:
        wait_until(lambda: source.lost_since_s is not None)
        wait_until(lambda: closed == ["node", "context"])
    finally:
        source.close()
    assert Executor.closed == (fails_at != "make")
