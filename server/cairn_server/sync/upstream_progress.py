"""What a server knows of the one that it is joined to: what it may forget, and whom to tell that something came."""

import math
import time
from collections.abc import Callable


def _nobody() -> None:
    """There is no relay."""


class Joining:
    """Of all maps; called from many threads."""

    def __init__(self, *, is_joined: bool) -> None:
        self._is_joined = is_joined
        self._handed_over_s: dict[str, float] = {}
        self.wake: Callable[[], None] = _nobody
        """Tells the relay that something came."""

    def handed_over(self, map_name: str, begun_s: float) -> None:
        """All that was in a map at this time (UTC seconds since 1970) was given to the upstream, if it can travel."""
        self._handed_over_s[map_name] = begun_s

    def ages_s(self) -> dict[str, float]:
        """Seconds since all of a map was handed to the upstream server, by the map's name."""
        now_s = time.time()
        return {name: max(0.0, now_s - begun_s) for name, begun_s in list(self._handed_over_s.items())}

    def may_forget_s(self, map_name: str) -> float:
        """Evidence that was folded before this time is on the upstream, too; infinite without one."""
        return self._handed_over_s.get(map_name, -math.inf) if self._is_joined else math.inf
