"""Live events of a server for its listeners, over SSE and WebSocket alike: JSON objects with a `type`.

    hello   the present state; the first event of every connection
    cells   changed cells             } the changes of one or more folds, in this order;
    marks   marks that came and went  } each but `head` may be missing or come twice
    log     new log entries           }
    head    the newest cursor         } after a cut, `head` ends them
    robot   news of one robot
    beat    the link is alive

An event's id is the position of a listener that has received it: `SEQ.CHAIN.TICK`, seq and the first 8 hex digits of
its chain as in a cursor, and a number that rises with each piece of news of a robot. Ids never fall.
"""

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, FailFast, Field, TypeAdapter

from cairn_map.wire.mark_messages import MarkEntry
from cairn_map.wire.messages import Count, CursorText, IdText, LogEntry, MapNameText, NameText, RobotStatus

CELLS_MAX = 256
"""Cells in one event, at most; more are `many`."""
NAMES_MAX = 16_384
"""Most commits that the log entries of one event, or of one page of the log, name together, unless it is one entry."""
ENTRIES_MAX = 100
"""Log entries in one event, at most: the newest."""
MARKS_MAX = 64
"""Marks in one event, at most; more are `many`."""
CHAIN_DIGITS = 8
EventId = Annotated[str, Field(pattern=r"^[!-~]{0,64}$")]
"""A text that a header may hold: the listener shows it again when it comes back."""


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class RobotSign(_Model):
    """Latest news of one robot."""

    branch: NameText
    mode: str
    time_s: float
    """Time of the news, by the server's clock."""
    cursor: CursorText | None = None
    """Cursor of its last fetch."""
    status: RobotStatus | None = None
    view_s: float | None = None
    """Time at which its latest picture arrived, by the server's clock; None: there is none."""
    gone: bool = False
    """True if it was deregistered."""


class Hello(_Model):
    """The present state. A listener that was not resumed requests `missing` for the changes that it lacks."""

    type: Literal["hello"] = "hello"
    id: EventId
    map: MapNameText
    cursor: CursorText
    resumed: bool
    """True if the listener's id is of this log: all changes folded since then follow."""
    robots: Annotated[list[RobotSign], FailFast()]
    beat_s: float
    """Longest time between two events, seconds; after twice as long without one, connect again."""


class CellsEvent(_Model):
    """Cells that changed, each with the log entry that last changed it."""

    type: Literal["cells"] = "cells"
    id: EventId
    cells: Annotated[list[tuple[int, int, int, int]], Field(max_length=CELLS_MAX)] | Literal["many"]
    """i, j, k, lm."""


class MarksEvent(_Model):
    """Marks that came, and commits whose marks went."""

    type: Literal["marks"] = "marks"
    id: EventId
    marks: Annotated[list[MarkEntry], Field(max_length=MARKS_MAX)] | Literal["many"]
    """Those that came, oldest first; many: `GET .../main/marks` has them, and those that went."""
    removed: Annotated[list[IdText], Field(max_length=MARKS_MAX), FailFast()] = []
    """Commits whose marks were taken out."""


class LogGrew(_Model):
    """New log entries, oldest first."""

    type: Literal["log"] = "log"
    id: EventId
    entries: Annotated[list[LogEntry], Field(max_length=ENTRIES_MAX), FailFast()]
    left_out: Count
    """Number of older new entries that are not listed; `GET .../log` has them."""


class HeadMoved(_Model):
    """The newest folded state."""

    type: Literal["head"] = "head"
    id: EventId
    cursor: CursorText


class RobotHeard(_Model):
    """News of a robot: it pushed, fetched, reported its status, registered or deregistered."""

    type: Literal["robot"] = "robot"
    id: EventId
    robot: RobotSign


class Beat(_Model):
    """Sign of life of the link, while there is nothing else to send."""

    type: Literal["beat"] = "beat"
    id: EventId
    time_s: float


LiveEvent = Hello | CellsEvent | MarksEvent | LogGrew | HeadMoved | RobotHeard | Beat
LIVE_EVENT: TypeAdapter[LiveEvent] = TypeAdapter(Annotated[LiveEvent, Field(discriminator="type")])


@dataclass(frozen=True, slots=True)
class EventPosition:
    """Position of a listener in the stream of events: the parts of an event's id."""

    seq: int
    chain: str
    tick: int

    def __str__(self) -> str:
        return f"{self.seq}.{self.chain}.{self.tick}"


def position_from_text(text: str) -> EventPosition | None:
    """Position of an event's id; None if the text is no id."""
    parts = text.split(".")
    if len(text) > 64 or len(parts) != 3 or not all(part.isascii() and part.isalnum() for part in parts):
        return None
    if not (parts[0].isdigit() and parts[2].isdigit()) or len(parts[1]) != CHAIN_DIGITS:
        return None
    return EventPosition(int(parts[0]), parts[1], int(parts[2]))
