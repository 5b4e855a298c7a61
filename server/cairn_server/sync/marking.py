"""Marks of maps: pages of them for any reader, and what operators add, change and remove.

Robots push commits with marks of their own (FORMAT.md 17). An operator's are commits of the author `operator`, which
robots keep and push back like retracts (SYNC.md rule 11), so that a restored server has them again.
"""

import time
from collections.abc import Callable

import numpy as np

from cairn_map.commits.commit import CommitMeta
from cairn_map.commits.cursor import Cursor, cursor_from_text
from cairn_map.commits.ids import CommitId
from cairn_map.commits.mark import MILLIMETRES_MAX, Mark, MarkKey, check_place, make_mark, mark_key_from_text
from cairn_map.errors import NotFoundError
from cairn_map.files.export_request import ExportRequest
from cairn_map.wire.mark_messages import MarkPage, MarkReceipt, MarkRequest, MarkText
from cairn_server.access.auth import Caller
from cairn_server.map_refusals import layer_of_map
from cairn_server.store.history import is_proven
from cairn_server.store.store import Snapshot, Store
from cairn_server.store.store_rows import MapRow, MarkBox, entries_of, removed_commits
from cairn_server.sync.operator_commits import OperatorCommits

FAR_M = 2 * MILLIMETRES_MAX / 1000
"""Beyond any mark's box, metres."""


class Marking:
    """Marks on all maps of a store; called from many threads."""

    def __init__(self, store: Store, commits: OperatorCommits, *, on_new: Callable[[], None]) -> None:
        """`on_new` is called after each commit."""
        self._store = store
        self._commits = commits
        self._on_new = on_new

    def page(self, row: MapRow, *, after: str | None, limit: int, box: str | None) -> MarkPage:
        """Marks that came, and commits whose marks went, after a state of the map; of a box if one is given.

        Args:
            row: the map.
            after: cursor of the page before; None, or one that is not of this log: from the start.
            limit: marks in a page; it ends with a whole commit.
            box: x0,y0,z0,x1,y1,z1, metres.

        Raises:
            BadInputError: kind `bad_box` or `bad_cursor`.
        """
        asked = None if box is None else _millimetres(box)
        stated = None if after is None else cursor_from_text(after)
        with self._store.snapshot(row) as snapshot:
            head = snapshot.head
            is_known = stated is not None and stated.log_id == head.log_id and is_proven(stated, snapshot)
            found = snapshot.marks(
                after_seq=stated.seq if stated is not None and is_known else None, limit=limit, box=asked
            )
            more = len(found) >= limit
            cursor = _cursor_at(found[-1].seq, snapshot) if more else head
        # From the start there is none to remove.
        removed = list(map(str, removed_commits(found)))
        return MarkPage(
            cursor=str(cursor), from_start=not is_known, more=more, marks=entries_of(found), removed=removed
        )

    def put(self, row: MapRow, request: MarkRequest, *, by: Caller) -> MarkReceipt:
        """Add, change or remove a mark, as an operator says; durable on return.

        Raises:
            BadInputError: kind `bad_mark`, `bad_place`, `bad_id`, `layer_of_map` or `too_many_marks`.
            NotFoundError: kind `no_mark`: there is none of this key, or it was taken out.
        """
        if row.of_map is not None:
            raise layer_of_map(row.name, "marks are the map's; mark there")
        new = None if request.mark is None else _mark_of(request.mark, row, by=by.name)
        marks: tuple[Mark, ...] = (new,) if new else ()
        targets: tuple[CommitId, ...] = ()
        place = 0
        if request.of is not None:
            key = mark_key_from_text(request.of)
            # An edit takes the whole commit out, so that the marks next to this one come again, under their author.
            kept = self._living(row, key)
            others = [mark.model_copy(update={"by": mark.by or key.commit.author.robot}) for mark in kept]
            others[key.number : key.number + 1] = [new] if new else []
            marks, targets, place = tuple(others), (key.commit,), key.number
        commit = self._commits.append(row, by=by.name, retracts=targets, marks=marks)
        receipt = MarkReceipt(commit=str(commit), key=str(MarkKey(commit, place)) if new else None)
        what = f"{receipt.key or 'nothing'} in the place of {request.of}" if request.of else f"{receipt.key}"
        self._store.audit_log.add(by.name, "mark", f"map {row.name}: {what}", client=by.address)
        self._on_new()
        return receipt

    def _living(self, row: MapRow, key: MarkKey) -> tuple[Mark, ...]:
        """Marks of the commit of a mark that is there.

        Raises:
            NotFoundError: kind `no_mark`.
        """
        found = self._store.commit(row, key.commit)
        marks = CommitMeta.model_validate_json(found.text, strict=True).marks if found and not found.gone else ()
        if key.number >= len(marks):
            raise NotFoundError("no_mark", f"map {row.name} has no mark {key}; `cairn map marks` lists them")
        if self._store.is_retracted(row, key.commit):
            raise NotFoundError(
                "no_mark", f"mark {key} was changed or removed by another; `cairn map marks` lists what stands for it"
            )
        return marks


def _cursor_at(seq: int, snapshot: Snapshot) -> Cursor:
    chain = snapshot.chain_at(seq)
    assert chain is not None, "an entry of this snapshot"  # noqa: S101 - by its caller
    return Cursor(snapshot.head.log_id, seq, chain)


def _millimetres(box: str) -> MarkBox:
    """Box of a query, its corners rounded outwards."""
    low_m, high_m = (np.clip(corner, -FAR_M, FAR_M) for corner in ExportRequest(box=box).bounds_m())
    (x0, y0, z0), (x1, y1, z1) = np.floor(low_m * 1000).astype(int), np.ceil(high_m * 1000).astype(int)
    return (int(x0), int(y0), int(z0)), (int(x1), int(y1), int(z1))


def _mark_of(text: MarkText, row: MapRow, *, by: str) -> Mark:
    mark = make_mark(
        kind=text.kind,
        name=text.name,
        at_m=text.place_m,
        extent_m=text.extent_m,
        note=text.note,
        time_s=time.time(),
        by=by,
        attachment=text.attachment,
    )
    check_place(mark, row.geometry)
    return mark
