"""Uploads: bodies of commits that come in parts, so that a broken link goes on where it stopped.

They are in this process's memory (`staged_bodies`), or in the notes of a store that several servers work on: losing
them costs bytes, never evidence. A robot pushes its commits one after the other, so it has one upload here, and a
second one while an amend waits for what it takes out. Only bytes received take room, not announced ones. Only the whole
body is checked and acknowledged, by the steps of a push.

Where there is no room, who holds most gives way: the robot of the largest share, on all maps together, loses what it
left idle longest, and if that is the robot that sends, it waits. So no upload goes for one whose robot holds more, and
small ones never go.
"""

import hashlib
import threading
import time
from collections import Counter
from collections.abc import Callable

from cairn_map.commits.commit import COMMIT_BYTES_MAX
from cairn_map.commits.ids import CommitId, commit_id_from_text
from cairn_map.errors import BadInputError, CairnError, DeniedError, UnreachableError
from cairn_map.wire.messages import Upload
from cairn_server.access.auth import Caller, Role
from cairn_server.store.numbering import EvidenceGoneError
from cairn_server.store.replica_notes import BodyPart, BodyPlace, StagedBodies, StagedBody
from cairn_server.store.store import Store
from cairn_server.store.store_rows import MapRow
from cairn_server.sync.pushes import Pushes
from cairn_server.sync.staged_bodies import OwnStagedBodies

STAGED_BYTES_MAX = 1 << 27
"""Most bytes held, of all robots together."""
BODIES_MAX = 2
"""Most bodies of one robot on one map."""
KEPT_S = 86_400.0
"""Time without a new part after which an upload is dropped."""
IDLE_S = 900.0
"""Time without a new part after which an upload gives way to any other: on the slowest link parts come every 260 s."""


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
        self._bodies: StagedBodies = OwnStagedBodies(steady_s) if store.replicas is None else store.replicas.bodies
        self._lock = threading.Lock()
        """Other servers of the store do not wait for it: parts that come at once may go over the bounds by themselves.
        """

    def state(self, row: MapRow, caller: Caller, id_text: str, digest: str) -> Upload:
        """State of an upload: the bytes received, and the SHA-256 of the commit if it is kept.

        Raises:
            DeniedError: kind `not_allowed`: it is another robot's.
        """
        commit, robot = uploaded_by(caller, id_text)
        sha = self._store.kept_sha(row, commit)
        size_bytes = self._size(BodyPlace(row.number, robot, commit), digest)
        return Upload(size_bytes=size_bytes, sha=sha.hex() if sha else None)

    def add(
        self, row: MapRow, caller: Caller, id_text: str, part: BodyPart, *, signatures: str | None = None
    ) -> tuple[Upload, bool]:
        """Add a part, and push the commit if it was the last one; the upload's state, and True if the commit is new.

        A part that does not begin where the last one ended is ignored; the state says where to go on. `signatures` is
        the text of the header `Cairn-Signature`; that of the last part counts.

        Raises:
            BadInputError: kind `too_large`; or, with the last part, as a push.
            CairnError: as a push; after `UnreachableError` and `EvidenceGoneError` the bytes stay, and an empty part
                tries again.
        """
        commit, robot = uploaded_by(caller, id_text)
        place = BodyPlace(row.number, robot, commit)
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
            self._bodies.drop(place)
            return Upload(size_bytes=0), False
        try:
            is_new = self._pushes.keep(row, caller, id_text, whole, signatures=signatures)
        except (UnreachableError, EvidenceGoneError):
            raise
        except CairnError:
            self._bodies.drop(place)
            raise
        self._bodies.drop(place)
        sha = self._store.kept_sha(row, commit)
        return Upload(size_bytes=len(whole), sha=sha.hex() if sha else None), is_new

    def staged_bytes(self) -> int:
        """Bytes held."""
        return sum(body.size_bytes for body in self._bodies.all())

    def _take(self, place: BodyPlace, part: BodyPart) -> bytes | None:
        """Add a part to its upload; the whole body, if this was its last part.

        Raises:
            UnreachableError: kind `busy`: there is no room for it; what came before stays.
        """
        if not part.total_bytes:
            return b""
        with self._lock:
            found = self._bodies.at(place)
            is_begun = found is not None and (found.digest, found.total_bytes) == (part.digest, part.total_bytes)
            size_bytes = found.size_bytes if found is not None and is_begun else 0
            if part.offset_bytes == size_bytes:
                size_bytes += len(part.data)
            if not size_bytes:
                return None
            self._make_room(place, size_bytes)
            staged = self._bodies.append(place, part)
        if staged is None or staged.digest != part.digest or staged.size_bytes < part.total_bytes:
            return None
        return self._bodies.body(place, part.digest)

    def _make_room(self, place: BodyPlace, size_bytes: int) -> None:
        """Drop the robot's own uploads beyond `BODIES_MAX`, old ones, and of the rest as many as must give way.

        Raises:
            UnreachableError: kind `busy`: this robot itself holds most.
        """
        others = [body for body in self._bodies.all() if body.place != place]
        own = [body for body in others if body.place[:2] == place[:2]]
        gone = own[: max(0, len(own) + 1 - BODIES_MAX)] + [body for body in others if body.idle_s > KEPT_S]
        others = [body for body in others if body not in gone]
        while sum(body.size_bytes for body in others) + size_bytes > STAGED_BYTES_MAX:
            try:
                found = _giving_way(place.robot, size_bytes, others)
            except UnreachableError:
                self._drop(gone)
                raise
            gone.append(found)
            others.remove(found)
        self._drop(gone)

    def _drop(self, bodies: list[StagedBody]) -> None:
        for body in bodies:
            self._bodies.drop(body.place)

    def _size(self, place: BodyPlace, digest: str) -> int:
        found = self._bodies.at(place)
        return found.size_bytes if found is not None and found.digest == digest else 0


def _giving_way(robot: str, size_bytes: int, others: list[StagedBody]) -> StagedBody:
    """Upload to drop next for one that is to have so many bytes; `others`: the longest idle first.

    Raises:
        UnreachableError: kind `busy`: this robot itself holds most.
    """
    if others and others[0].idle_s > IDLE_S:
        return others[0]
    # By name: a robot may be on any number of maps, and would have a share on each.
    of_robot = Counter({robot: size_bytes})
    for body in others:
        of_robot[body.place.robot] += body.size_bytes
    # Of equal ones any gives way, but never the robot that sends.
    most = max(of_robot.values())
    found = next((body for body in others if of_robot[body.place.robot] == most), None)
    if found is None:
        raise UnreachableError(
            "busy", "no room for more parts of this commit: other robots' uploads are here", retry_after_s=30.0
        )
    return found
