"""Bodies of commits that come in parts, so that a link that breaks goes on where it stopped.

In memory, and of no weight: losing them costs bytes, never evidence. A robot pushes its commits one after the other, so
it has one upload here, and a second one while an amend waits for what it takes out; who comes next takes the room of
whoever was quiet longest. Room is what came: announcing much takes none. Only the whole body is checked and
acknowledged, and by the very steps of a push.
"""

import hashlib
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field

from cairn_map.commits.commit import COMMIT_BYTES_MAX
from cairn_map.commits.ids import CommitId, commit_id_from_text
from cairn_map.errors import BadInputError, CairnError, DeniedError, UnreachableError
from cairn_map.wire.messages import Upload
from cairn_server.access.auth import Caller, Role
from cairn_server.store.numbering import EvidenceGoneError
from cairn_server.store.store import Store
from cairn_server.store.store_rows import MapRow
from cairn_server.sync.pushes import Pushes

STAGED_BYTES_MAX = 1 << 27
"""Of all robots together."""
BODIES_MAX = 2
"""Of one robot on one map."""
KEPT_S = 86_400.0
"""Bytes that nobody added to for so long go."""

Place = tuple[int, str, CommitId]
"""Map, robot or relay, and which commit."""


@dataclass(frozen=True, slots=True)
class Part:
    """Some bytes of a body."""

    digest: str
    """SHA-256 of the whole body, hex."""
    total_bytes: int
    offset_bytes: int
    data: bytes
    signatures: str | None = None
    """As in `Cairn-Signature`; those that come with the last part count."""


@dataclass(slots=True)
class _Staged:
    """The beginning of a body."""

    digest: str
    total_bytes: int
    used_s: float
    data: bytearray = field(default_factory=bytearray)


def uploaded_by(caller: Caller, id_text: str) -> tuple[CommitId, str]:
    """The commit, and for whom its bytes are held: its robot, or the relay that brings it, which is no robot's name.

    Raises:
        DeniedError: kind `not_allowed`: it is another robot's.
        BadInputError: kind `bad_id`.
    """
    commit = commit_id_from_text(id_text)
    if caller.role is Role.RELAY:
        return commit, f"{caller.name}/"
    if not caller.may_author(commit.author.robot):
        raise DeniedError("not_allowed", f"this token stands for {caller.robot}, not for {commit.author.robot}")
    return commit, caller.robot or commit.author.robot


class Uploads:
    """All robots' uploads; called from many threads."""

    def __init__(self, store: Store, pushes: Pushes, *, steady_s: Callable[[], float] = time.monotonic) -> None:
        self._store = store
        self._pushes = pushes
        self._steady_s = steady_s
        self._lock = threading.Lock()
        self._staged: dict[Place, _Staged] = {}

    def state(self, row: MapRow, caller: Caller, id_text: str, digest: str) -> Upload:
        """How much of a body is here, and whether the commit is.

        Raises:
            DeniedError: kind `not_allowed`: it is another robot's.
        """
        commit, robot = uploaded_by(caller, id_text)
        kept = self._store.commit(row, commit)
        with self._lock:
            found = self._at((row.number, robot, commit), digest)
            return Upload(
                size_bytes=len(found.data) if found else 0, sha=kept.sha.hex() if kept and not kept.gone else None
            )

    def add(self, row: MapRow, caller: Caller, id_text: str, part: Part) -> tuple[Upload, bool]:
        """Add a part, and push the commit if that was the last one: where it stands, and whether it is a new commit.

        A part that does not begin where the last one ended is not taken; the answer says where to go on.

        Raises:
            BadInputError: kind `too_large`; or, with the last part, as a push.
            CairnError: as a push; after `UnreachableError` and `EvidenceGoneError` the bytes stay, and an empty part
                tries again.
        """
        commit, robot = uploaded_by(caller, id_text)
        place = (row.number, robot, commit)
        if part.total_bytes > COMMIT_BYTES_MAX or part.offset_bytes + len(part.data) > part.total_bytes:
            raise BadInputError(
                "too_large",
                f"a commit has at most {COMMIT_BYTES_MAX} bytes, and its parts no more than it; got "
                f"{part.offset_bytes} + {len(part.data)} of {part.total_bytes}",
            )
        # What a push would refuse in any case need not come first, and nobody makes the server digest it for nothing.
        self._pushes.check_room(row, caller, size_bytes=part.total_bytes)
        whole = self._take(place, part)
        if whole is None:
            return Upload(size_bytes=self._size(place, part.digest)), False
        if hashlib.sha256(whole).hexdigest() != part.digest:
            self._drop(place)
            return Upload(size_bytes=0), False
        try:
            is_new = self._pushes.keep(row, caller, id_text, whole, signatures=part.signatures)
        except (UnreachableError, EvidenceGoneError):
            raise
        except CairnError:
            self._drop(place)
            raise
        self._drop(place)
        kept = self._store.commit(row, commit)
        return Upload(size_bytes=len(whole), sha=kept.sha.hex() if kept else None), is_new

    def staged_bytes(self) -> int:
        """What is held in memory."""
        with self._lock:
            return sum(len(found.data) for found in self._staged.values())

    def _take(self, place: Place, part: Part) -> bytes | None:
        """The whole body, if this part was its last one."""
        with self._lock:
            found = self._at(place, part.digest)
            if found is None or found.total_bytes != part.total_bytes:
                found = _Staged(part.digest, part.total_bytes, self._steady_s())
            if part.offset_bytes == len(found.data):
                found.data += part.data
            found.used_s = self._steady_s()
            if found.data:
                self._staged.pop(place, None)
                self._make_room(place, len(found.data))
                self._staged[place] = found  # the one used last stands last
            return bytes(found.data) if len(found.data) == found.total_bytes else None

    def _make_room(self, place: Place, size_bytes: int) -> None:
        """Forget the robot's own beyond its two, what is too old, and of the rest those that were quiet longest."""
        now_s = self._steady_s()
        own = [other for other in self._staged if other[:2] == place[:2]]
        for other in own[: 1 - BODIES_MAX]:
            del self._staged[other]
        held_bytes = sum(len(found.data) for found in self._staged.values())
        for other, found in list(self._staged.items()):
            if held_bytes + size_bytes > STAGED_BYTES_MAX or now_s - found.used_s > KEPT_S:
                held_bytes -= len(found.data)
                del self._staged[other]

    def _size(self, place: Place, digest: str) -> int:
        with self._lock:
            found = self._at(place, digest)
            return len(found.data) if found else 0

    def _at(self, place: Place, digest: str) -> _Staged | None:
        found = self._staged.get(place)
        return found if found and found.digest == digest else None

    def _drop(self, place: Place) -> None:
        with self._lock:
            self._staged.pop(place, None)
