"""Bytes of answers, read as they come over the wire: never decoded, counted, and bounded before they are kept.

The other end may be any program. No server of cairn compresses an answer, and an answer of 2 kB that is said to be
compressed may stand for gigabytes: so no coding is asked for, and an answer that has one is refused unread.

    head    64 kB and the 100 kB that h11 waits for; texts of it that are sent again are checked (`sent_again`)
    body    read in parts of at most 64 kB; a whole body is held twice for an instant, and has a limit
    time    bounded by the bytes that came (`request_deadline`)
    JSON    at most 200 bytes in memory for each byte (`wire.json_limits`)
"""

import re
from collections.abc import Iterator, Mapping
from typing import Protocol

from cairn_client.http.request_deadline import RequestDeadline
from cairn_client.sync.responses import TimeSample, Traffic
from cairn_map.errors import BadInputError, DamagedDataError

CODING = "identity"
"""The one `Accept-Encoding` that is sent: the bytes as they are."""
ERROR_BYTES_MAX = 1 << 16
"""Bytes of an error's body that are read."""
HEADER_TEXT = re.compile(r"[!-~](?:[ -~]*[!-~])?")
"""Text that may stand in a header: visible ASCII, with spaces between."""
HEADER_LENGTH_MAX = 4096
SECONDS = re.compile(r"[0-9]{1,11}(\.[0-9]{1,9})?")
"""UTC seconds since 1970, to the year 5138."""


class RawResponse(Protocol):
    """A response of httpx, as far as it is read here: its headers, and its body as it comes."""

    @property
    def headers(self) -> Mapping[str, str]:
        """Header fields; their names regardless of case."""
        ...

    def iter_raw(self, chunk_size: int | None = None) -> Iterator[bytes]:
        """Parts of the body, without any decoding."""
        ...


def coding_of(response: RawResponse) -> str:
    """Coding that an answer claims for its body; empty if it is sent as it is."""
    found = response.headers.get("Content-Encoding", "")
    return "" if found.strip().lower() in ("", CODING) else found[:80]


def parts_of(
    response: RawResponse, traffic: Traffic, *, at_most_bytes: int | None, deadline: RequestDeadline
) -> Iterator[bytes]:
    """Parts of a body as they come; None: it has no limit and no deadline, and no part of it is kept here.

    Raises:
        UnreachableError: kind `no_link`: the deadline is over; a body whose end is the connection's looks whole then.
        DamagedDataError: kind `encoded_answer`: the body is encoded, though no coding was asked for.
        BadInputError: kind `too_large`: it is longer than allowed, or says that it will be.
    """
    if coding := coding_of(response):
        raise DamagedDataError(
            "encoded_answer",
            f"the answer is encoded ({coding!r}), which was not asked for: is this a map server, and does a proxy "
            "between here and there compress what passes?",
        )
    stated = response.headers.get("Content-Length", "")
    if at_most_bytes is not None and stated.isdecimal() and int(stated[:20]) > at_most_bytes:
        raise BadInputError("too_large", f"the answer may have {at_most_bytes} bytes, this one claims {stated[:20]}")
    size_bytes = 0
    if at_most_bytes is None:
        deadline.end()
    for part in response.iter_raw():
        size_bytes += len(part)
        if at_most_bytes is not None and size_bytes > at_most_bytes:
            raise BadInputError("too_large", f"the server's answer is longer than {at_most_bytes} bytes")
        traffic.down_bytes += len(part)
        deadline.note(len(part))
        with deadline.resting():
            yield part
    deadline.check()


def body_of_error(response: RawResponse) -> bytes:
    """Beginning of an error's body; empty if it is encoded: the status alone counts then."""
    return b"" if coding_of(response) else next(response.iter_raw(ERROR_BYTES_MAX), b"")[:ERROR_BYTES_MAX]


def time_sample(headers: Mapping[str, str], *, asked_s: float, answered_s: float) -> TimeSample | None:
    """The server's time in an answer's header `Cairn-Time`; None if it says none, or a cache may have kept the answer.

    Args:
        headers: of the answer.
        asked_s: steady time before the request was sent.
        answered_s: steady time after the headers of the answer came.
    """
    text = headers.get("Cairn-Time", "")
    if "Age" in headers or not SECONDS.fullmatch(text):
        return None
    return TimeSample(float(text), (asked_s + answered_s) / 2, (answered_s - asked_s) / 2)


def sent_again(headers: Mapping[str, str], name: str) -> str:
    """Text of an answer's header that later requests repeat.

    Raises:
        KeyError: there is no such header.
        DamagedDataError: no header may hold it: kept, it would end each later request.
    """
    try:
        return header_text(headers[name], name)
    except BadInputError as exc:
        raise DamagedDataError("bad_message", f"the server's header {exc.message}") from None


def header_text(text: str, name: str) -> str:
    """A text, checked to be one that a header may hold.

    Raises:
        BadInputError: kind `bad_header`.
    """
    if len(text) > HEADER_LENGTH_MAX or not HEADER_TEXT.fullmatch(text):
        raise BadInputError("bad_header", f"{name} must be visible ASCII, at most {HEADER_LENGTH_MAX} characters")
    return text
