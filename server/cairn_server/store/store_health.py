"""What an administrator needs to know of a store, beside what is in it (`Store.health`)."""

from dataclasses import dataclass
from typing import Protocol

from cairn_server.store.store_rows import CellRow, MapRow


@dataclass(frozen=True, slots=True)
class Backlog:
    """Commits of one map that are durable but not folded."""

    map: str
    commits: int
    oldest_s: float | None
    """When the oldest of them came, as a time; None without any."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StoreFigures:
    """Sizes now, and counts since the start."""

    size_bytes: int
    """Of everything at rest, without what is written ahead."""
    ahead_bytes: int
    """Written ahead, to be moved to its place."""
    free_bytes: int
    """On the disk."""
    queued: int
    """Jobs that wait to be written."""
    written: int
    """Transactions."""
    emptied: int
    """Times that the write-ahead log was emptied."""
    failures: dict[str, int]
    """Transactions that were not written, by kind of error."""


class StoreHealth(Protocol):
    """How a store does."""

    def backlogs(self) -> list[Backlog]:
        """What is not folded yet, of every map."""
        ...

    def figures(self) -> StoreFigures:
        """Sizes and counts."""
        ...

    def check_space(self, free_bytes_min: int) -> None:
        """Refuse to take more while less than this is free: folding what was taken needs room, too.

        Raises:
            UnreachableError: kind `disk_full`.
        """
        ...

    def heal(self, row: MapRow, cell: CellRow) -> bool:
        """Put sound bytes in the place of a damaged cell; False if it changed meanwhile. Durable on return."""
        ...

    def probe(self) -> None:
        """Write something that changes nothing, as durably as a commit.

        Raises:
            UnreachableError: it could not be written: `disk_full`, `store_failed`, `shutting_down`, `busy`.
        """
        ...
