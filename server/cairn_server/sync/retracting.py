"""Retracts that operators ask for: which commits they mean, the commits that say so, and the seal on them.

A retract is a commit without evidence by `operator`. Robots fetch it, keep it until no restore can lose it, and push it
back to a server that lost it (SYNC.md rule 11). So that no robot can make one up, the server seals it: an HMAC of its
SHA-256 under a key that lies beside the map, and in every backup of it.
"""

import hashlib
import hmac
import math
from collections.abc import Callable

from cairn_map.commits.commit import RETRACTS_MAX, CommitMeta, make_commit, sha_without_evidence
from cairn_map.commits.ids import OPERATOR, Author, CommitId, commit_id_from_text
from cairn_map.errors import BadInputError, NotFoundError
from cairn_map.wire.messages import Retract
from cairn_server.store.store import Snapshot
from cairn_server.store.store_rows import MapRow, NewCommit, Selection


def targets_of(request: Retract, snapshot: Snapshot) -> list[CommitId]:
    """The commits that a request names or means.

    Raises:
        NotFoundError: kind `nothing_to_retract`: none.
        BadInputError: kind `not_retractable`: one of them is a retract.
    """
    targets = dict.fromkeys(commit_id_from_text(text) for text in request.commits)
    if request.selects:
        targets |= dict.fromkeys(snapshot.commits_where(_selection(request)))
    if not targets:
        meant = "no commit of this map fits" if request.selects else "no commit is named"
        raise NotFoundError("nothing_to_retract", f"{meant}; `cairn map log` shows what there is")
    if any(target.author.robot == OPERATOR for target in targets):
        raise BadInputError("not_retractable", "a retract is not retracted; push the evidence anew")
    return list(targets)


def retract_builders(
    row: MapRow, author: Author, targets: list[CommitId], note: str
) -> list[Callable[[int], NewCommit]]:
    """For each commit that is needed to name them all, what makes it from its number."""
    parts = [targets[start : start + RETRACTS_MAX] for start in range(0, len(targets), RETRACTS_MAX)]
    return [_builder(row, author, part, note) for part in parts]


def seal_of(row: MapRow, sha: bytes) -> str:
    """What only this map's server can write on a retract."""
    return hmac.new(row.seal_key, sha, hashlib.sha256).hexdigest()


def is_sealed(row: MapRow, data: bytes, seal: str | None) -> bool:
    """Whether the commit in these bytes holds no evidence, and this server sealed it."""
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


def _builder(row: MapRow, author: Author, targets: list[CommitId], note: str) -> Callable[[int], NewCommit]:
    def build(n: int) -> NewCommit:
        names = tuple(map(str, targets))
        meta = CommitMeta(id=str(CommitId(author, n)), geometry=row.geometry.digest().hex(), retracts=names, note=note)
        commit = make_commit(meta, {}, row.geometry)
        return NewCommit(
            id=commit.id,
            sha=commit.sha,
            size_bytes=len(commit.data),
            text=commit.text,
            captured_s=None,
            retracts=meta.retracted_ids,
            diff={},
            tops=(0,) * (2 + row.geometry.plane_count),
        )

    return build
