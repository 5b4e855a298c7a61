"""Protocol and bounds of the attachments in a store.

    part    bytes of one sender, in order, until they are as many as a mark says     held, bounded, not yet believed
    whole   the same bytes once they have the SHA-256                                 one for all marks that name it

Every method takes a map by its number and a SHA-256 of 32 bytes. What no living mark names is not taken; what lost its
last mark, or its sender, stays for `GRACE_S` by the store's age.
"""

from dataclasses import dataclass, field
from typing import Protocol

from cairn_map.commits.attachment import Attachment
from cairn_map.errors import BadInputError

OF_ROBOT_BYTES_MAX = 1 << 28
"""Bytes of all attachments of one robot's marks on a map."""
OF_SERVERS_BYTES_MAX = 1 << 32
"""The same of all operators' marks together."""
PART_BYTES_MIN = 1 << 16
"""Least size of a part that is not the last one: an attachment is few rows."""
GRACE_S = 86_400.0
"""Seconds by the store's age for which bytes stay that no mark names, or whose sender was not heard of."""
SWEEP_MAX = 16
"""Most attachments that one sweep removes."""
NAMERS_MAX = 256
"""Most marks that are looked at to find who names an attachment."""


@dataclass(frozen=True, slots=True)
class Namer:
    """A living mark that names an attachment: the robot it is of, and the size that it states."""

    robot: str
    size_bytes: int


@dataclass(frozen=True, slots=True, kw_only=True)
class AttachmentPart:
    """Part of an attachment on its way into a store."""

    uploader: str
    """Name of the token that sends it; never empty."""
    account: str
    """Robot whose mark names it, and whose room it takes."""
    room_bytes: int
    """Most bytes of all attachments on that account."""
    total_bytes: int
    begin_bytes: int
    data: bytes = field(repr=False)


class Attachments(Protocol):
    """Attachments of all maps of a store; every method may be called from any thread."""

    def wanted(self, map_number: int, *, robot: str | None, limit: int) -> list[Attachment]:
        """Attachments that living marks name, of one robot and of operators or of all, and that are not whole here.

        By the oldest mark of each.
        """
        ...

    def namers(self, map_number: int, sha: bytes) -> list[Namer]:
        """Marks that name an attachment, folded or not, oldest first, at most `NAMERS_MAX`."""
        ...

    def is_whole(self, map_number: int, sha: bytes) -> bool:
        """True if the bytes are here, and had their SHA-256 when they came."""
        ...

    def add_part(self, map_number: int, sha: bytes, part: AttachmentPart) -> int:
        """Keep a part that goes on where this sender's last one ended; bytes held of it. Durable on return.

        A part that begins elsewhere, or has no bytes, changes nothing. Another total begins again.

        Raises:
            BadInputError: kind `too_many_attachments`: there is no room on the account.
            NotFoundError: kind `gone`: the map was deleted.
        """
        ...

    def data(self, map_number: int, sha: bytes, *, uploader: str = "") -> bytes:
        """Bytes of a sender, or of the whole attachment, as far as they are here."""
        ...

    def settle(self, map_number: int, sha: bytes, *, uploader: str) -> None:
        """Take the bytes of a sender, which have the SHA-256, for the attachment, and drop those of all others."""
        ...

    def drop(self, map_number: int, sha: bytes, *, uploader: str = "") -> None:
        """Drop the bytes of a sender, or of the whole attachment."""
        ...

    def whole(self, map_number: int) -> list[Attachment]:
        """Attachments that are whole here, named or not, by SHA-256."""
        ...

    def sweep(self, *, now_s: float) -> bool:
        """Remove some of what is out of use for `GRACE_S` by the store's age; False once nothing is left of that."""
        ...


def check_room(account: str, *, held_bytes: int, more_bytes: int, room_bytes: int) -> None:
    """Refuse an attachment for which an account has no room.

    Raises:
        BadInputError: kind `too_many_attachments`.
    """
    if held_bytes + more_bytes > room_bytes:
        raise BadInputError(
            "too_many_attachments",
            f"the attachments of {account} on this map have {held_bytes} bytes, of at most {room_bytes}: {more_bytes} "
            "more take room that marks have to give first (cairn map mark --remove; it is free a day later)",
        )
