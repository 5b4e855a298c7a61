"""Places of connections, so that no client takes those of the others.

    stranger  showed no good token yet       a quarter as many places as `limit`, for all strangers together
    known     showed a good token            `limit` places, a sixteenth of them for one token; admins have no share.
                                             Where all are taken, the token that has most of them loses its oldest
                                             one to a token that has fewer: a robot has a token on each of its maps
    proxy     comes from a trusted proxy     not counted; each of its requests is, as a connection is, and none is cut

A new stranger finds a place: where all are taken, the address that has most of them loses its oldest one. So silent
connections push out each other, and a robot that shows its token within a round trip stays. Each stays for half a
second at least: an address that opens them faster has its new ones cut, before a handshake is computed for each. A
whole team behind one radio is one address only until then; of an address from which a good token came before, the first
few connections do not count, or strangers from many addresses would push out the team's. An IPv6 address counts as its
network of 64 bits, as one customer has them all. For one event loop.
"""

import ipaddress
import time
from collections import Counter, OrderedDict
from collections.abc import Callable, Hashable
from functools import lru_cache

from cairn_map.errors import UnreachableError

STRANGERS_MIN, SHARE_MIN = 4, 4
GOOD_ADDRESSES, GOOD_SHARE = 1024, 8
"""Addresses that are remembered since a good token came from them, and the connections of each that do not count."""
STAY_S = 0.5
"""Time for which a stranger's connection stays at least, when only its own address wants its place."""
KNOWN_PER_STRANGER, TOKENS = 4, 16
"""Known places for each stranger's; tokens that together fill all known places."""
Network = ipaddress.IPv4Network | ipaddress.IPv6Network


class ConnectionPlace:
    """Place of one connection."""

    def __init__(self, address: str, cut: Callable[[], None] | None, now_s: float) -> None:
        self.address = address
        self.cut = cut
        """Ends it; None: a request that comes through a proxy, and ends by itself."""
        self.since_s = now_s
        self.holder: Hashable = None
        """Token that was seen on it; None: a stranger's."""


class ConnectionPlaces:
    """Places of all connections of a server."""

    def __init__(
        self, limit: int, *, trusted_proxies: str = "", steady_s: Callable[[], float] = time.monotonic
    ) -> None:
        self._steady_s = steady_s
        self._limit = limit
        self._strangers_max = max(STRANGERS_MIN, limit // KNOWN_PER_STRANGER)
        self._share = max(SHARE_MIN, limit // TOKENS)
        self._proxies = networks(trusted_proxies)
        self._strangers: dict[ConnectionPlace, None] = {}  # oldest first
        self._good: OrderedDict[str, None] = OrderedDict()  # longest ago first
        self._of: dict[Hashable, dict[ConnectionPlace, None]] = {}
        """Places by holder of a token, oldest first; a holder without a place is not in it."""

    @property
    def taken(self) -> tuple[int, int]:
        """Places of strangers and of holders of tokens that are taken."""
        return len(self._strangers), sum(map(len, self._of.values()))

    def enter(self, address: str, cut: Callable[[], None]) -> ConnectionPlace | None:
        """Place of a new connection, which `cut` ends, perhaps at once; None: it comes from a trusted proxy."""
        if self._is_proxy(address):
            return None
        place = ConnectionPlace(network_of(address), cut, self._steady_s())
        self._strangers[place] = None
        if len(self._strangers) > self._strangers_max:
            self._cut_one(place)
        return place

    def note(self, place: ConnectionPlace, holder: Hashable) -> None:
        """A good token was seen on a connection: from now on it is the token's.

        Raises:
            UnreachableError: kind `busy`: the token has its share, or all places are taken.
        """
        if place.holder == holder:
            return
        own = len(self._of.get(holder, ()))
        if own >= self._share:
            message = f"{self._share} connections showed this token; close one of them"
            raise UnreachableError("busy", message, retry_after_s=5.0)
        if self.taken[1] - (place.holder is not None) >= self._limit and not self._cut_of_most(own):
            raise UnreachableError("busy", f"all {self._limit} connections are taken", retry_after_s=5.0)
        self._forget(place)
        self._note_good(place.address)
        place.holder = holder
        self._of.setdefault(holder, {})[place] = None

    def begin(self, holder: Hashable) -> ConnectionPlace:
        """Place of one request that comes through a proxy.

        Raises:
            UnreachableError: kind `busy`, as `note`.
        """
        place = ConnectionPlace("", None, self._steady_s())
        self.note(place, holder)
        return place

    def leave(self, place: ConnectionPlace) -> None:
        """A connection is lost, or a proxy's request is answered; may be called twice."""
        self._forget(place)
        place.holder = None

    def _forget(self, place: ConnectionPlace) -> None:
        self._strangers.pop(place, None)
        if place.holder is not None:
            held = self._of[place.holder]
            del held[place]
            if not held:
                del self._of[place.holder]

    def _cut_of_most(self, own: int) -> bool:
        """Cut the oldest connection of the token that has most, if it still has more than the newcomer then has."""
        most = max(self._of.values(), key=len)
        # With one more only they would push out each other for ever.
        oldest = next((place for place in most if place.cut is not None), None) if len(most) > own + 1 else None
        if oldest is None:
            return False
        self.leave(oldest)
        _cut(oldest)
        return True

    def _note_good(self, address: str) -> None:
        self._good[address] = None
        self._good.move_to_end(address)
        if len(self._good) > GOOD_ADDRESSES:
            self._good.popitem(last=False)

    def _cut_one(self, newest: ConnectionPlace) -> None:
        """Cut the oldest connection of the address that has most; of equal ones, the oldest of all."""
        counts = Counter(place.address for place in self._strangers)
        for address in counts.keys() & self._good.keys():
            counts[address] -= GOOD_SHARE
        most = max(counts.values())
        oldest = next(place for place in self._strangers if counts[place.address] == most)
        is_flood = oldest.address == newest.address and newest.since_s - oldest.since_s < STAY_S
        place = newest if is_flood else oldest
        del self._strangers[place]
        _cut(place)

    def _is_proxy(self, address: str) -> bool:
        return bool(self._proxies) and any(_parsed(address) in network for network in self._proxies)


def _cut(place: ConnectionPlace) -> None:
    if place.cut is not None:
        place.cut()


def networks(text: str) -> tuple[Network, ...]:
    """Addresses and networks of a text, separated by spaces."""
    return tuple(ipaddress.ip_network(part) for part in text.split())


@lru_cache(maxsize=4096)
def network_of(address: str) -> str:
    """Address that strangers have in common: of IPv6 the first 64 bits."""
    found = _parsed(address)
    if isinstance(found, ipaddress.IPv6Address):
        return str(ipaddress.ip_network((int(found) >> 64 << 64, 64)))
    return str(found)


def _parsed(address: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address:
    try:
        found = ipaddress.ip_address(address.partition("%")[0])
    except ValueError:
        return ipaddress.IPv4Address(0)
    return getattr(found, "ipv4_mapped", None) or found
