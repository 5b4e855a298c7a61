"""Log lines for people and for programs: one line an event, with the id of the request that it belongs to.

    2026-01-02 03:04:05,678 request method=PUT route=/maps/{name}/commits/{commit} status=201 ... request=5be0c1a2
    {"time": "2026-01-02T03:04:05.678Z", "level": "info", "message": "request", "method": "PUT", ...}

Fields are given as `extra=fields(map=..., size_bytes=...)`. Tokens are never given to a logger.

As JSON, each line of both standard streams is one object: the server's start and end, tracebacks, warnings, and what
any library writes to standard error. What a crash of the interpreter itself writes is not.
"""

import argparse
import io
import json
import logging
import math
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable
from contextvars import ContextVar
from enum import StrEnum
from types import TracebackType
from typing import TextIO

REQUEST_ID: ContextVar[str] = ContextVar("request_id", default="")
"""Id of the request that this thread or task works for."""
LIFE = logging.getLogger("cairn_server.life")
"""Logger of a server's start and end, which go to standard output: as text the bare message."""
STREAM = logging.getLogger("stderr")
"""Logger of what is written to standard error, where its lines must be JSON."""
HTTP_LIBRARY = "uvicorn.error"
JUNK_EVERY_S = 60.0
Field = str | int | float | bool | None


class LogForm(StrEnum):
    """Form of log lines."""

    TEXT = "text"
    JSON = "json"


def fields(**values: Field) -> dict[str, dict[str, Field]]:
    """`extra` of a log call, with these fields."""
    return {"fields": values}


class TextFormatter(logging.Formatter):
    """Formatter of time, message and fields; always one line, even if a name that a client chose has line breaks."""

    def format(self, record: logging.LogRecord) -> str:
        """Line of a record."""
        parts = [self.formatTime(record), _one_line(record.getMessage())]
        parts += [f"{name}={_quoted(value)}" for name, value in _fields_of(record).items()]
        text = " ".join(parts)
        return f"{text}\n{self.formatException(record.exc_info)}" if record.exc_info else text


class JsonFormatter(logging.Formatter):
    """Formatter of one JSON object a line."""

    def format(self, record: logging.LogRecord) -> str:
        """Line of a record."""
        whole_s, ms = divmod(int(record.created * 1000), 1000)
        line: dict[str, Field] = {
            "time": f"{time.strftime('%Y-%m-%dT%H:%M:%S', time.gmtime(whole_s))}.{ms:03}Z",
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
        }
        line |= _fields_of(record)
        if record.exc_info:
            line["exception"] = self.formatException(record.exc_info)
        return json.dumps(line)


class JunkFilter(logging.Filter):
    """Filter that passes one line a minute of each warning of the HTTP library, with the count of those left out.

    Such a warning is about a request that is no HTTP, and any stranger can cause thousands in a second. Their texts are
    the library's own, so only few are remembered.
    """

    def __init__(self, *, steady_s: Callable[[], float] = time.monotonic) -> None:
        super().__init__()
        self._steady_s = steady_s
        self._last_s: dict[str, float] = {}
        self._left_out: Counter[str] = Counter()

    def filter(self, record: logging.LogRecord) -> bool:
        """True if the line is to be written. Its handler's lock is not held: a line may be counted twice."""
        if record.name != HTTP_LIBRARY or record.levelno != logging.WARNING:
            return True
        now_s, text = self._steady_s(), str(record.msg)
        if now_s - self._last_s.get(text, -math.inf) < JUNK_EVERY_S:
            self._left_out[text] += 1
            return False
        self._last_s[text] = now_s
        more = self._left_out.pop(text, 0)
        if more:
            record.fields = {"more": more}
        return True


def add_log_format(parser: argparse.ArgumentParser) -> None:
    """Add the flag of the form of log lines."""
    forms = [str(form) for form in LogForm]
    parser.add_argument(
        "--log-format",
        choices=forms,
        default=forms[0],
        help=f"form of log lines and of all else it says ({forms[0]})",
    )


def start_logging(form: LogForm, level: int) -> None:
    """Log to standard error in this form, including what libraries log."""
    is_json = form is LogForm.JSON
    handler = logging.StreamHandler(sys.stderr)
    handler.addFilter(JunkFilter())
    handler.setFormatter(JsonFormatter() if is_json else TextFormatter())
    logging.basicConfig(level=level, handlers=[handler], force=True)
    life = _LifeHandler(sys.stdout)
    life.setFormatter(JsonFormatter() if is_json else logging.Formatter("%(message)s"))
    LIFE.handlers, LIFE.propagate = [life], False
    LIFE.setLevel(logging.INFO)
    if is_json:
        _log_all_else()


class _LifeHandler(logging.StreamHandler[TextIO]):
    """Handler for standard output, whose reader may have gone away since the start."""

    def handleError(self, record: logging.LogRecord) -> None:
        """Say nothing."""


def _log_all_else() -> None:
    """Log what would be written to standard error as text: uncaught exceptions, warnings, the lines of libraries."""
    logging.raiseExceptions = False  # else a broken stream is complained of on that very stream
    logging.captureWarnings(True)
    STREAM.setLevel(logging.INFO)
    sys.stderr = _LoggedLines()

    def hook(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
        STREAM.critical("uncaught exception", exc_info=(kind, error, trace))

    def thread_hook(found: threading.ExceptHookArgs) -> None:
        if found.exc_value is not None and not isinstance(found.exc_value, SystemExit):
            hook(found.exc_type, found.exc_value, found.exc_traceback)

    sys.excepthook = hook
    threading.excepthook = thread_hook


class _LoggedLines(io.TextIOBase):
    """Stream each of whose lines becomes a line of the log; called from many threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._begun = ""

    def writable(self) -> bool:
        """Always."""
        return True

    def write(self, text: str) -> int:
        """Log the lines that are whole."""
        with self._lock:
            *lines, self._begun = f"{self._begun}{text}".split("\n")
        for line in lines:
            if line.strip():
                STREAM.info("%s", line.rstrip())
        return len(text)


def _fields_of(record: logging.LogRecord) -> dict[str, Field]:
    found: dict[str, Field] = dict(getattr(record, "fields", {}))
    request = REQUEST_ID.get()
    return found | {"request": request} if request else found


def _one_line(text: str) -> str:
    return text if text.isprintable() else json.dumps(text)[1:-1]


def _quoted(value: Field) -> str:
    text = f"{value:.6g}" if isinstance(value, float) else str(value)
    return text if text.isprintable() and text and not set(text) & set(' "=') else json.dumps(text)
