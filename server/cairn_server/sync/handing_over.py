"""Commits that travel between servers: carried by relays and by robots, accepted by the signatures on them.

A token of role relay may hand over what robots signed, and nothing else. A server's own commits (its operators'
retracts, prior data) are signed by the server that hands them out, and accepted from the servers that this one trusts
(`--trust-server`).
"""

import hashlib
import math
import time
from collections.abc import Callable, Collection, Mapping
from contextlib import suppress
from dataclasses import dataclass

from cairn_map.commits.commit import CommitMeta, commit_bytes, version_of_meta
from cairn_map.commits.ids import OPERATOR, SERVERS_OWN, commit_id_from_text
from cairn_map.commits.signature import Signature, SigningKey, signatures_to_text, speaks_for
from cairn_map.errors import CairnError, ConflictError, DeniedError, NotFoundError, UnreachableError
from cairn_server.access.auth import Caller, Role
from cairn_server.store.replica_notes import ReplicaNotes
from cairn_server.store.store import Store
from cairn_server.store.store_age import StoreAge
from cairn_server.store.store_rows import MapRow
from cairn_server.sync.retracting import seal_of

MARKS_EVERY_S = 5.0
"""Time between two readings of the marks that servers of one store share."""
AGES_APART_S = 120.0
"""More than the ages differ that servers of one store count, each by a clock of its own between two looks at it. A mark
counts as so much older, so that none drops what was folded after it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FoundCommit:
    """A stored commit, ready to be handed to another server."""

    data: bytes
    sha: bytes
    seal: str | None
    """Seal of a retract by this server's operators, for the robots that keep it; None on any other commit."""
    signatures: str | None
    """Text of the header `Cairn-Signature`; None: the commit cannot travel to another server."""


def server_key(row: MapRow) -> SigningKey:
    """Key by which this server signs its own commits on a map; like the seal's key, it is in each backup."""
    return SigningKey(hashlib.sha256(b"cairn-server-1" + row.seal_key).digest())


def speaker_of(row: MapRow, caller: Caller, meta: CommitMeta, signed: Collection[Signature], trusted: str) -> Caller:
    """Caller whose rights a push has: the one who brings it, or the signer of what a relay hands over.

    The signatures themselves are checked later, before the commit is kept.

    Raises:
        DeniedError: kind `not_allowed`: an author in whose name the commit speaks did not sign it.
    """
    author = meta.commit_id.author
    if caller.role is not Role.RELAY or not signed or caller.robot == author.robot:
        return caller
    if author.robot in SERVERS_OWN:
        keys = [signature.key.hex() for signature in signed]
        if server_key(row).public_key.hex() not in keys and not set(keys) & set(trusted.split()):
            raise DeniedError(
                "not_allowed",
                f"{meta.id} is signed by a server that this one does not trust; if it should, start this one with "
                f"--trust-server {keys[0]}",
            )
        return Caller(Role.ADMIN, name=caller.name)
    for spoken_for in {author, *(target.author for target in meta.retracted_ids)}:
        if not speaks_for(signed, spoken_for):
            raise DeniedError("not_allowed", f"{meta.id} speaks for {spoken_for}, whose signature is not on it")
    return Caller(Role.ROBOT, author.robot, caller.name)


def found_commit(store: Store, row: MapRow, id_text: str) -> FoundCommit:
    """Stored commit as it was pushed, with the proofs of its author.

    Raises:
        NotFoundError: kind `no_commit`.
        ConflictError: kind `evidence_gone`.
    """
    found = store.commit(row, commit_id_from_text(id_text))
    if found is None:
        raise NotFoundError("no_commit", f"no robot pushed {id_text[:96]} to map {row.name}")
    if found.gone:
        raise ConflictError("evidence_gone", f"the bytes of {found.id} are not kept any more")
    robot = found.id.author.robot
    signatures = found.signatures
    if robot in SERVERS_OWN:
        signatures = signatures_to_text([server_key(row).sign(row.name, found.sha)])
    return FoundCommit(
        data=commit_bytes(found.text, dict(sorted(found.diff.items())), version=version_of_meta(found.text)),
        sha=found.sha,
        seal=seal_of(row, found.sha) if robot == OPERATOR else None,
        signatures=signatures,
    )


