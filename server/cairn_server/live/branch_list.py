"""All robots of a map, and how far behind the head each is: in log entries, and in bytes of others' commits.

The log is read once for all branches, and no further back than a bound: a branch that is older than that is told as
behind by so many entries and an unknown number of bytes; it would fetch whole cells anyway.
"""

from bisect import bisect_right
from collections import defaultdict
from itertools import accumulate

from cairn_map.commits.cursor import Cursor
from cairn_map.wire.messages import BranchInfo
from cairn_server.live.live_map import LiveRobots
from cairn_server.store.store import Store
from cairn_server.store.store_rows import Branch, EntrySize, MapRow

LAG_ENTRIES_MAX = 10_000


def branch_infos(store: Store, row: MapRow, robots: LiveRobots) -> list[BranchInfo]:
    """All branches, by name, with the last that was heard of each."""
    with store.snapshot(row) as snapshot:
        head = snapshot.head.cursor
    branches = store.branches(row)
    starts = [cursor.seq for branch in branches if (cursor := _of_log(branch.cursor, head)) and cursor.seq < head.seq]
    after = max(min(starts, default=head.seq), head.seq - LAG_ENTRIES_MAX)
    lags = _Lags(store.notes.entry_sizes(row, after_seq=after, limit=LAG_ENTRIES_MAX) if starts else [], after)
    found = []
    for branch in branches:
        sign, cursor = robots.of(branch.name), _of_log(branch.cursor, head)
        found.append(
            BranchInfo(
                branch=branch.name,
                mode=branch.mode,
                sensors=list(branch.sensors),
                cursor=str(branch.cursor) if branch.cursor else None,
                behind=max(0, head.seq - cursor.seq) if cursor else None,
                behind_bytes=lags.of(branch, cursor) if cursor else None,
                incarnation=branch.incarnation,
                last_seen_s=max(branch.last_seen_s, sign.time_s if sign else 0.0),
                status=sign.status if sign else None,
                view_s=sign.view_s if sign else None,
            )
        )
    return found


class _Lags:
    """Bytes of the entries after any place, from running sums of all and of each author."""

    def __init__(self, entries: list[EntrySize], after: int) -> None:
        self._after = after
        self._all = _Sums(entries)
        by_author: defaultdict[tuple[str, str], list[EntrySize]] = defaultdict(list)
        for entry in entries:
            if entry.author is not None:
                by_author[entry.author].append(entry)
        self._own = {author: _Sums(own) for author, own in by_author.items()}

    def of(self, branch: Branch, cursor: Cursor) -> int | None:
        """Bytes of what others did after a branch's cursor; None if that is too long ago."""
        if cursor.seq < self._after:
            return None
        own = self._own.get((branch.name, branch.incarnation))
        return self._all.after(cursor.seq) - (own.after(cursor.seq) if own else 0)


class _Sums:
    def __init__(self, entries: list[EntrySize]) -> None:
        self._seqs = [entry.seq for entry in entries]
        self._sums = [0, *accumulate(entry.size_bytes for entry in entries)]

    def after(self, seq: int) -> int:
        return self._sums[-1] - self._sums[bisect_right(self._seqs, seq)]


def _of_log(cursor: Cursor | None, head: Cursor) -> Cursor | None:
    return cursor if cursor is not None and cursor.log_id == head.log_id else None
