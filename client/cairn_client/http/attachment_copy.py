"""Attachments of marks to and from a server: in parts that go on where a cut left them, and compared when they come."""

import hashlib
from collections.abc import Iterator
from pathlib import Path

from cairn_client.http.api import MapApi
from cairn_map.commits.attachment import ATTACHMENT_BYTES_MAX, Attachment, attachment_of
from cairn_map.errors import BadInputError, DamagedDataError, NotFoundError, UnreachableError

PART_BYTES = 1 << 16
"""Size of one part: 64 kB are 8 s at 64 kbit/s, and an answer is waited for 30 s."""


def sent_parts(api: MapApi, map_name: str, attachment: Attachment, data: bytes) -> Iterator[int]:
    """Send what the server lacks of an attachment; bytes there after each part. It may be left, and begun again.

    Raises:
        CairnError: the server refuses; what came of it stays there for the next try.
        UnreachableError: no link; or kind `no_end`: the server takes part after part of it for ever.
    """
    state = api.put_attachment_part(map_name, attachment, b"", offset=0)
    for _ in range(2 * (len(data) // PART_BYTES + 2)):
        yield state.held_bytes
        if state.is_whole:
            return
        begin = state.held_bytes
        part = data[begin : begin + PART_BYTES]
        state = api.put_attachment_part(map_name, attachment, part, offset=begin)
    raise UnreachableError("no_end", f"attachment {attachment.sha256} does not come to its end, part by part", 30.0)


def send_attachment(api: MapApi, map_name: str, attachment: Attachment, data: bytes) -> None:
    """Send an attachment, whole; as `sent_parts`."""
    for _ in sent_parts(api, map_name, attachment, data):
        pass


def fetched_attachment(api: MapApi, map_name: str, sha256: str) -> bytes | None:
    """Bytes of an attachment; None if the server does not have it.

    Raises:
        DamagedDataError: kind `bad_attachment`: other bytes came.
    """
    try:
        data = api.attachment(map_name, sha256)
    except NotFoundError as exc:
        if exc.kind != "no_attachment":
            raise
        return None
    if hashlib.sha256(data).hexdigest() != sha256:
        raise DamagedDataError("bad_attachment", f"the bytes that came for attachment {sha256} are others")
    return data


def attachment_bytes(attachment: Path | bytes | None) -> bytes:
    """Bytes of an attachment that a caller has as they are or in a file; none for None.

    Raises:
        BadInputError: kind `bad_attachment`: the file cannot be read, or there are no bytes; `too_large`.
    """
    if attachment is None:
        return b""
    data = _file_bytes(attachment) if isinstance(attachment, Path) else attachment
    attachment_of(data)
    return data


def _file_bytes(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            data = file.read(ATTACHMENT_BYTES_MAX + 1)
    except OSError as exc:
        raise BadInputError("bad_attachment", f"cannot read {path}: {exc.strerror}") from exc
    if len(data) > ATTACHMENT_BYTES_MAX:
        raise BadInputError("too_large", f"an attachment has at most {ATTACHMENT_BYTES_MAX} bytes, and {path} has more")
    return data
