"""Attachments of marks on their way in and out: who may send one, in what parts, and what is believed of it.

    wanted    what living marks name and the server lacks: robots and relays ask, and send
    add       a part; with the last one the SHA-256 is compared, and the whole is everybody's
    data      the bytes, to any reader, while a living mark names them

A mark is in the map before its attachment is. A robot sends what its own marks name, or an operator's, who may have
edited one of its own; operators and relays send what any does: bytes with the right SHA-256 are right.
"""

import hashlib
import re

from cairn_map.commits.attachment import ATTACHMENT_BYTES_MAX
from cairn_map.commits.ids import OPERATOR, SERVERS_OWN
from cairn_map.errors import BadInputError, DamagedDataError, DeniedError, NotFoundError
from cairn_map.wire.mark_messages import AttachmentState, WantedAttachments
from cairn_server.access.auth import Caller, Role
from cairn_server.store.attachments.attachments import (
    OF_ROBOT_BYTES_MAX,
    OF_SERVERS_BYTES_MAX,
    PART_BYTES_MIN,
    AttachmentPart,
    Attachments,
    Namer,
)
from cairn_server.store.store_rows import MapRow

SHA = re.compile(r"[0-9a-f]{64}")


class AttachmentTransfer:
    """Attachments on all maps of a store; called from many threads."""

    def __init__(self, kept: Attachments) -> None:
        self._kept = kept

    def wanted(self, row: MapRow, *, robot: str | None, limit: int) -> WantedAttachments:
        """Attachments that marks of one robot, or of all, name and that are not whole here."""
        found = self._kept.wanted(row.number, robot=robot, limit=limit)
        return WantedAttachments(wanted=found, more=len(found) == limit)

    def add(
        self, row: MapRow, caller: Caller, sha_text: str, *, total_bytes: int, begin_bytes: int, data: bytes
    ) -> AttachmentState:
        """Keep a part; one that does not begin where the last one ended is ignored, and the answer says where to go on.

        Raises:
            NotFoundError: kind `no_attachment`: no living mark names it.
            DeniedError: kind `not_allowed`: none of this robot's does.
            BadInputError: kind `bad_attachment`: another size than the marks state, a part that is too small, or not
                the bytes of this SHA-256; `too_large`; `too_many_attachments`.
        """
        sha = _sha_of(sha_text)
        account = self._account(row, caller, sha, total_bytes=total_bytes)
        end_bytes = begin_bytes + len(data)
        if total_bytes > ATTACHMENT_BYTES_MAX or end_bytes > total_bytes:
            raise BadInputError(
                "too_large",
                f"an attachment has at most {ATTACHMENT_BYTES_MAX} bytes, and its parts no more than it; got "
                f"{begin_bytes} + {len(data)} of {total_bytes}",
            )
        if data and end_bytes < total_bytes and len(data) < PART_BYTES_MIN:
            raise BadInputError(
                "bad_attachment", f"a part that is not the last has {PART_BYTES_MIN} bytes or more, got {len(data)}"
            )
        if self._kept.is_whole(row.number, sha):
            return AttachmentState(held_bytes=total_bytes, is_whole=True)
        part = AttachmentPart(
            uploader=caller.name,
            account=account,
            room_bytes=OF_SERVERS_BYTES_MAX if account in SERVERS_OWN else OF_ROBOT_BYTES_MAX,
            total_bytes=total_bytes,
            begin_bytes=begin_bytes,
            data=data,
        )
        held_bytes = self._kept.add_part(row.number, sha, part)
        if held_bytes < total_bytes:
            return AttachmentState(held_bytes=held_bytes, is_whole=False)
        self._settle(row, sha, uploader=caller.name)
        return AttachmentState(held_bytes=total_bytes, is_whole=True)

    def data(self, row: MapRow, sha_text: str) -> bytes:
        """Bytes of an attachment that a living mark names.

        Raises:
            NotFoundError: kind `no_attachment`: none names it, or it is not whole here yet.
            DamagedDataError: kind `damaged_store`.
        """
        sha = _sha_of(sha_text)
        if not self._kept.namers(row.number, sha):
            raise _unnamed(row, sha_text)
        if not self._kept.is_whole(row.number, sha):
            raise NotFoundError(
                "no_attachment", f"attachment {sha_text} did not come to this server yet: its author sends it later"
            )
        data = self._kept.data(row.number, sha)
        if hashlib.sha256(data).digest() != sha:
            raise DamagedDataError(
                "damaged_store", f"attachment {sha_text} is damaged at rest: cairn serve check --repair asks for it"
            )
        return data

    def _account(self, row: MapRow, caller: Caller, sha: bytes, *, total_bytes: int) -> str:
        """Robot on whose account an attachment is kept: the first that names it, and for a robot itself."""
        namers = self._kept.namers(row.number, sha)
        if not namers:
            raise _unnamed(row, sha.hex())
        own = [namer for namer in namers if _may_send(caller, namer)]
        if not own:
            raise DeniedError("not_allowed", "a robot sends what its own marks name; others' robots send theirs")
        for namer in own:
            if namer.size_bytes == total_bytes:
                return namer.robot
        raise BadInputError(
            "bad_attachment", f"the marks that name this attachment state {own[0].size_bytes} bytes, not {total_bytes}"
        )

    def _settle(self, row: MapRow, sha: bytes, *, uploader: str) -> None:
        """Take the bytes of a sender for the attachment, if they are it.

        Raises:
            BadInputError: kind `bad_attachment`.
        """
        found = hashlib.sha256(self._kept.data(row.number, sha, uploader=uploader)).digest()
        if found == sha:
            self._kept.settle(row.number, sha, uploader=uploader)
        # Another request of the same sender may have settled them meanwhile.
        elif not self._kept.is_whole(row.number, sha):
            self._kept.drop(row.number, sha, uploader=uploader)
            raise BadInputError(
                "bad_attachment", f"these bytes have the SHA-256 {found.hex()}, not {sha.hex()}; send them again"
            )


def _may_send(caller: Caller, namer: Namer) -> bool:
    """True if a caller sends what a mark names: a robot what its own does, or an operator's edit of one."""
    return caller.role is not Role.ROBOT or namer.robot in (caller.robot, OPERATOR)


def _unnamed(row: MapRow, sha_text: str) -> NotFoundError:
    return NotFoundError(
        "no_attachment", f"no mark of map {row.name} names attachment {sha_text}; add the mark first, then its bytes"
    )


def _sha_of(text: str) -> bytes:
    """SHA-256 of 64 lower-case digits.

    Raises:
        BadInputError: kind `bad_id`.
    """
    if not SHA.fullmatch(text):
        raise BadInputError("bad_id", f"an attachment is named by 64 hexadecimal digits, got {text[:80]!r}")
    return bytes.fromhex(text)
