"""Commits that a server makes for its operators: their author, and numbers that this server never used before."""

import threading
from collections.abc import Callable

from cairn_map.commits.commit import CommitMeta, make_commit
from cairn_map.commits.ids import OPERATOR, Author, CommitId, new_incarnation
from cairn_map.commits.mark import Mark
from cairn_map.epochs.layer import LayerDefinition
from cairn_map.errors import BadInputError, ConflictError
from cairn_server.store.store import Store
from cairn_server.store.store_rows import MapRow, NewCommit


class OperatorCommits:
    """Commits without evidence by `operator`, on all maps of a store; called from many threads."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self.operator = new_incarnation()
        """Incarnation of the author, new with every start: a restored server must not reuse the numbers it lost."""
        self._lock = threading.Lock()
        self._next: dict[tuple[int, Author], int] = {}
        """Next number, by map and author; a lower one says that the store was restored while this server ran."""

    def append(
        self,
        row: MapRow,
        *,
        by: str,
        retracts: tuple[CommitId, ...] = (),
        note: str = "",
        marks: tuple[Mark, ...] = (),
        layer: LayerDefinition | None = None,
    ) -> CommitId:
        """Keep a commit that takes others out, or brings marks, or both, or defines a layer; durable on return.

        The log names the token that asked for it, `by`.

        Raises:
            ConflictError: kind `evidence_gone`, `other_layer` or `too_many_layers`.
            BadInputError: kind `too_many_marks`.
        """
        author = Author(OPERATOR, self.operator)
        build = _builder(row, author, by, retracts, note, marks, layer)
        key = row.number, author
        tried: list[int] = []

        def build_next(n: int) -> NewCommit:
            if n < self._next.get(key, 0):
                raise _LostNumberError("id_taken", f"{CommitId(author, n)} was another commit, which was lost")
            tried.append(n)
            return build(n)

        try:
            commit = self._store.append_built(row, author, build_next).id
        except _LostNumberError:
            self.operator = new_incarnation()
            return self.append(row, by=by, retracts=retracts, note=note, marks=marks, layer=layer)
        except (BadInputError, ConflictError):  # refused, so that the number stays free
            raise
        except Exception:  # it may be kept: the number counts as used
            self._use(key, tried)
            raise
        self._use(key, [commit.n])
        return commit

    def _use(self, key: tuple[int, Author], numbers: list[int]) -> None:
        """Note numbers that no other commit may have."""
        with self._lock:
            self._next[key] = max([self._next.get(key, 0), *(n + 1 for n in numbers)])


class _LostNumberError(ConflictError):
    """The next number of an author is one that this server has used."""


def _builder(
    row: MapRow,
    author: Author,
    by: str,
    retracts: tuple[CommitId, ...],
    note: str,
    marks: tuple[Mark, ...],
    layer: LayerDefinition | None,
) -> Callable[[int], NewCommit]:
    has_layers = row.layer.has_epochs and not marks and layer is None

    def build(n: int) -> NewCommit:
        meta = CommitMeta(
            id=str(CommitId(author, n)),
            geometry=None if has_layers else row.geometry.digest().hex(),
            layers=row.layer.identities if has_layers else (),
            retracts=tuple(map(str, retracts)),
            note=note,
            marks=marks,
            layer=layer,
        )
        commit = make_commit(meta, {}, row.layer)
        return NewCommit(
            id=commit.id,
            sha=commit.sha,
            size_bytes=len(commit.data),
            text=commit.text,
            captured_s=None,
            retracts=meta.retracted_ids,
            diff={},
            tops={},
            via=by or None,
            marks=marks,
            layer=layer,
        )

    return build
