"""Times as people and programs state them in requests: UTC seconds since 1970, or a date and time in ISO 8601."""

import math
from datetime import UTC, datetime
from typing import Annotated

from pydantic import Field

from cairn_map.errors import BadInputError

TimeText = Annotated[str, Field(max_length=40, description="UTC seconds since 1970, or ISO 8601; else UTC")]
"""Text that `time_from_text` reads."""
TIME_MAX_S = 1e11
"""Latest time, and by its negative the earliest: that of a commit's scans."""


def time_from_text(text: str) -> float:
    """UTC seconds since 1970.

    Raises:
        BadInputError: kind `bad_time`.
    """
    try:
        time_s = float(text)
    except ValueError:
        time_s = _iso_time_s(text)
    if not math.isfinite(time_s) or abs(time_s) > TIME_MAX_S:
        raise BadInputError(
            "bad_time", f"a time is UTC seconds since 1970, or 2026-11-20T14:05+01:00 (else UTC), got {text[:40]!r}"
        )
    return time_s


def _iso_time_s(text: str) -> float:
    try:
        # In an address, a plus that is not escaped stands for a space.
        when = datetime.fromisoformat(text.strip().replace(" ", "+") if text.count(" ") == 1 and "T" in text else text)
    except ValueError:
        return math.nan
    return (when if when.tzinfo else when.replace(tzinfo=UTC)).timestamp()
