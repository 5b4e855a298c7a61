"""Parts of an answer: `Range` and `If-Range` of RFC 9110, sections 13.1.5 and 14.

One range is served; several, or what is no range of bytes, are answered with the whole, as the RFC allows.
"""

import re

from cairn_map.errors import BadInputError

ONE_RANGE = re.compile(r"bytes=[ \t]*(\d{0,18})-(\d{0,18})[ \t]*", re.ASCII | re.IGNORECASE)


def part_of(size_bytes: int, asked: str | None, *, etag: str, if_range: str | None) -> tuple[int, int] | None:
    """First byte and the one after the last that a request asks for; None: the whole.

    Raises:
        BadInputError: kind `bad_range`: it begins behind the end (416).
    """
    found = ONE_RANGE.fullmatch(asked) if asked else None
    # Only the very ETag, and a strong one, promises that the parts belong together; a date never does.
    if found is None or found.groups() == ("", "") or (if_range is not None and if_range.strip() != etag):
        return None
    first, last = found.groups()
    if not first:  # the last so many
        start, stop = max(0, size_bytes - int(last)), size_bytes
    else:
        start, stop = int(first), min(size_bytes, int(last) + 1 if last else size_bytes)
        if last and int(last) < int(first):
            return None  # no range at all
    if start >= size_bytes:
        raise BadInputError("bad_range", f"there are {size_bytes} bytes; the range asked for begins behind them")
    return start, stop
