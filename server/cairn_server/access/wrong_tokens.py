"""Notes of wrong tokens: a few lines an hour in the log and in the audit log, however many come.

    wrong token from 192.0.2.7, and 4711 more since the last such line

A flood fills no disk and pushes no other line out of the audit log; nothing of the token is written.
"""

import logging
import threading
import time
from collections import Counter
from collections.abc import Callable

from cairn_server.access.rate_limits import HOUR_S
from cairn_server.store.store import Store

log = logging.getLogger(__name__)

LINES_PER_HOUR = 60
"""Lines in an hour: in the audit log a thousandth of an hour's part of those that are kept for two months."""
LINES_OF_ADDRESS = 6
"""Lines in an hour about one address, so that it leaves room for ten others."""


class WrongTokens:
    """Notes of tokens that count on nothing; called from many threads."""

    def __init__(self, store: Store, *, steady_s: Callable[[], float] = time.monotonic) -> None:
        self._store = store
        self._steady_s = steady_s
        self._lock = threading.Lock()
        self._hour = -1
        self._lines: Counter[str] = Counter()
        self._left_out = 0

    def turn(self, address: str) -> int | None:
        """Count a wrong token; where it is worth a line, the count of those since the last line, else None."""
        with self._lock:
            hour = int(self._steady_s() // HOUR_S)
            if hour != self._hour:
                self._hour = hour
                self._lines.clear()
            if self._lines.total() >= LINES_PER_HOUR or self._lines[address] >= LINES_OF_ADDRESS:
                self._left_out += 1
                return None
            self._lines[address] += 1
            left_out, self._left_out = self._left_out, 0
            return left_out

    def write(self, address: str, kind: str, left_out: int) -> None:
        """Write the line of a token that was refused as of this kind; it may wait for the database."""
        more = f", and {left_out} more since the last such line" if left_out else ""
        self._store.audit(kind, f"wrong token from {address or 'an unknown address'}{more}", client=address)
