"""What a server tells those who listen, over SSE and WebSocket alike: JSON objects, told apart by `type`.

    hello   the present state; the first event of every connection
    cells   these changed             } what one or more folds changed, in this order;
    log     these entries came        } `cells` and `log` may be missing or come twice
    head    the newest cursor         } after a cut, `head` ends them
    robot   one was heard of
    beat    the link is alive

An event's id says what the listener has seen once it has it: `SEQ.CHAIN.TICK`, seq and the first 8 hex digits of its
chain as in a cursor, and a number that rises with what is heard of robots. Ids never fall.
"""

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter

from cairn_map.wire.messages import CursorText, LogEntry, NameText, RobotStatus

CELLS_MAX = 256
"""Cells in one event; more are `many`."""
ENTRIES_MAX = 100
"""Log entries in one event, the newest."""
CHAIN_DIGITS = 8
EventId = Annotated[str, Field(max_length=64)]


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class RobotSign(_Model):
    """The last that was heard of one robot."""

    branch: NameText
    mode: str
    time_s: float
    """When, by the server's clock."""
    cursor: CursorText | None = None
    """Where it stood when it last fetched."""
    status: RobotStatus | None = None
    view_s: float | None = None
    """When its latest picture came; None: there is none."""
    gone: bool = False
    """It was deregistered."""


class Hello(_Model):
    """The present state. Who was not resumed asks `missing` for what it lacks."""

    type: Literal["hello"] = "hello"
    id: EventId
    map: NameText
    cursor: CursorText
    resumed: bool
    """The id that the listener gave is of this log: what was folded since follows, or nothing was."""
    robots: list[RobotSign]
    beat_s: float
    """Some event comes at least this often; after twice as long without one, connect again."""


class CellsChanged(_Model):
    """Cells that were changed, each with the log entry that last did."""

    type: Literal["cells"] = "cells"
    id: EventId
    cells: list[tuple[int, int, int, int]] | Literal["many"]
    """i, j, k, lm."""


class LogGrew(_Model):
    """New log entries, oldest first."""

    type: Literal["log"] = "log"
    id: EventId
    entries: Annotated[list[LogEntry], Field(max_length=ENTRIES_MAX)]
    left_out: int
    """Older new entries that are not listed; `GET .../log` has them."""


class HeadMoved(_Model):
    """The newest folded state."""

    type: Literal["head"] = "head"
    id: EventId
    cursor: CursorText


class RobotHeard(_Model):
    """A robot pushed, fetched, told its status, or came or went."""

    type: Literal["robot"] = "robot"
    id: EventId
    robot: RobotSign


class Beat(_Model):
    """Nothing happened for a while."""

    type: Literal["beat"] = "beat"
    id: EventId
    time_s: float


LiveEvent = Hello | CellsChanged | LogGrew | HeadMoved | RobotHeard | Beat
LIVE_EVENT: TypeAdapter[LiveEvent] = TypeAdapter(Annotated[LiveEvent, Field(discriminator="type")])


@dataclass(frozen=True, slots=True)
class EventPosition:
    """How far a listener is: the parts of an event's id."""

    seq: int
    chain: str
    tick: int

    def __str__(self) -> str:
        return f"{self.seq}.{self.chain}.{self.tick}"


def position_from_text(text: str) -> EventPosition | None:
    """An event's id, parsed; None for anything else."""
    parts = text.split(".")
    if len(text) > 64 or len(parts) != 3 or not all(part.isascii() and part.isalnum() for part in parts):
        return None
    if not (parts[0].isdigit() and parts[2].isdigit()) or len(parts[1]) != CHAIN_DIGITS:
        return None
    return EventPosition(int(parts[0]), parts[1], int(parts[2]))
