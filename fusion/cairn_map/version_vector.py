"""Which commits somebody has: for each author a few intervals of numbers. O(authors) for ever.

    {"mole.1f2e3d4c5b6a7988": [[0, 41], [43, 50]]}      commits 0 to 41 and 43 to 50, both ends included

A version vector is a value; adding makes a new one.
"""

from bisect import bisect_right
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field

from cairn_map.errors import BadInputError
from cairn_map.ids import Author, CommitId, author_from_text

Intervals = tuple[tuple[int, int], ...]
AUTHORS_MAX = 65536
INTERVALS_MAX = 65536


@dataclass(frozen=True, slots=True)
class VersionVector:
    """A set of commit ids, as rising, disjoint, not touching intervals per author."""

    intervals: Mapping[Author, Intervals] = field(default_factory=dict)

    def __contains__(self, commit: CommitId) -> bool:
        spans = self.intervals.get(commit.author, ())
        at = bisect_right(spans, (commit.n, 1 << 62)) - 1
        return at >= 0 and spans[at][0] <= commit.n <= spans[at][1]

    def __iter__(self) -> Iterator[CommitId]:
        for author, spans in self.intervals.items():
            for first, last in spans:
                for n in range(first, last + 1):
                    yield CommitId(author, n)

    def __len__(self) -> int:
        return sum(last - first + 1 for spans in self.intervals.values() for first, last in spans)

    def with_commits(self, commits: Iterable[CommitId]) -> "VersionVector":
        """The set with some more in it."""
        added: dict[Author, list[tuple[int, int]]] = {}
        for commit in commits:
            added.setdefault(commit.author, []).append((commit.n, commit.n))
        merged = dict(self.intervals)
        for author, spans in added.items():
            merged[author] = _normal([*merged.get(author, ()), *spans])
        return VersionVector(merged)

    def minus(self, other: "VersionVector") -> "VersionVector":
        """What this set has and the other has not."""
        left: dict[Author, Intervals] = {}
        for author, spans in self.intervals.items():
            rest = _without(spans, other.intervals.get(author, ()))
            if rest:
                left[author] = rest
        return VersionVector(left)

    def tip(self, author: Author) -> int | None:
        """The highest number of one author, or None."""
        spans = self.intervals.get(author)
        return spans[-1][1] if spans else None

    def to_json(self) -> dict[str, list[list[int]]]:
        """As JSON, authors sorted; the mirror of `version_vector_from_json`."""
        return {str(author): [list(span) for span in self.intervals[author]] for author in sorted(self.intervals)}


EMPTY = VersionVector()


def version_vector_from_json(value: Mapping[str, Iterable[Iterable[int]]]) -> VersionVector:
    """The version vector in JSON.

    Raises:
        BadInputError: an id is malformed, intervals do not rise, or there are too many.
    """
    if len(value) > AUTHORS_MAX:
        raise BadInputError("bad_version_vector", f"a version vector names at most {AUTHORS_MAX} authors")
    found: dict[Author, Intervals] = {}
    for text, spans in value.items():
        intervals = tuple(tuple(span) for span in spans)
        if len(intervals) > INTERVALS_MAX or any(len(span) != 2 for span in intervals):
            raise BadInputError(
                "bad_version_vector", "an interval has two ends, and an author a bounded number of them"
            )
        pairs = tuple((int(span[0]), int(span[1])) for span in intervals)
        if _normal(list(pairs)) != pairs or any(first < 0 or first > last for first, last in pairs) or not pairs:
            raise BadInputError("bad_version_vector", f"intervals of {text[:80]} must rise and not touch")
        found[author_from_text(text)] = pairs
    return VersionVector(found)


def _normal(spans: list[tuple[int, int]]) -> Intervals:
    merged: list[tuple[int, int]] = []
    for first, last in sorted(spans):
        if merged and first <= merged[-1][1] + 1:
            merged[-1] = (merged[-1][0], max(last, merged[-1][1]))
        else:
            merged.append((first, last))
    return tuple(merged)


def _without(spans: Intervals, holes: Intervals) -> Intervals:
    rest: list[tuple[int, int]] = []
    for first, last in spans:
        at = first
        for hole_first, hole_last in holes:
            if hole_last < at or hole_first > last:
                continue
            if hole_first > at:
                rest.append((at, hole_first - 1))
            at = hole_last + 1
        if at <= last:
            rest.append((at, last))
    return tuple(rest)
