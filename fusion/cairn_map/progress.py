"""Progress of a long command on standard error: bars, spinners, and a line that is written again and again.

    images ━━━━━━━━━━━━━━━━━━━━ 12/12 0:00:03 0:00:00          with_progress, with_passing_progress
    ⠋ lab.bag: 4120 messages 0:00:02                           counting
    check: 40 %                                                PercentLine

On a terminal, bars and lines change in place; in a log, lines come every few seconds.
"""

import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, TextIO, TypeVar

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress

Item = TypeVar("Item")
LOG_EVERY_S = 10.0
TERMINAL_EVERY_S = 0.2
CLEAR_LINE = "\r\x1b[K"


def with_progress(items: Iterable[Item], what: str, *, total: int) -> Iterator[Item]:
    """The items, with a bar that stays at the end: count, time so far, time left."""
    with _bar(_console(), is_passing=False) as bar:
        yield from bar.track(items, total=total, description=what)


def with_passing_progress(items: Iterable[Item], what: str, *, total: int) -> Iterator[Item]:
    """The items, with a bar below other output that is gone at the end; in a log with a line every few seconds."""
    console = _console()
    if not console.is_terminal:
        yield from _with_lines(items, what, total=total)
        return
    with _bar(console, is_passing=True) as bar:
        yield from bar.track(items, total=total, description=what)


def _with_lines(items: Iterable[Item], what: str, *, total: int) -> Iterator[Item]:
    """The items, with a line every few seconds: count, and the time left if the others take as long."""
    began_s = shown_s = time.monotonic()
    for done, item in enumerate(items, start=1):
        now_s = time.monotonic()
        if now_s - shown_s >= LOG_EVERY_S and done < total:
            shown_s = now_s
            left_s = (now_s - began_s) / done * (total - done)
            sys.stderr.write(f"{what}: {done} of {total}, about {left_s:.0f} s left\n")
        yield item


@contextmanager
def while_working(what: str) -> Iterator[None]:
    """A spinner for work of unknown length; nothing where standard error is no terminal."""
    console = _console()
    if not console.is_terminal:
        yield
        return
    with console.status(what):
        yield


@contextmanager
def counting(what: str, unit: str) -> Iterator[Callable[[], None]]:
    """A spinner with a count of unknown end; call the function that it gives once for each unit."""
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = (SpinnerColumn(), TextColumn(f"{{task.description}}: {{task.completed:.0f}} {unit}"), TimeElapsedColumn())
    with Progress(*columns, console=_console()) as bar:
        task = bar.add_task(what, total=None)
        yield lambda: bar.advance(task)


class StatusLine:
    """The last line of a stream, which on a terminal is replaced in place and in a log is a line of its own."""

    def __init__(self, stream: TextIO | None = None) -> None:
        """Args: stream: the stream; None: `sys.stderr` at the time of each call."""
        self._stream = stream

    @property
    def is_terminal(self) -> bool:
        """True if the stream is a terminal now."""
        return self._now().isatty()

    def show(self, text: str) -> None:
        """Write the line, in the place of the last one on a terminal."""
        stream = self._now()
        stream.write(CLEAR_LINE + text if stream.isatty() else text + "\n")
        stream.flush()

    def clear(self) -> None:
        """Take the line away from a terminal; a log keeps its lines."""
        stream = self._now()
        if stream.isatty():
            stream.write(CLEAR_LINE)
            stream.flush()

    def _now(self) -> TextIO:
        return self._stream or sys.stderr


class PercentLine:
    """Percentage of a long task; `finish` ends it."""

    def __init__(self, what: str, stream: TextIO | None = None) -> None:
        """Args: stream: the stream; None: standard error."""
        self._what = what
        self._line = StatusLine(stream or sys.stderr)
        self._is_terminal = self._line.is_terminal
        self._next_s = time.monotonic() + (0.0 if self._is_terminal else LOG_EVERY_S)

    def at(self, done: int, total: int) -> None:
        """Report that `done` of `total` are done, unless the last report is too recent."""
        now_s = time.monotonic()
        if now_s < self._next_s:
            return
        self._next_s = now_s + (TERMINAL_EVERY_S if self._is_terminal else LOG_EVERY_S)
        self._line.show(f"{self._what}: {100 * done // max(total, 1)} %")

    def finish(self) -> None:
        """End: on a terminal the line is taken away."""
        self._line.clear()


def _console() -> "Console":
    # rich costs 50 ms to import, which commands without a bar need not pay.
    from rich.console import Console

    return Console(stderr=True)


def _bar(console: "Console", *, is_passing: bool) -> "Progress":
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        console=console,
        transient=is_passing,
    )
