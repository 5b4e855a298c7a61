"""Log lines for people and for programs: one line an event, with the id of the request that it belongs to.

    2026-01-02 03:04:05,678 request method=PUT route=/maps/{name}/commits/{commit} status=201 ... request=5be0c1a2
    {"time": "2026-01-02T03:04:05.678Z", "level": "info", "message": "request", "method": "PUT", ...}

Fields are given as `extra=fields(map=..., size_bytes=...)`. Tokens are never given to a logger.
"""

import json
import logging
import sys
import time
from contextvars import ContextVar
from enum import StrEnum

REQUEST_ID: ContextVar[str] = ContextVar("request_id", default="")
"""Of the request that this thread or task works for."""
Field = str | int | float | bool | None


class LogForm(StrEnum):
    """How a log line is written."""

    TEXT = "text"
    JSON = "json"


def fields(**values: Field) -> dict[str, dict[str, Field]]:
    """`extra` of a log call."""
    return {"fields": values}


class TextFormatter(logging.Formatter):
    """Time, message, fields; one line, whatever a client put into a name."""

    def format(self, record: logging.LogRecord) -> str:
        """One record."""
        parts = [self.formatTime(record), _one_line(record.getMessage())]
        parts += [f"{name}={_quoted(value)}" for name, value in _fields_of(record).items()]
        text = " ".join(parts)
        return f"{text}\n{self.formatException(record.exc_info)}" if record.exc_info else text


class JsonFormatter(logging.Formatter):
    """One JSON object."""

    def format(self, record: logging.LogRecord) -> str:
        """One record."""
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


def start_logging(form: LogForm, level: int) -> None:
    """Log to standard error in this form, what libraries log included."""
    handler = logging.StreamHandler(sys.stderr)
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
