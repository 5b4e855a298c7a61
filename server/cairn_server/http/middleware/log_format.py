"""Log lines for people and for programs: one line an event, with the id of the request that it belongs to.

    2026-01-02 03:04:05,678 request method=PUT route=/maps/{name}/commits/{commit} status=201 ... request=5be0c1a2
    {"time": "2026-01-02T03:04:05.678Z", "level": "info", "message": "request", "method": "PUT", ...}

Fields are given as `extra=fields(map=..., size_bytes=...)`. Tokens are never given to a logger.
"""

import json
import logging
import math
import sys
import time
from collections import Counter
from collections.abc import Callable
from contextvars import ContextVar
from enum import StrEnum

REQUEST_ID: ContextVar[str] = ContextVar("request_id", default="")
"""Id of the request that this thread or task works for."""
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


def start_logging(form: LogForm, level: int) -> None:
    """Log to standard error in this form, including what libraries log."""
    handler = logging.StreamHandler(sys.stderr)
    handler.addFilter(JunkFilter())
    handler.setFormatter(JsonFormatter() if form is LogForm.JSON else TextFormatter())
    logging.basicConfig(level=level, handlers=[handler], force=True)


def _fields_of(record: logging.LogRecord) -> dict[str, Field]:
    found: dict[str, Field] = dict(getattr(record, "fields", {}))
    request = REQUEST_ID.get()
    return found | {"request": request} if request else found


def _one_line(text: str) -> str:
    return text if text.isprintable() else json.dumps(text)[1:-1]


def _quoted(value: Field) -> str:
    text = f"{value:.6g}" if isinstance(value, float) else str(value)
    return text if text.isprintable() and text and not set(text) & set(' "=') else json.dumps(text)
