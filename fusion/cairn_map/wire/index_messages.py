"""The cell index as JSON: what a map's cells are, without their bytes."""

from pydantic import BaseModel, ConfigDict

from cairn_map.wire.messages import FingerprintText, ReplyHeader, ShaText

INDEX_PAGE = 1000
"""Entries of a page of which the asker says nothing."""
INDEX_PAGE_MAX = 10_000


class CellEntry(BaseModel):
    """One row of the cell index."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    cell: tuple[int, int, int]
    size_bytes: int
    digest: ShaText
    lm: int
    """Log entry that last changed the cell."""
    fingerprint: FingerprintText
    voxels: int
    hottest_k: float | None = None
    """Mean temperature of its hottest voxel, kelvin; None: it has none, or the server does not know it, or was not
    asked for it: robots of old refuse what they do not know."""
    held_lm: int | None = None
    """Newest log entry whose evidence is still in the cell: `lm`, unless that took some out. None: nothing is in it,
    or the server does not know it any more, or was not asked for it."""


class CellIndex(BaseModel):
    """Answer to `GET /maps/{map}/main/cells`: a page of the index, taken from one state of the map."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    header: ReplyHeader
    cells: list[CellEntry]
