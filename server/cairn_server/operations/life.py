"""Start and end of a server, as lines on standard output: its address, version and settings, and why it stopped.

cairn map server on http://127.0.0.1:8750, data in cairn-data
memory: at most 6319 MB in all: ...
cairn 0.1.0, settings: admin_token=*** keep_evidence_s=604800
stopped by SIGTERM after 86400 s
"""

import time
from types import TracebackType
from typing import Any, Self
from urllib.parse import urlsplit, urlunsplit

from pydantic import BaseModel

from cairn_map.errors import CairnError
from cairn_server.http.middleware.log_format import LIFE, Field, fields
from cairn_server.metrics import program_version
from cairn_server.settings import Settings

SECRET = "***"  # noqa: S105 - what stands for one
SECRETS = frozenset({"admin_token", "enrolment_token", "upstream_token"})


class Life:
    """Context of a server's life: what it says at its start, and once everything is closed why it ended.

    Ctrl-C and SIGTERM end it without an error; a server that never started has said why on standard error.
    """

    def __init__(self) -> None:
        self._started_s: float | None = None

    def started(self, url: str, settings: Settings) -> None:
        """Say that the server is there, and how it is set."""
        self._started_s = time.monotonic()
        LIFE.info(
            "cairn map server on %s, data in %s",
            url,
            settings.place,
            extra=fields(event="started", url=url, data=settings.place, version=program_version()),
        )
        LIFE.info("%s", settings.memory.text(), extra=fields(event="memory", limit_bytes=settings.memory.limit_bytes))
        own = shown_settings(settings)
        changed = " ".join(f"{name}={value}" for name, value in own.items() if value != _DEFAULTS[name])
        text = f"cairn {program_version()}, settings: {changed or 'all defaults'}"
        LIFE.info("%s", text, extra=fields(event="settings", version=program_version(), **own))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> bool:
        is_asked = isinstance(error, KeyboardInterrupt)
        if self._started_s is not None:
            seconds = round(time.monotonic() - self._started_s, 3)
            cause = _cause(error)
            LIFE.info(
                "stopped by %s after %.0f s",
                cause,
                seconds,
                extra=fields(event="stopped", cause=cause, seconds=seconds),
            )
        return is_asked


def _cause(error: BaseException | None) -> str:
    match error:
        case None:
            return "its own end"
        case KeyboardInterrupt():
            return str(error) or "SIGINT"
        case CairnError():
            return f"{error.message} [{error.kind}]"
    return f"{type(error).__name__}: {error}"


def shown_settings(settings: Settings) -> dict[str, Field]:
    """All settings by name (`quotas.bytes_per_day`), without secrets, and without passwords in URLs."""
    return {name: _shown(name, value) for name, value in _flat(settings)}


def _flat(model: BaseModel) -> list[tuple[str, Any]]:
    found: list[tuple[str, Any]] = []
    for name, value in model:
        parts = [(f"{name}.{inner}", each) for inner, each in _flat(value)] if isinstance(value, BaseModel) else []
        found += parts or [(name, value)]
    return found


def _shown(name: str, value: Any) -> Field:
    if value is None or isinstance(value, bool | int | float):
        return value
    if name in SECRETS:
        return SECRET
    text = str(value)
    if "://" not in text:
        return text
    found = urlsplit(text)
    return urlunsplit(found._replace(netloc=found.netloc.rpartition("@")[2], query=""))


_DEFAULTS = shown_settings(Settings())
