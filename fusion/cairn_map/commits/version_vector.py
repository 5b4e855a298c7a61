"""Version vectors: sets of commit ids, as a few intervals of numbers for each author. Their size is O(authors).

    {"mole.1f2e3d4c5b6a7988": [[0, 41], [43, 50]]}      commits 0 to 41 and 43 to 50, both ends included

A version vector is a value; adding makes a new one.
"""

import hashlib
import json
from bisect import bisect_right
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field

from cairn_map.commits.ids import NUMBER_LIMIT, Author, CommitId, author_from_text
from cairn_map.errors import BadInputError

Intervals = tuple[tuple[int, int], ...]
AUTHORS_MAX = 65536
INTERVALS_MAX = 65536
"""Intervals of all authors together, at most."""
COMMITS_MAX = 1 << 32
"""Commits that one vector names: ten in a second for thirteen years."""


@dataclass(frozen=True, slots=True)
class VersionVector:
    """A set of commit ids, as rising, disjoint, not touching intervals per author."""

    intervals: Mapping[Author, Intervals] = field(default_factory=dict)

    def __contains__(self, commit: CommitId) -> bool:
        spans = self.intervals.get(commit.author, ())
        at = bisect_right(spans, (commit.n, 1 << 62)) - 1
        return at >= 0 and spans[at][0] <= commit.n <= spans[at][1]

    def __iter__(self) -> Iterator[CommitId]:
        """Every id, one by one: for small differences; of a vector from outside ask `in` instead."""
        for author, spans in self.intervals.items():
            for first, last in spans:
                for n in range(first, last + 1):
                    yield CommitId(author, n)

    def __len__(self) -> int:
        return sum(last - first + 1 for spans in self.intervals.values() for first, last in spans)

    def with_commits(self, commits: Iterable[CommitId]) -> "VersionVector":
        """The set with further commits."""
        added: dict[Author, list[tuple[int, int]]] = {}
        for commit in commits:
            added.setdefault(commit.author, []).append((commit.n, commit.n))
        merged = dict(self.intervals)
        for author, spans in added.items():
            merged[author] = _normal([*merged.get(author, ()), *spans])
        return VersionVector(merged)

    def union(self, other: "VersionVector") -> "VersionVector":
        """Commits of this set or the other."""
        merged = dict(self.intervals)
        for author, spans in other.intervals.items():
            merged[author] = _normal([*merged.get(author, ()), *spans])
        return VersionVector(merged)

    def minus(self, other: "VersionVector") -> "VersionVector":
        """Commits of this set that the other does not hold."""
        left: dict[Author, Intervals] = {}
        for author, spans in self.intervals.items():
            rest = _without(spans, other.intervals.get(author, ()))
            if rest:
                left[author] = rest
        return VersionVector(left)

    def of_robots(self, robots: Collection[str]) -> "VersionVector":
        """Commits of these robots, in all their incarnations."""
        return VersionVector({author: spans for author, spans in self.intervals.items() if author.robot in robots})

    def tip(self, author: Author) -> int | None:
        """The highest number of one author, or None."""
        spans = self.intervals.get(author)
        return spans[-1][1] if spans else None

    def to_json(self) -> dict[str, list[list[int]]]:
        """As JSON, authors sorted; the mirror of `version_vector_from_json`."""
        return {str(author): [list(span) for span in self.intervals[author]] for author in sorted(self.intervals)}


EMPTY = VersionVector()


def vector_text(vector: VersionVector) -> str:
    """Canonical JSON text of a vector, over which its digest is taken: authors sorted, no spaces."""
    return json.dumps(vector.to_json(), separators=(",", ":"))


def vector_digest(vector: VersionVector) -> str:
    """Hex of the SHA-256 of a vector's text."""
    return hashlib.sha256(vector_text(vector).encode()).hexdigest()


def version_vector_from_json(value: Mapping[str, Iterable[Iterable[int]]]) -> VersionVector:
    """Version vector of its JSON form; the mirror of `VersionVector.to_json`.

    Raises:
        BadInputError: an id is malformed, intervals do not rise, or there are too many.
    """
    found: dict[Author, Intervals] = {}
    try:
        for text, spans in value.items():
            pairs = tuple((first, last) for first, last in spans)
            if not pairs or any(type(n) is not int or not 0 <= n < NUMBER_LIMIT for pair in pairs for n in pair):
                raise ValueError("an interval is two numbers of commits")
            if any(first > last for first, last in pairs) or _normal(list(pairs)) != pairs:
                raise ValueError("intervals must rise and not touch")
            found[author_from_text(text)] = pairs
    except (AttributeError, TypeError, ValueError) as exc:
        raise BadInputError("bad_version_vector", f"not a version vector: {exc}") from exc
    intervals = sum(len(spans) for spans in found.values())
    commits = sum(last - first + 1 for spans in found.values() for first, last in spans)
    if len(found) > AUTHORS_MAX or intervals > INTERVALS_MAX or commits > COMMITS_MAX:
        raise BadInputError(
            "bad_version_vector",
            f"a version vector has at most {AUTHORS_MAX} authors, {INTERVALS_MAX} intervals and {COMMITS_MAX} commits",
        )
    return VersionVector(found)


def _normal(spans: list[tuple[int, int]]) -> Intervals:
    # Sorted, overlapping and touching spans joined.
    merged: list[tuple[int, int]] = []
    for first, last in sorted(spans):
        if merged and first <= merged[-1][1] + 1:
            merged[-1] = (merged[-1][0], max(last, merged[-1][1]))
        else:
            merged.append((first, last))
    return tuple(merged)


def _without(spans: Intervals, holes: Intervals) -> Intervals:
    # Both lists rise. Invariant: holes before h end before the present span.
    rest: list[tuple[int, int]] = []
    h = 0
    for first, last in spans:
        at = first
        while h < len(holes) and holes[h][1] < at:
            h += 1
        n = h  # a hole may reach into the next span, so `h` itself stays
        while n < len(holes) and holes[n][0] <= last:
            if holes[n][0] > at:
                rest.append((at, holes[n][0] - 1))
            at = holes[n][1] + 1
            n += 1
        h = max(h, n - 1)
        if at <= last:
            rest.append((at, last))
    return tuple(rest)
