"""Times in answers for people: next to seconds since 1970 the same time in ISO 8601, UTC.

    {"created_s": 1795816514.4, "created_utc": "2026-11-27T21:55:14Z", ...}

A message that has a field `X_utc` says there what `X_s` is. The fields are absent where no person reads: programs of
before refuse fields that they do not know.
"""

from datetime import UTC, datetime
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, Field

ENDING = "_utc"
# Absent, not null, where they are not asked for.
UtcText = Annotated[str | None, Field(exclude_if=lambda value: value is None)]
UtcTexts = Annotated[tuple[str, str] | None, Field(exclude_if=lambda value: value is None)]

M = TypeVar("M", bound=BaseModel)


def utc_text(time_s: float) -> str:
    """Time in ISO 8601, UTC, to the second below; `out of range` for years that have no such form."""
    try:
        return datetime.fromtimestamp(time_s // 1, UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
    except (ValueError, OverflowError, OSError):
        return "out of range"


def with_utc(message: M) -> M:
    """A message with all its times in both forms, those of messages in its lists, too."""
    said: dict[str, Any] = {}
    for name in type(message).model_fields:
        value = getattr(message, name)
        if name.endswith(ENDING):
            time_s = getattr(message, name.removesuffix(ENDING) + "_s")
            if time_s is not None:
                said[name] = tuple(map(utc_text, time_s)) if isinstance(time_s, tuple) else utc_text(time_s)
        elif isinstance(value, list) and value and isinstance(value[0], BaseModel):
            said[name] = [with_utc(each) for each in value]
    return message.model_copy(update=said)
