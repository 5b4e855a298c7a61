"""Waits before a request is repeated: exponential, with full jitter, never less than the server wishes."""

import random
from dataclasses import dataclass, field

from cairn_client.sync.responses import RETRY_AFTER_MAX_S


@dataclass(slots=True)
class Backoff:
    """Waits that grow from `first_s` to `last_s`; jitter keeps robots from coming back all at once."""

    first_s: float = 0.5
    last_s: float = 30.0
    _tries: int = 0
    _random: random.Random = field(default_factory=random.Random)

    def next_s(self, retry_after_s: float | None) -> float:
        """Seconds to wait now."""
        top_s: float = min(self.last_s, self.first_s * 2.0**self._tries)
        self._tries = min(self._tries + 1, 16)
        return max(self._random.uniform(0.1, 1) * top_s, min(retry_after_s or 0.0, RETRY_AFTER_MAX_S))

    def reset(self) -> None:
        """Begin with the shortest wait again, after a success."""
        self._tries = 0
