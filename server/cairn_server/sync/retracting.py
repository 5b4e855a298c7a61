"""Retracts that operators ask for: the commits they name or select, the commits that undo those, and their seal.

A retract is a commit without evidence by `operator`. Robots fetch it, keep it until no restore can lose it, and push it
back to a server that lost it (SYNC.md rule 11). So that no robot can forge one, the server seals it: an HMAC of its
SHA-256 under a key that is stored with the map, and in every backup of it.
"""

import hashlib
import hmac
import math
from collections.abc import Callable

from cairn_map.commits.commit import RETRACTS_MAX, sha_without_evidence
from cairn_map.commits.ids import OPERATOR, CommitId, commit_id_from_text, map_of_layer
from cairn_map.errors import BadInputError, NotFoundError
from cairn_map.wire.messages import Retract, Retracted
from cairn_server.access.auth import Caller
from cairn_server.store.numbering import EvidenceGoneError
from cairn_server.store.store import Snapshot, Store
from cairn_server.store.store_rows import MapRow, Selection
from cairn_server.sync.held_commits import WantedCommits
from cairn_server.sync.operator_commits import OperatorCommits


class Retracts:
    """Retracts of this server's operators, on all maps of a store; called from many threads."""

    def __init__(
        self, store: Store, commits: OperatorCommits, wanted: WantedCommits, *, on_new: Callable[[], None]
    ) -> None:
        """`on_new` is called after each retract."""
        self._store = store
        self.commits = commits
        self._wanted = wanted
        self._on_new = on_new

    def retract(self, row: MapRow, request: Retract, *, by: Caller) -> Retracted:
        """Undo commits exactly; durable on return.

        More targets than one commit can name become several commits; the id of the last one is answered.

        Raises:
            NotFoundError: kind `nothing_to_retract`: the request names no commit, or none fits.
            BadInputError: kind `not_retractable`: a retract is not retracted.
            ConflictError: kind `evidence_gone`: robots that have a commit's bytes must push them again first, and are
                asked to from now on.
        """
        with self._store.snapshot(row) as snapshot:
            targets = targets_of(request, snapshot)
        names = [str(target) for target in targets]
        if request.preview:
            return Retracted(id=None, commits=names)
        parts = [targets[start : start + RETRACTS_MAX] for start in range(0, len(targets), RETRACTS_MAX)]
        try:
            ids = [str(self.commits.append(row, by=by.name, retracts=tuple(part), note=request.note)) for part in parts]
        except EvidenceGoneError as exc:
            self._wanted.note(row.name, exc.commits, asker=OPERATOR)
            raise
        detail = f"map {row.name}: {ids[-1]} takes out {len(names)} commits: {request.note}"
        self._store.audit_log.add(by.name, "retract", detail, client=by.address)
        self._on_new()
        return Retracted(id=ids[-1], commits=names)


def targets_of(request: Retract, snapshot: Snapshot) -> list[CommitId]:
    """Commits that a request names or selects.

    Raises:
        NotFoundError: kind `nothing_to_retract`: there are none.
        BadInputError: kind `not_retractable`: one of them is a retract.
    """
    targets = dict.fromkeys(commit_id_from_text(text) for text in request.commits)
    if request.selects:
        targets |= dict.fromkeys(snapshot.commits_where(_selection(request)))
    if not targets:
        meant = "no commit of this map fits" if request.selects else "no commit is named"
        raise NotFoundError("nothing_to_retract", f"{meant}; `cairn map log` shows what there is")
    if any(target.author.robot == OPERATOR for target in targets):
        raise BadInputError(
            "not_retractable",
            "a retract is not retracted: push the evidence again; a mark goes by cairn map mark --remove, and a layer "
            "stays for as long as its map",
        )
    return list(targets)


def seal_of(row: MapRow, sha: bytes) -> str:
    """Seal of a retract, which only this map's server can write."""
    # Layers have their map's key, and a seal counts on one log alone.
    of_layer = b"" if map_of_layer(row.name) is None else row.name.encode() + b"\0"
    return hmac.new(row.seal_key, of_layer + sha, hashlib.sha256).hexdigest()


def is_sealed(row: MapRow, data: bytes, seal: str | None) -> bool:
    """True if the commit in these bytes holds no evidence and bears this server's seal."""
    sha = sha_without_evidence(data) if seal is not None and row.seal_key else None
    return sha is not None and hmac.compare_digest(seal_of(row, sha).encode(), (seal or "").encode())


def _selection(request: Retract) -> Selection:
    def interval(after_s: float | None, before_s: float | None) -> tuple[float, float]:
        return (-math.inf if after_s is None else after_s, math.inf if before_s is None else before_s)

    return Selection(
        robot=request.robot,
        rig=bytes.fromhex(request.rig) if request.rig else None,
        pushed_s=interval(request.pushed_after_s, request.pushed_before_s),
        captured_s=interval(request.captured_after_s, request.captured_before_s),
    )
