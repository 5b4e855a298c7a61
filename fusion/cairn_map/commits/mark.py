"""Marks: named places that robots and operators show each other, as signed records of their commits (FORMAT.md 17).

    key       commit id and number in the commit      equal records of two robots are two marks
    edit      a commit that takes the old one out      two edits of one mark on two servers are two marks
    removal   a commit that takes the old one out, without marks

So the marks of a map are a union of commits less what those take out: a set, the same in any order of arrival. All
numbers are integers, so that a record has one form.
"""

import math
import re
import unicodedata
from collections.abc import Iterable
from typing import Annotated, NamedTuple

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError

from cairn_map.commits.attachment import Attachment
from cairn_map.commits.ids import CommitId, commit_id_from_text
from cairn_map.errors import BadInputError, first_error
from cairn_map.evidence.grid import CELL_LIMIT, Geometry

MARKS_MAX = 4096
"""Marks of one commit."""
AMENDED_MAX = 64
"""Commits that a commit with marks takes out: it is an edit, or joins a few marks into one."""
MILLIMETRES_MAX = 1 << 38
"""Beyond the farthest corner of any map: 2^20 cells of 256 voxels of 1 m."""
TIME_MS_MAX = 10**14
"""The year 5138, as for all times."""
NAME_MAX, NOTE_MAX = 64, 1024
"""Code points."""
KIND = r"^[a-z][a-z0-9_]{0,31}$"
FORBIDDEN = re.compile(
    "[\u0000-\u0009\u000b-\u001f\u007f-\u009f\u061c\u200b\u200e\u200f\u2028-\u202e\u2066-\u2069\ufeff\ud800-\udfff]"
)
"""Characters that no text of a mark has: controls, those that turn the order of what is read, and two spaces of no
width. A note has lines; scripts and emoji need the joiners U+200C and U+200D."""
BLANK = re.compile("[\\s\u200c\u200d]+")
"""White space and joiners: a name has more than these."""
MARK_ID = re.compile(r"(?P<commit>[^:]{1,96})(?::(?P<number>0|[1-9][0-9]{0,3}))?")


def _check_note(text: str) -> str:
    found = FORBIDDEN.search(text)
    if found:
        raise ValueError(
            f"character U+{ord(found[0]):04X} at {found.start()} is a control, which no text of a mark has"
        )
    return text


def _check_line(text: str) -> str:
    if "\n" in text:
        raise ValueError("a name is one line; what needs several goes into the note")
    if BLANK.fullmatch(text):
        raise ValueError("a name has a character that is seen")
    return _check_note(text)


Line = Annotated[str, AfterValidator(_check_line)]
Millimetres = Annotated[int, Field(ge=-MILLIMETRES_MAX, le=MILLIMETRES_MAX)]
Length = Annotated[int, Field(ge=0, le=MILLIMETRES_MAX)]
Triple = tuple[Millimetres, Millimetres, Millimetres]


