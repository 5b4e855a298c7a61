"""Clock of a store: the time of day by which epochs are judged, and what servers keep of their trust in it.

SQLite's is the machine's. Servers that share a database read the database's, since their own may differ by minutes;
each compares it with a steady clock of its own.
"""

import json
from dataclasses import asdict, dataclass
from typing import Protocol

from cairn_map.errors import DamagedDataError


@dataclass(frozen=True, slots=True)
class ClockMark:
    """State of a store's clock as servers keep it."""

    trusted_s: float = 0.0
    """Newest time of day that was trusted; 0 in a store that never kept one."""
    since_age_s: float | None = None
    """Age of the store from which on its clock has not been trusted; None: it is."""
    has_jumped: bool = False
    """True if it is not trusted because it jumped: no later time of day alone ends that."""
    ends: int = 0
    """Count of the times that the clock was trusted again: by itself, or by an operator's word."""
    excused_s: float = 0.0
    """Times up to here say nothing against the clock: they were known when an operator trusted an earlier one."""
    boot: str = ""
    """Boot of the machine under which `offset_s` means something; empty: under none."""
    offset_s: float = 0.0
    """Lead of the trusted time of day over the machine's steady clock."""

    def to_text(self) -> str:
        """Text that a store keeps; the mirror of `clock_mark_from_text`."""
        return json.dumps(asdict(self))


def clock_mark_from_text(text: str | None) -> ClockMark:
    """Mark of a text that a store kept; None: it has kept none yet.

    Raises:
        DamagedDataError: kind `damaged_store`.
    """
    if text is None:
        return ClockMark()
    try:
        return ClockMark(**json.loads(text))
    except (ValueError, TypeError) as exc:
        raise DamagedDataError("damaged_store", "what the store keeps of its clock cannot be read") from exc


class StoreClock(Protocol):
    """Clock of one store; every method may be called from any thread."""

    @property
    def boot(self) -> str:
        """Boot of the machine of both clocks; empty where they are of two machines."""
        ...

    def steady_s(self) -> float:
        """The machine's steady clock, seconds, which counts while the machine sleeps."""
        ...

    def wall_s(self) -> float:
        """Time of day, UTC seconds since 1970.

        Raises:
            UnreachableError: the database does not answer now.
        """
        ...

    def kept(self) -> ClockMark:
        """State that was kept last, by any server.

        Raises:
            UnreachableError: the database does not answer now.
        """
        ...

    def keep(self, mark: ClockMark, *, before: ClockMark) -> None:
        """Keep a state in the place of the one before, unless another server kept one since; may be written later."""
        ...
