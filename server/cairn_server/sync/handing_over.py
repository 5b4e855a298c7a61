"""Commits that somebody else brings: relays and robots that carry for others. Whose word they are is in the signatures.

Whoever has a token of role relay may hand over what robots signed, and nothing else. What a server itself says (its
operators' retracts, prior data) is signed by the server that hands it out, and taken from servers that this one was
told to trust.
"""

import hashlib
import math
import time
from collections.abc import Callable, Collection
from dataclasses import dataclass

from cairn_map.commits.commit import CommitMeta, commit_bytes
from cairn_map.commits.ids import INITIAL, OPERATOR, commit_id_from_text
from cairn_map.commits.signature import Signature, SigningKey, signatures_to_text, speaks_for
from cairn_map.errors import ConflictError, DeniedError, NotFoundError
from cairn_server.access.auth import Caller, Role
from cairn_server.store.store import Store
from cairn_server.store.store_rows import MapRow
from cairn_server.sync.retracting import seal_of

SERVERS_OWN = frozenset({OPERATOR, INITIAL})
"""Authors in whose name servers speak."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FoundCommit:
    """A commit as it is handed out."""

    data: bytes
    sha: bytes
    seal: str | None
    """On a retract of this server's operators, for the robots that keep it for this server."""
    signatures: str | None
    """As in `Cairn-Signature`; None: it cannot travel to another server."""


def server_key(row: MapRow) -> SigningKey:
    """By which this server signs what it says itself on a map; as the seal's key, it is in each backup."""
    return SigningKey(hashlib.sha256(b"cairn-server-1" + row.seal_key).digest())


def speaker_of(row: MapRow, caller: Caller, meta: CommitMeta, signed: Collection[Signature], trusted: str) -> Caller:
    """Whose rights a push has: the caller's, or those of whoever signed what a relay hands over.

    The signatures are still to be checked; until then nothing is kept.

    Raises:
        DeniedError: kind `not_allowed`: somebody in whose name the commit speaks did not sign it.
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
    """A commit as it was pushed, with what proves whose it is.

    Raises:
        NotFoundError: kind `no_commit`.
        ConflictError: kind `evidence_gone`.
    """
    found = store.commit(row, commit_id_from_text(id_text))
    if found is None:
        raise NotFoundError("no_commit", f"nobody pushed {id_text[:96]} to map {row.name}")
    if found.gone:
        raise ConflictError("evidence_gone", f"the bytes of {found.id} are not kept any more")
    robot = found.id.author.robot
    signatures = found.signatures
    if robot in SERVERS_OWN:
        signatures = signatures_to_text([server_key(row).sign(row.name, found.sha)])
    return FoundCommit(
        data=commit_bytes(found.text, dict(sorted(found.diff.items()))),
        sha=found.sha,
        seal=seal_of(row, found.sha) if robot == OPERATOR else None,
        signatures=signatures,
    )


class Joining:
    """Of all maps; called from many threads."""

    def __init__(self, *, is_joined: bool) -> None:
        self._is_joined = is_joined
        self._handed_over_s: dict[str, float] = {}
        self._wake_relay: Callable[[], None] = lambda: None

    def connect(self, wake_relay: Callable[[], None]) -> None:
        """Give the function that tells a running relay of new commits."""
        self._wake_relay = wake_relay

    def wake(self) -> None:
        """Report new commits to the relay, if one runs."""
        self._wake_relay()

    def handed_over(self, map_name: str, begun_s: float) -> None:
        """All that was in a map at this time (UTC seconds since 1970) was given to the upstream, if it can travel."""
        self._handed_over_s[map_name] = begun_s

    def ages_s(self) -> dict[str, float]:
        """Seconds since all of a map was handed to the upstream server, by the map's name."""
        now_s = time.time()
        return {name: max(0.0, now_s - begun_s) for name, begun_s in list(self._handed_over_s.items())}

    def may_forget_s(self, map_name: str) -> float:
        """Evidence that was folded before this time is on the upstream, too; infinite without one."""
        return self._handed_over_s.get(map_name, -math.inf) if self._is_joined else math.inf
