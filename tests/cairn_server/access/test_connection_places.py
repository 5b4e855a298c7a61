"""Places of connections: bounded, and never full for a newcomer."""

from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cairn_map.errors import UnreachableError
from cairn_server.access.connection_places import STAY_S, ConnectionPlace, ConnectionPlaces, network_of

LIMIT, STRANGERS, SHARE = 64, 16, 4


class Door:
    """Places, and the connections that are open."""

    def __init__(self, **options: str) -> None:
        self.now_s = 0.0
        self.places = ConnectionPlaces(LIMIT, steady_s=lambda: self.now_s, **options)
        self.links: list[ConnectionPlace | None] = []
        self.cut: set[int] = set()

    def enter(self, address: str) -> ConnectionPlace:
        link = len(self.links)
        self.links.append(None)
        place = self.places.enter(address, lambda: self.cut.add(link))
        assert place is not None
        self.links[link] = place
        return place

    @property
    def open(self) -> list[ConnectionPlace]:
        """Connections that are neither cut nor left."""
        return [place for link, place in enumerate(self.links) if place is not None and link not in self.cut]

    def leave(self, place: ConnectionPlace) -> None:
        self.places.leave(place)
        self.cut.add(self.links.index(place))


@given(st.lists(st.tuples(st.integers(0, 5), st.sampled_from(["come", "go", "a", "b", "c"])), max_size=200))
def test_a_newcomer_has_a_place_after_anything(steps: list[tuple[int, str]]) -> None:
    door = Door()
    for n, what in steps:
        door.now_s += 0.1 * n
        if what == "come":
            door.enter(f"10.0.0.{n}")
        elif door.open:
            place = door.open[n % len(door.open)]
            if what == "go":
                door.leave(place)
            else:
                try:
                    door.places.note(place, what)
                except UnreachableError as exc:
                    assert exc.kind == "busy"
        strangers, known = door.places.taken
        assert strangers == sum(place.holder is None for place in door.open) <= STRANGERS
        assert known == sum(place.holder is not None for place in door.open) <= 3 * SHARE
    newest = door.enter("10.0.0.9")
    door.places.note(newest, "new")
    assert newest in door.open
    for place in door.open:
        door.leave(place)
        door.places.leave(place)
    assert door.places.taken == (0, 0)


def test_silent_ones_push_out_each_other_and_neither_other_addresses_nor_who_showed_a_token() -> None:
    door = Door()
    elsewhere, known = door.enter("10.0.0.2"), door.enter("10.0.0.1")
    door.places.note(known, "mole")
    for _ in range(700):
        door.enter("10.0.0.1")
    assert {elsewhere, known} <= set(door.open) and len(door.open) == STRANGERS + 1
    robot = door.enter("10.0.0.1")
    assert robot not in door.open, "whoever floods keeps out its own address, half a second long"
    door.now_s += STAY_S
    assert door.enter("10.0.0.1") in door.open


def test_two_hundred_robots_behind_one_address_all_find_a_place_one_after_the_other() -> None:
    places = ConnectionPlaces(500)
    for n in range(200):
        place = places.enter("10.0.0.1", lambda: pytest.fail("cut"))
        assert place is not None
        places.note(place, f"robot{n}")
    assert places.taken == (0, 200)


def test_strangers_from_many_addresses_do_not_push_out_a_team_behind_one() -> None:
    door = Door()
    known = door.enter("10.0.0.1")
    door.places.note(known, "mole")
    door.leave(known)
    team = [door.enter("10.0.0.1") for _ in range(3)]
    for n in range(3 * STRANGERS):
        door.now_s += STAY_S
        door.enter(f"10.0.1.{n}")
    assert all(place in door.open for place in team)


def test_one_token_has_its_share_and_admins_have_all() -> None:
    door = Door()
    for n in range(SHARE + 1):
        place = door.enter("10.0.0.1")
        if n == SHARE:
            with pytest.raises(UnreachableError):
                door.places.note(place, "mole")
        else:
            door.places.note(place, "mole")
    for _ in range(LIMIT - 1):
        door.places.note(door.enter("10.0.0.1"), object())
    assert len(held_by(door, "mole")) == 1, "all places are taken, so what it has beyond one goes"
    with pytest.raises(UnreachableError):
        door.places.note(door.enter("10.0.0.1"), object())


def test_a_robot_with_tokens_of_many_maps_leaves_the_others_their_places() -> None:
    door = Door()
    tokens = [f"map{n}:mole" for n in range(2 * LIMIT // SHARE)]
    for token in tokens * SHARE:
        try:
            door.places.note(door.enter("10.0.0.1"), token)
        except UnreachableError as exc:
            assert exc.kind == "busy"
    assert door.places.taken[1] == LIMIT
    wren = [door.enter("10.0.0.2") for _ in range(2)]
    door.places.note(wren[0], "lab:wren")
    for token in tokens * SHARE:
        if len(held_by(door, token)) < SHARE:
            with suppress(UnreachableError):
                door.places.note(door.enter("10.0.0.1"), token)
    assert wren[0] in door.open and door.places.taken[1] == LIMIT
    assert sorted({len(held_by(door, token)) for token in tokens}) == [1, 2]
    with pytest.raises(UnreachableError):
        door.places.note(wren[1], "lab:wren")


def held_by(door: Door, token: str) -> list[ConnectionPlace]:
    """Open connections of a token."""
    return [place for place in door.open if place.holder == token]


def test_no_request_that_comes_through_a_proxy_is_cut() -> None:
    places = ConnectionPlaces(LIMIT, trusted_proxies="172.30.87.2")
    begun = [places.begin(f"map{n % (LIMIT // SHARE)}:mole") for n in range(LIMIT)]
    with pytest.raises(UnreachableError):
        places.begin("lab:wren")
    places.leave(begun[0])
    places.begin("lab:wren")
    assert places.taken == (0, LIMIT)


def test_a_proxy_has_no_place_and_its_requests_have() -> None:
    places = ConnectionPlaces(LIMIT, trusted_proxies="172.30.87.2 fd00::/8")
    assert places.enter("172.30.87.2", pytest.fail) is places.enter("fd00::2", pytest.fail) is None
    assert places.enter("::ffff:172.30.87.2", pytest.fail) is None
    assert places.enter("172.30.87.1", pytest.fail) is not None
    begun = [places.begin("mole") for _ in range(SHARE)]
    with pytest.raises(UnreachableError):
        places.begin("mole")
    places.begin("wren")
    places.leave(begun[0])
    places.begin("mole")


def test_an_ipv6_network_is_one_address() -> None:
    assert network_of("2001:db8::1") == network_of("2001:db8::ffff:2") != network_of("2001:db8:0:1::1")
    assert network_of("::ffff:10.0.0.1") == network_of("10.0.0.1")
    assert network_of("fe80::1%eth0") == network_of("fe80::2")
