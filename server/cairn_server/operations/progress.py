"""How far a long command has come: one line that changes on a terminal, a line every few seconds elsewhere."""

import sys
import time
from typing import TextIO

LOG_EVERY_S = 10.0
TERMINAL_EVERY_S = 0.2
CLEAR_LINE = "\r\x1b[K"


class Progress:
    """Says how much of something is done; `finish` ends it."""

    def __init__(self, what: str, stream: TextIO | None = None) -> None:
        """Args: stream: where to; None: standard error."""
        self._what = what
        self._stream = stream or sys.stderr
        self._is_terminal = self._stream.isatty()
        self._next_s = time.monotonic() + (0.0 if self._is_terminal else LOG_EVERY_S)

    def at(self, done: int, total: int) -> None:
        """So much is done."""
        now_s = time.monotonic()
        if now_s < self._next_s:
            return
        self._next_s = now_s + (TERMINAL_EVERY_S if self._is_terminal else LOG_EVERY_S)
        line = f"{self._what}: {100 * done // max(total, 1)} %"
        self._stream.write(CLEAR_LINE + line if self._is_terminal else line + "\n")
        self._stream.flush()

    def finish(self) -> None:
        """It is done: nothing is left of it on a terminal."""
        if self._is_terminal:
            self._stream.write(CLEAR_LINE)
            self._stream.flush()