class Mark(BaseModel):
    """One mark as its author wrote it."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    kind: Annotated[str, Field(pattern=KIND)]
    """Sort of thing, such as `hot_spot`, `door` or `person`; programs choose symbols by it."""
    name: Annotated[Line, Field(min_length=1, max_length=NAME_MAX)]
    place_mm: Triple
    """Its middle, millimetres, map frame."""
    extent_mm: tuple[Length, Length, Length] = (0, 0, 0)
    """Edges of a box around its middle, millimetres; zeros: a point."""
    note: Annotated[str, AfterValidator(_check_note), Field(max_length=NOTE_MAX)] = ""
    time_ms: Annotated[int, Field(ge=-TIME_MS_MAX, le=TIME_MS_MAX)]
    """Time at which it was made or changed, milliseconds since 1970, UTC."""
    by: Annotated[Line, Field(max_length=NAME_MAX)] = ""
    """Person or robot that speaks in a commit of `operator`; empty in a robot's own."""
    attachment: Attachment | None = None
    """Bytes that belong to it, such as a picture; they travel apart from the commit."""

    @property
    def low_mm(self) -> tuple[int, int, int]:
        """Lowest corner of its box, rounded down."""
        x, y, z = (p - (e + 1) // 2 for p, e in zip(self.place_mm, self.extent_mm, strict=True))
        return x, y, z

    @property
    def high_mm(self) -> tuple[int, int, int]:
        """Highest corner of its box, rounded up."""
        x, y, z = (p + (e + 1) // 2 for p, e in zip(self.place_mm, self.extent_mm, strict=True))
        return x, y, z

    @property
    def place_m(self) -> tuple[float, float, float]:
        """Its middle, metres, map frame."""
        x, y, z = self.place_mm
        return x / 1000, y / 1000, z / 1000

    def to_json(self) -> str:
        """The record without what equals its default."""
        return self.model_dump_json(exclude_defaults=True)


class MarkKey(NamedTuple):
    """Name of a mark for ever: the commit that brought it, and its number there."""

    commit: CommitId
    number: int

    def __str__(self) -> str:
        return f"{self.commit}:{self.number}"


def mark_key_from_text(text: str) -> MarkKey:
    """Key of a text `robot.incarnation.n:number`; without a number the commit's first mark.

    Raises:
        BadInputError: kind `bad_id`.
    """
    found = MARK_ID.fullmatch(text)
    try:
        if found:
            return MarkKey(commit_id_from_text(found["commit"]), int(found["number"] or 0))
    except BadInputError:
        pass  # said below, of the whole text
    raise BadInputError("bad_id", f"a mark is written robot.incarnation.n:number, got {text[:110]!r}")


def make_mark(
    *,
    kind: str,
    name: str,
    at_m: Iterable[float],
    time_s: float,
    extent_m: Iterable[float] = (0.0, 0.0, 0.0),
    note: str = "",
    by: str = "",
    attachment: Attachment | None = None,
) -> Mark:
    """Mark of texts as people write them and lengths in metres, rounded to millimetres.

    Raises:
        BadInputError: kind `bad_place`: a place or an extent that no map has; `bad_mark`: a text, kind or time that
            cannot be. The message says which, and what would be right.
    """
    place, extent = _millimetres("place", at_m), _millimetres("extent", extent_m)
    if min(extent) < 0:
        raise BadInputError("bad_place", f"an extent is three edges of 0 m or more, got {extent} mm")
    try:
        return Mark(
            kind=kind,
            name=unicodedata.normalize("NFC", name),
            place_mm=place,
            extent_mm=extent,
            note=unicodedata.normalize("NFC", note.replace("\r\n", "\n")),
            time_ms=round(time_s * 1000),
            by=unicodedata.normalize("NFC", by),
            attachment=attachment,
        )
    except (ValidationError, ValueError, OverflowError) as exc:
        said = first_error(exc) if isinstance(exc, ValidationError) else f"the time is {time_s} s"
        raise BadInputError("bad_mark", f"a mark cannot say this: {said}") from exc


def check_place(mark: Mark, geometry: Geometry) -> None:
    """Refuse a mark outside of all that a map of this geometry can hold.

    Raises:
        BadInputError: kind `bad_place`.
    """
    limit_mm = CELL_LIMIT * geometry.side * geometry.voxel_edge_um // 1000
    if any(not -limit_mm <= each < limit_mm for each in mark.place_mm):
        raise BadInputError(
            "bad_place",
            f"the mark {mark.name!r} is at {mark.place_m} m; this map ends {limit_mm / 1000:g} m from its origin",
        )


def _millimetres(what: str, lengths_m: Iterable[float]) -> tuple[int, int, int]:
    values = [float(each) for each in lengths_m]
    if len(values) != 3 or not all(map(math.isfinite, values)):
        raise BadInputError("bad_place", f"a mark's {what} is three finite numbers in metres, got {values}")
    if max(map(abs, values)) * 1000 > MILLIMETRES_MAX:
        raise BadInputError("bad_place", f"a mark's {what} is within {MILLIMETRES_MAX / 1000:g} m, got {values}")
    x, y, z = (round(each * 1000) for each in values)
    return x, y, z
