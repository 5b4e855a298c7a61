"""Attachments of marks in memory (`attachments.Attachments`)."""

from collections.abc import Iterator
from dataclasses import dataclass

from tests.memory_store.map import Kept, MemoryMap
from tests.memory_store.maps import MemoryMaps

from cairn_map.commits.attachment import Attachment
from cairn_map.commits.ids import OPERATOR
from cairn_server.map_refusals import map_gone
from cairn_server.store.attachments.attachments import (
    GRACE_S,
    NAMERS_MAX,
    SWEEP_MAX,
    AttachmentPart,
    Namer,
    check_room,
)

Key = tuple[int, bytes, str]


@dataclass(slots=True)
class Sent:
    """Parts of an attachment that one sender sent; the whole of it under an empty sender."""

    account: str
    size_bytes: int
    data: bytes = b""
    idle_age_s: float | None = None


class MemoryAttachments:
    """Attachments of all maps."""

    def __init__(self, maps: MemoryMaps) -> None:
        self._maps = maps
        self._sent: dict[Key, Sent] = {}

    def wanted(self, map_number: int, *, robot: str | None, limit: int) -> list[Attachment]:
        with self._maps.locked():
            found = {
                attachment: None
                for kept, attachment in self._named(map_number)
                if robot is None or kept.new.id.author.robot in (robot, OPERATOR)
            }
            return [each for each in found if (map_number, each.sha, "") not in self._sent][:limit]

    def namers(self, map_number: int, sha: bytes) -> list[Namer]:
        with self._maps.locked():
            found = [
                Namer(kept.new.id.author.robot, attachment.size_bytes)
                for kept, attachment in self._named(map_number)
                if attachment.sha == sha
            ]
            return found[:NAMERS_MAX]

    def is_whole(self, map_number: int, sha: bytes) -> bool:
        return (map_number, sha, "") in self._sent

    def add_part(self, map_number: int, sha: bytes, part: AttachmentPart) -> int:
        with self._maps.locked():
            for gone in self._maps.gone:
                if gone.number == map_number:
                    raise map_gone(gone)
            key = map_number, sha, part.uploader
            known = self._sent.get(key)
            held = known.data if known and known.size_bytes == part.total_bytes else b""
            if part.begin_bytes != len(held) or not part.data:
                return len(held)
            if not held:
                self._sent.pop(key, None)
                used = sum(
                    each.size_bytes
                    for (number, _, _), each in self._sent.items()
                    if number == map_number and each.account == part.account
                )
                check_room(part.account, held_bytes=used, more_bytes=part.total_bytes, room_bytes=part.room_bytes)
            self._sent[key] = Sent(part.account, part.total_bytes, held + part.data)
            return len(held) + len(part.data)

    def data(self, map_number: int, sha: bytes, *, uploader: str = "") -> bytes:
        found = self._sent.get((map_number, sha, uploader))
        return found.data if found else b""

    def settle(self, map_number: int, sha: bytes, *, uploader: str) -> None:
        with self._maps.locked():
            found = self._sent[map_number, sha, uploader]
            for key in [key for key in self._sent if key[:2] == (map_number, sha)]:
                del self._sent[key]
            self._sent[map_number, sha, ""] = found

    def drop(self, map_number: int, sha: bytes, *, uploader: str = "") -> None:
        with self._maps.locked():
            self._sent.pop((map_number, sha, uploader), None)

    def whole(self, map_number: int) -> list[Attachment]:
        with self._maps.locked():
            found = sorted((key[1], each) for key, each in self._sent.items() if key[0] == map_number and not key[2])
            return [Attachment(sha256=sha.hex(), size_bytes=each.size_bytes) for sha, each in found]

    def sweep(self, *, now_s: float) -> bool:
        with self._maps.locked():
            for (number, sha, uploader), each in self._sent.items():
                if not uploader and any(attachment.sha == sha for _, attachment in self._named(number)):
                    each.idle_age_s = None
                elif each.idle_age_s is None:
                    each.idle_age_s = now_s
            idle = {key: each.idle_age_s for key, each in self._sent.items() if each.idle_age_s is not None}
            gone = sorted((since_s, key) for key, since_s in idle.items() if since_s < now_s - GRACE_S)[:SWEEP_MAX]
            for _, key in gone:
                del self._sent[key]
            return len(gone) == SWEEP_MAX

    def _named(self, map_number: int) -> Iterator[tuple[Kept, Attachment]]:
        """Attachments that living marks name, with their commits, oldest first."""
        with self._maps.locked() as maps:
            states: list[MemoryMap] = [state for state in maps.values() if state.row.number == map_number]
        for state in states:
            for kept in state.commits.values():
                if not kept.unfolded_seq:
                    for mark in kept.new.marks:
                        if mark.attachment is not None:
                            yield kept, mark.attachment
