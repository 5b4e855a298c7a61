"""Attachments of marks: bytes that a mark names by their SHA-256, and that travel and rest apart from commits.

    record of a mark    SHA-256 and size      signed with its commit, folded without waiting for the bytes
    bytes               wherever they are     checked by the SHA-256, so that no sender is trusted

A picture is known by its first bytes, never by what its sender says; anything else is bytes without a meaning.
"""

import hashlib
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

from cairn_map.epochs.layer import Hex32
from cairn_map.errors import BadInputError

ATTACHMENT_BYTES_MAX = 1 << 24
"""Size of one attachment."""
PLAIN_BYTES = "application/octet-stream"
"""Media type of what is no picture."""
PICTURES = (
    (b"\x89PNG\r\n\x1a\n", b"", "image/png", ".png"),
    (b"\xff\xd8\xff", b"", "image/jpeg", ".jpg"),
    (b"RIFF", b"WEBP", "image/webp", ".webp"),
)
"""First bytes of each sort of picture, bytes 8 to 12 of it where those say more, its media type and a suffix."""


class Attachment(BaseModel):
    """Name and size of the bytes that belong to a mark."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    sha256: Hex32
    size_bytes: Annotated[int, Field(ge=1, le=ATTACHMENT_BYTES_MAX)]

    @property
    def sha(self) -> bytes:
        """The SHA-256, 32 bytes."""
        return bytes.fromhex(self.sha256)


def attachment_of(data: bytes) -> Attachment:
    """Name and size of bytes.

    Raises:
        BadInputError: kind `bad_attachment`: there are none; `too_large`.
    """
    if not data:
        raise BadInputError("bad_attachment", "an attachment has one byte or more, got none")
    if len(data) > ATTACHMENT_BYTES_MAX:
        raise BadInputError("too_large", f"an attachment has at most {ATTACHMENT_BYTES_MAX} bytes, got {len(data)}")
    return Attachment(sha256=hashlib.sha256(data).hexdigest(), size_bytes=len(data))


def media_type_of(data: bytes) -> tuple[str, str]:
    """Media type of an attachment by its first bytes, and the suffix of a file that holds it."""
    for begin, behind, media_type, suffix in PICTURES:
        if data.startswith(begin) and (not behind or data[8 : 8 + len(behind)] == behind):
            return media_type, suffix
    return PLAIN_BYTES, ".bin"
