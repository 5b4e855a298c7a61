"""Uploads: bodies of commits that come in parts, so that a broken link goes on where it stopped.

They are in memory only: losing them costs bytes, never evidence. A robot pushes its commits one after the other, so it
has one upload here, and a second one while an amend waits for what it takes out. Only bytes received take room, not
announced ones. Only the whole body is checked and acknowledged, by the steps of a push.

Where there is no room, who holds most gives way: the robot of the largest share loses what it left idle longest, and if
that is the robot that sends, it waits. So no upload goes for one whose robot holds more, and small ones never go.
"""

import hashlib
import threading
import time
from collections import Counter
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
"""Most bytes held, of all robots together."""
BODIES_MAX = 2
"""Most bodies of one robot on one map."""
KEPT_S = 86_400.0
"""Time without a new part after which an upload is dropped."""
IDLE_S = 900.0
"""Time without a new part after which an upload gives way to any other: on the slowest link parts come every 260 s."""

Place = tuple[int, str, CommitId]
"""Place of an upload: map, robot or relay, and commit."""


@dataclass(frozen=True, slots=True)
class Part:
    """Part of a body."""

    digest: str
    """Hex of the whole body's SHA-256."""
    total_bytes: int
    offset_bytes: int
    data: bytes
    signatures: str | None = None
    """Text of the header `Cairn-Signature`; the one that comes with the last part counts."""


@dataclass(slots=True)
class _Staged:
    """Beginning of a body."""

    digest: str
    total_bytes: int
    used_s: float
    data: bytearray = field(default_factory=bytearray)

    def add(self, part: Part, now_s: float) -> None:
        """Append a part, if it begins where the last one ended."""
        if part.offset_bytes == len(self.data):
            self.data += part.data
        self.used_s = now_s


def uploaded_by(caller: Caller, id_text: str) -> tuple[CommitId, str]:
    """Commit of an upload, and the name under which its bytes are held: its robot's, or one made of the relay's token.

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
    """Uploads of all robots; called from many threads."""

    def __init__(self, store: Store, pushes: Pushes, *, steady_s: Callable[[], float] = time.monotonic) -> None:
        self._store = store
        self._pushes = pushes
        self._steady_s = steady_s
        self._lock = threading.Lock()
        self._staged: dict[Place, _Staged] = {}

    def state(self, row: MapRow, caller: Caller, id_text: str, digest: str) -> Upload:
        """State of an upload: the bytes received, and the SHA-256 of the commit if it is kept.

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
        """Add a part, and push the commit if it was the last one; the upload's state, and True if the commit is new.

        A part that does not begin where the last one ended is ignored; the state says where to go on.

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
        # Refused at once where the push would be in any case, so that no client makes the server digest it in vain.
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
        """Bytes held in memory."""
        with self._lock:
            return sum(len(found.data) for found in self._staged.values())

    def _take(self, place: Place, part: Part) -> bytes | None:
        """Add a part to its upload; the whole body, if this was its last part.

        Raises:
            UnreachableError: kind `busy`: there is no room for it; what came before stays.
        """
        with self._lock:
            found = self._at(place, part.digest)
            if found is None or found.total_bytes != part.total_bytes:
                found = _Staged(part.digest, part.total_bytes, self._steady_s())
            is_next = part.offset_bytes == len(found.data)
            size_bytes = len(found.data) + (len(part.data) if is_next else 0)
            if size_bytes:
                self._make_room(place, size_bytes)
                self._staged.pop(place, None)
                self._staged[place] = found  # the one used last stands last
            found.add(part, self._steady_s())
            return bytes(found.data) if len(found.data) == found.total_bytes else None

    def _make_room(self, place: Place, size_bytes: int) -> None:
        """Drop the robot's own uploads beyond `BODIES_MAX`, old ones, and of the rest as many as must give way.

        Raises:
            UnreachableError: kind `busy`: this robot itself holds most.
        """
        now_s = self._steady_s()
        own = [other for other in self._staged if other[:2] == place[:2] and other != place]
        for other in own[: max(0, len(own) + 1 - BODIES_MAX)]:
            del self._staged[other]
        for other, found in list(self._staged.items()):
            if now_s - found.used_s > KEPT_S:
                del self._staged[other]
        while sum((sizes := self._sizes(place, size_bytes)).values()) > STAGED_BYTES_MAX:
            del self._staged[self._giving_way(place, sizes, now_s)]

    def _sizes(self, place: Place, size_bytes: int) -> dict[Place, int]:
        """Bytes of every upload, of the one at `place` those that it is to have."""
        return {other: len(found.data) for other, found in self._staged.items()} | {place: size_bytes}

    def _giving_way(self, place: Place, sizes: dict[Place, int], now_s: float) -> Place:
        """Upload to drop next, other than the one at `place`."""
        others = [other for other in self._staged if other != place]  # longest idle first
        if others and now_s - self._staged[others[0]].used_s > IDLE_S:
            return others[0]
        of_robot: Counter[tuple[int, str]] = Counter()
        for other, size in sizes.items():
            of_robot[other[:2]] += size
        # Of equal ones any gives way, but never the robot that sends.
        most = max(of_robot[other[:2]] for other in sizes)
        found = next((other for other in others if of_robot[other[:2]] == most), None)
        if found is None:
            raise UnreachableError(
                "busy", "no room for more parts of this commit: other robots' uploads are here", retry_after_s=30.0
            )
        return found

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
