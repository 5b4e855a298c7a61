"""Signs of robots that several servers write: what was heard here meanwhile stays, everything else is the store's."""

from collections.abc import Callable

from cairn_map.wire.live_events import RobotSign
from cairn_map.wire.messages import RobotStatus
from cairn_server.live.live_map import LiveRobots, StoredSign


class Stored:
    """Signs in a store, and what happens while they are read."""

    def __init__(self, *signs: RobotSign) -> None:
        self.signs = {sign.branch: StoredSign(sign) for sign in signs}
        self.meanwhile: Callable[[], None] = lambda: None
        self.robots = LiveRobots(self.load)

    def load(self) -> list[StoredSign]:
        """What was there before anything else happened."""
        found = list(self.signs.values())
        self.meanwhile()
        return found

    def names(self) -> list[str]:
        """Robots that a listener would hear of first."""
        return [sign.branch for sign in self.robots.present()[2]]


def sign(branch: str, time_s: float = 1.0, **fields: object) -> RobotSign:
    """A sign of a robot."""
    return RobotSign(branch=branch, mode="high-end", time_s=time_s).model_copy(update=fields)


def noted(note: str) -> RobotStatus:
    """A status."""
    return RobotStatus(time_s=1.5e9, note=note)


def test_robots_that_come_and_go_elsewhere_are_news() -> None:
    stored = Stored(sign("mole"), sign("wren"))
    tick, _, _ = stored.robots.present()
    assert not stored.robots.refresh()
    del stored.signs["mole"]
    stored.signs["newt"] = StoredSign(sign("newt"))
    assert stored.robots.refresh()
    assert stored.names() == ["newt", "wren"]
    assert {(news.branch, news.gone) for _, news in stored.robots.since(tick)} == {("mole", True), ("newt", False)}
    assert not stored.robots.refresh()


def test_a_robot_that_comes_or_goes_while_the_store_is_read_is_not_undone() -> None:
    stored = Stored(sign("mole"), sign("wren"))
    stored.robots.present()

    def act() -> None:
        stored.robots.left("mole")
        stored.robots.came(sign("newt"))

    stored.meanwhile = act
    stored.robots.refresh()
    assert stored.names() == ["newt", "wren"]


def test_of_each_part_of_a_sign_the_later_one_stays() -> None:
    stored = Stored(sign("mole", cursor="old"))
    stored.robots.present()
    stored.robots.heard("mole", status=noted("own"), cursor="own")
    stored.signs["mole"] = StoredSign(sign("mole", 5.0, cursor="other", status=noted("other"), view_s=7.0), 5.0)
    assert stored.robots.refresh()
    found = stored.robots.of("mole")
    assert found is not None
    assert (found.cursor, found.status, found.view_s) == ("own", noted("own"), 7.0)
    late_s = found.time_s + 60.0
    stored.signs["mole"] = StoredSign(sign("mole", late_s, cursor="other", status=noted("other"), view_s=7.0), late_s)
    assert stored.robots.refresh()
    assert stored.robots.of("mole") == stored.signs["mole"].sign


def test_a_sign_that_is_only_written_a_moment_later_is_no_news() -> None:
    stored = Stored(sign("mole"))
    stored.robots.present()
    stored.robots.heard("mole")
    known = stored.robots.of("mole")
    assert known is not None
    stored.signs["mole"] = StoredSign(sign("mole", known.time_s + 0.5))
    assert not stored.robots.refresh()
    stored.signs["mole"] = StoredSign(sign("mole", known.time_s + 1.5))
    assert stored.robots.refresh()


def test_what_went_with_a_registration_elsewhere_goes_here() -> None:
    stored = Stored(sign("mole", status=noted("before"), view_s=3.0))
    stored.robots.present()
    stored.signs["mole"] = StoredSign(sign("mole", 2.0))
    assert stored.robots.refresh()
    assert stored.robots.of("mole") == sign("mole", 2.0)
