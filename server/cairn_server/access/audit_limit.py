"""How many audit lines a robot may fill with what it was refused: else it could push everybody else's out."""

import threading
import time
from collections.abc import Callable

NOTED_PER_HOUR = 60
HOUR_S = 3600


class Refusals:
    """Counts refusals by token, the hour's; may be called from any thread."""

    def __init__(self, *, steady_s: Callable[[], float] = time.monotonic) -> None:
        self._steady_s = steady_s
        self._lock = threading.Lock()
        self._hour = -1
        self._noted: dict[str, int] = {}

    def is_worth_a_line(self, who: str) -> bool:
        """Whether this refusal of a token is still one to note."""
        with self._lock:
            hour = int(self._steady_s() // HOUR_S)
            if hour != self._hour:
                self._hour, self._noted = hour, {}
            self._noted[who] = self._noted.get(who, 0) + 1
            return self._noted[who] <= NOTED_PER_HOUR
