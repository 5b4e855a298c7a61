"""What stands for a commit that was taken back or got another id: the first that names it, for ever.

    C  <- M1  <- M2         M1 amends C, M2 amends M1: M2 is what stands for C now

A retract takes effect once (SYNC.md rule 11), so whoever names a commit later changes nothing. The texts are part of
the transaction that keeps the naming commit; they are read anew after it, so that one that failed leaves no trace.
"""

from cairn_client.replica.replica_store import ReplicaStore
from cairn_map.commits.ids import CommitId, commit_id_from_text


class Successors:
    """The successors of a robot's commits, in its store."""

    def __init__(self, store: ReplicaStore) -> None:
        self._store = store
        self._of: dict[CommitId, CommitId] = {}

    def of(self, commit: CommitId) -> CommitId | None:
        """Who took a commit out, of those that were read."""
        return self._of.get(commit)

    def latest(self, commit: CommitId) -> CommitId:
        """What stands for a commit now; itself, if nobody took it out."""
        while (successor := self._stored(commit)) is not None:
            commit = successor
        return commit

    def read(self, commit: CommitId) -> None:
        """Take over what the store says of a commit."""
        successor = self._stored(commit)
        if successor is not None:
            self._of[commit] = successor

    def put(self, commit: CommitId, by: CommitId) -> None:
        """Within a transaction: `by` takes a commit out, unless one did before."""
        if self._stored(commit) is None:
            self._store.put(_key(commit), str(by))

    def rename(self, old: CommitId, new: CommitId, *, takes_out: tuple[CommitId, ...]) -> None:
        """Within a transaction: a commit, which takes out these, gets a new id; what stands for it stays so."""
        by = self._stored(old)
        self._store.put(_key(old), str(new) if by is None else str(by))
        self._store.put(_key(new), None if by is None else str(by))
        for target in takes_out:
            if self._stored(target) == old:
                self._store.put(_key(target), str(new))

    def _stored(self, commit: CommitId) -> CommitId | None:
        text = self._store.get(_key(commit))
        return None if text is None else commit_id_from_text(text)


def _key(commit: CommitId) -> str:
    return f"successor:{commit}"
