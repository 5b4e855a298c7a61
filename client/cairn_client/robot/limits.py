"""How much a robot may keep, and what goes first when that is full.

    1. commits that the server has for good          (their bytes; they are in its map)
    2. cells of the server, the farthest first       (they are a cache, and come again when the robot is near)
    3. nothing more: `commit` refuses, and the measurement stays open

What the server does not have for good is never dropped, nor is it left out of the robot's map. A dropped cell is one
that is not held: the robot asks for it whole when it comes near, and until then shows of it only what it made itself.

The robot's folder remembers the limits that were given last, for whatever opens it without a word of them.
"""

import json
from dataclasses import asdict, dataclass

from cairn_client.replica.replica_store import ReplicaStore
from cairn_map.errors import BadInputError

LEAST_BYTES = 1 << 16
LIMITS_KEY = "limits"


@dataclass(frozen=True, slots=True, kw_only=True)
class Limits:
    """Bytes; None: as much as there is."""

    disk_bytes_max: int | None = None
    """Pages in use in the robot's file: commits, cells, and some 200 bytes of each commit ever made. Its write-ahead
    log, up to 64 MB, comes on top, and the file does not become smaller by itself: its free pages are used again."""
    outbox_bytes_max: int | None = None
    """Of commits that are not forgotten yet: those that wait, and those that a restore of the server could lose."""
    memory_bytes_max: int | None = None
    """Of the map in memory (`robot.map.size_bytes`). The measurement under way comes on top, and of `snapshot()` what
    changed since it was taken, for as long as somebody holds it."""

    def __post_init__(self) -> None:
        """Raises: BadInputError: a limit that leaves no room for anything."""
        for limit in (self.disk_bytes_max, self.outbox_bytes_max, self.memory_bytes_max):
            if limit is not None and limit < LEAST_BYTES:
                raise BadInputError("bad_option", f"a limit is at least {LEAST_BYTES} bytes, got {limit}")


NO_LIMITS = Limits()


def limits_in(store: ReplicaStore, given: Limits | None) -> Limits:
    """The given limits, which are remembered from here on, or those that are."""
    if given is None:
        remembered = store.get(LIMITS_KEY)
        return Limits(**json.loads(remembered)) if remembered else NO_LIMITS
    with store.transaction():
        store.put(LIMITS_KEY, json.dumps(asdict(given)))
    return given