class UpstreamProgress:
    """Progress of handing this server's commits to its upstream server, for all maps; called from many threads.

    Where several servers share the store, it is noted there, under the upstream's URL: any of them drops evidence by
    it.
    """

    def __init__(
        self,
        age: StoreAge,
        upstream: str | None,
        notes: ReplicaNotes | None,
        *,
        steady_s: Callable[[], float] = time.monotonic,
    ) -> None:
        """Args: age: of the server's store. upstream: URL of the upstream server, if there is one. notes: shared."""
        self._age = age
        self._upstream = upstream
        self._notes = notes
        self._steady_s = steady_s
        self._read_next_s = -math.inf
        self._handed_over_s: Mapping[str, float] = {}
        self._wake_relay: Callable[[], None] = lambda: None
        self._since_s = age.now_s()
        self._whole_ill: CairnError | None = UnreachableError("not_ready", "it was not asked yet")
        self._ills: Mapping[str, CairnError | None] = {}

    def connect(self, wake_relay: Callable[[], None]) -> None:
        """Give the function that tells a running relay of new commits; it neither fails nor waits."""
        self._wake_relay = wake_relay

    def wake(self) -> None:
        """Tell the relay, if there is one, that a new commit came."""
        self._wake_relay()

    def handed_over(self, map_name: str, begun_s: float) -> None:
        """Note that all of a map's commits as of this age of the store that can travel are on the upstream."""
        if self._notes is None or self._upstream is None:
            self._handed_over_s = {**self._handed_over_s, map_name: begun_s}
            return
        with suppress(UnreachableError):  # the next round notes a later age
            self._notes.put_handed_over(self._upstream, map_name, begun_s)
        self._read_next_s = -math.inf

    def note_round(self, map_name: str | None, ill: CairnError | None) -> None:
        """Note how a round went with a map, or (None) with the upstream server as a whole; None: well."""
        if map_name is None:
            self._whole_ill = ill
        else:
            self._ills = {**self._ills, map_name: ill}

    def ages_s(self, map_names: Collection[str]) -> dict[str, float]:
        """Seconds since all of each map was handed to the upstream server, or since the start if it was not yet."""
        if self._upstream is None:
            return {}
        now_s, marks = self._age.now_s(), self._marks()
        return {name: now_s - marks.get(name, self._since_s) for name in map_names}

    def ups(self, map_names: Collection[str]) -> dict[str, bool]:
        """True for each map with which the last round went well; the server as a whole has the name `""`."""
        if self._upstream is None:
            return {}
        is_up = self._whole_ill is None
        ills = self._ills
        return {"": is_up} | {name: is_up and name in ills and ills[name] is None for name in map_names}

    def complaint(self) -> str | None:
        """Reason why this server is not well: its upstream refuses it. Without a link it goes on, as it should."""
        ills = [self._whole_ill, *self._ills.values()]
        if self._upstream is None or all(ill is None or isinstance(ill, UnreachableError) for ill in ills):
            return None
        return (
            "upstream_refused: the upstream server refuses this one, or some of its maps or commits; the log says why"
        )

    def may_forget_s(self, map_name: str) -> float:
        """Age of the store before which evidence is on the upstream, too, and may go; infinite without one."""
        if self._upstream is None:
            return math.inf
        return self._marks().get(map_name, -math.inf) - (AGES_APART_S if self._notes is not None else 0.0)

    def _marks(self) -> Mapping[str, float]:
        if self._notes is not None and self._upstream is not None and self._steady_s() >= self._read_next_s:
            # A mark that is some seconds old keeps evidence longer, never shorter.
            self._read_next_s = self._steady_s() + MARKS_EVERY_S
            self._handed_over_s = self._notes.handed_over(self._upstream)
        return self._handed_over_s
