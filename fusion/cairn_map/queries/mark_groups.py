"""Groups of marks: many detections of one thing read as that thing, the same whatever order they came in.

    marks, by (time, key)   the first of a kind begins a group; a later one within the radius of a group's first mark
                            joins the nearest such group, or else begins one

A group is a reading: nothing is kept of it, and no mark is changed. Grouping in the order of arrival would give other
groups at each server and robot; so marks are sorted first. Distances are compared as whole millimetres squared.
"""

from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import product

from cairn_map.commits.mark import MILLIMETRES_MAX, Triple
from cairn_map.errors import BadInputError
from cairn_map.wire.mark_messages import MarkEntry

Box = tuple[int, int, int]


@dataclass(frozen=True, slots=True)
class MarkGroup:
    """Marks of one kind that lie close together, by time and key; one or more."""

    entries: tuple[MarkEntry, ...]

    @property
    def kind(self) -> str:
        """Kind of all of them."""
        return self.entries[0].mark.kind

    @property
    def name(self) -> str:
        """Name that the newest one has."""
        return self.entries[-1].mark.name

    @property
    def place_mm(self) -> Triple:
        """Mean of their middles, whole millimetres rounded down, map frame."""
        x, y, z = (sum(axis) // len(self.entries) for axis in zip(*self._places(), strict=True))
        return x, y, z

    @property
    def place_m(self) -> tuple[float, float, float]:
        """Mean of their middles, metres, map frame."""
        x, y, z = self.place_mm
        return x / 1000, y / 1000, z / 1000

    @property
    def authors(self) -> tuple[str, ...]:
        """Robots and people that made them, by name."""
        return tuple(sorted({entry.author for entry in self.entries}))

    @property
    def time_ms(self) -> tuple[int, int]:
        """Times of the first and the last one, milliseconds since 1970, UTC."""
        return self.entries[0].mark.time_ms, self.entries[-1].mark.time_ms

    def _places(self) -> Iterable[Triple]:
        return (entry.mark.place_mm for entry in self.entries)


def group_marks(entries: Iterable[MarkEntry], *, radius_m: float) -> list[MarkGroup]:
    """Marks as groups of one kind, each within a radius of its first mark, by the time and key of that.

    Args:
        entries: marks in any order, such as those of `Robot.marks`; one that comes twice counts once.
        radius_m: most distance of a mark's middle from that of its group's first mark, metres.

    Raises:
        BadInputError: kind `bad_option`: a radius that is no length.
    """
    if not 0 <= radius_m * 1000 <= MILLIMETRES_MAX:  # false of NaN, too
        raise BadInputError("bad_option", f"the radius of a group is 0 m or more, got {radius_m}")
    radius_mm = round(radius_m * 1000)
    keyed = {entry.mark_key: entry for entry in entries}
    ordered = sorted(keyed, key=lambda key: (keyed[key].mark.time_ms, key))
    groups: list[list[MarkEntry]] = []
    # Groups by kind and by the box, as wide as the radius, that their first mark is in: only neighbours can be near.
    near: defaultdict[tuple[str, Box], list[int]] = defaultdict(list)
    for entry in map(keyed.__getitem__, ordered):
        box = _box_of(entry, radius_mm)
        found = [
            (distance, number)
            for number in _neighbours(near, entry.mark.kind, box)
            if (distance := _distance_squared(groups[number][0], entry)) <= radius_mm * radius_mm
        ]
        if found:
            groups[min(found)[1]].append(entry)
        else:
            near[entry.mark.kind, box].append(len(groups))
            groups.append([entry])
    return [MarkGroup(tuple(group)) for group in groups]


def _neighbours(near: defaultdict[tuple[str, Box], list[int]], kind: str, box: Box) -> list[int]:
    x, y, z = box
    return [
        number
        for dx, dy, dz in product((-1, 0, 1), repeat=3)
        for number in near.get((kind, (x + dx, y + dy, z + dz)), ())
    ]


def _box_of(entry: MarkEntry, radius_mm: int) -> Box:
    x, y, z = (each // max(1, radius_mm) for each in entry.mark.place_mm)
    return x, y, z


def _distance_squared(one: MarkEntry, other: MarkEntry) -> int:
    return sum((a - b) ** 2 for a, b in zip(one.mark.place_mm, other.mark.place_mm, strict=True))
