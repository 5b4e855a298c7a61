"""Attachments of marks in a folder, a file for each under its SHA-256: a robot's own, or those that a relay carries.

    2c26b46b...ae      the bytes, whole
    2c26b46b...ae.3    nothing: a carried mark names an attachment of 3 bytes, which did not come yet

Files are compared with their names when they are read: what is damaged is as good as not there, and comes again.
"""

import hashlib
import re
from pathlib import Path

from cairn_client.replica.durable_file import write_durable_file
from cairn_map.commits.attachment import ATTACHMENT_BYTES_MAX, Attachment, attachment_of
from cairn_map.errors import UnreachableError

ATTACHMENTS = "attachments"
"""Name of the folder, in that of a robot or a relay."""
FILE = re.compile(r"[0-9a-f]{64}")
AWAITED = re.compile(r"([0-9a-f]{64})\.([1-9][0-9]{0,7})")


class AttachmentFolder:
    """Attachments by SHA-256; made with the first one. Called from any thread."""

    def __init__(self, folder: Path, *, size_bytes_max: int) -> None:
        self._folder = folder
        self._size_bytes_max = size_bytes_max

    def names(self) -> frozenset[str]:
        """SHA-256, hex, of the attachments here.

        Raises:
            UnreachableError: kind `store_failed`: the folder cannot be read.
        """
        return frozenset(name for name in self._list() if FILE.fullmatch(name))

    def read(self, sha256: str) -> bytes | None:
        """Bytes of an attachment; None if they are not here, or damaged."""
        try:
            with (self._folder / sha256).open("rb") as file:
                data = file.read(ATTACHMENT_BYTES_MAX + 1)
        except OSError:
            return None
        return data if hashlib.sha256(data).hexdigest() == sha256 else None

    def keep(self, data: bytes) -> Attachment:
        """Keep an attachment; durable on return.

        Raises:
            BadInputError: kind `bad_attachment` or `too_large`.
            UnreachableError: kind `outbox_full`: there is no room for it; `store_failed`.
        """
        made = attachment_of(data)
        if self.read(made.sha256) is not None:
            return made
        self._check_room(made.size_bytes)
        write_durable_file(self._folder / made.sha256, data)
        self._forget_awaited(made.sha256)
        return made

    def drop(self, sha256: str) -> None:
        """Remove an attachment, if it is here.

        Raises:
            UnreachableError: kind `store_failed`.
        """
        try:
            (self._folder / sha256).unlink(missing_ok=True)
        except OSError as exc:
            raise UnreachableError("store_failed", f"cannot write to {self._folder}: {exc.strerror}") from exc

    def make_room(self, size_bytes: int) -> None:
        """Remove the oldest attachments until so many bytes fit; for a relay, whose attachments a server has, too."""
        found = sorted((path.stat().st_mtime_ns, path) for path in map(self._folder.joinpath, self.names()))
        while found and self.size_bytes() + size_bytes > self._size_bytes_max:
            self.drop(found.pop(0)[1].name)

    def size_bytes(self) -> int:
        """Bytes of all attachments here."""
        return sum((self._folder / name).stat().st_size for name in self.names())

    def awaited(self) -> list[Attachment]:
        """Attachments that carried marks name and that did not come, by SHA-256."""
        here = self.names()
        found = (AWAITED.fullmatch(name) for name in sorted(self._list()))
        return [
            Attachment(sha256=each[1], size_bytes=int(each[2]))
            for each in found
            if each is not None and each[1] not in here and int(each[2]) <= ATTACHMENT_BYTES_MAX
        ]

    def await_one(self, attachment: Attachment) -> None:
        """Note that a mark names an attachment.

        Raises:
            UnreachableError: kind `store_failed`.
        """
        if self.read(attachment.sha256) is not None:
            return
        try:
            self._folder.mkdir(0o700, parents=True, exist_ok=True)
            (self._folder / f"{attachment.sha256}.{attachment.size_bytes}").touch(0o600)
        except OSError as exc:
            raise UnreachableError("store_failed", f"cannot write to {self._folder}: {exc.strerror}") from exc

    def _forget_awaited(self, sha256: str) -> None:
        for name in self._list():
            if name.startswith(f"{sha256}.") and AWAITED.fullmatch(name):
                (self._folder / name).unlink(missing_ok=True)

    def _check_room(self, size_bytes: int) -> None:
        held_bytes = self.size_bytes()
        if held_bytes + size_bytes > self._size_bytes_max:
            raise UnreachableError(
                "outbox_full",
                f"no room for an attachment of {size_bytes} bytes: {held_bytes} of {self._size_bytes_max} are taken by "
                "those that the server does not have for good; sync, and try again later",
            )

    def _list(self) -> list[str]:
        try:
            return [path.name for path in self._folder.iterdir()]
        except FileNotFoundError:
            return []
        except OSError as exc:
            raise UnreachableError("store_failed", f"cannot read {self._folder}: {exc.strerror}") from exc
