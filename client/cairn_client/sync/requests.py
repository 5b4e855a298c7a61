"""What a robot may ask of a server: messages, and no I/O.

A conversation is a generator that yields asks, is sent the answers, and returns its result; errors of the server or
the link are thrown into it. So the same rules run over HTTP (`link`) and in a simulator that keeps time itself.

    def conversation() -> Conversation[int]:
        index = yield from GetIndex(author)
        return len(index.cells)
"""

from collections.abc import Generator
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from cairn_client.sync.responses import FetchedCell
from cairn_map.commits.commit import Commit
from cairn_map.commits.ids import Author, CommitId
from cairn_map.evidence.grid import Cell
from cairn_map.wire.frames import Frame
from cairn_map.wire.messages import CellIndex, MissingRequest, Upload

A = TypeVar("A")
T = TypeVar("T")

Box = tuple[Cell, Cell]
"""Lowest and highest cell, inclusive."""


class Ask(Generic[A]):
    """A request that is answered by an A."""

    __slots__ = ()

    def __iter__(self) -> Generator["Ask[Any]", Any, A]:
        """Ask, and wait for the answer: `answer = yield from ask`."""
        answer: A = yield self
        return answer


Conversation = Generator[Ask[Any], Any, T]
"""Asks until it has a T."""


@dataclass(frozen=True, slots=True)
class Push(Ask[None]):
    """Take this commit; answered when the server has it for good."""

    commit: Commit
    seal: str | None = None
    """On a retract that is the server's own."""
    signatures: str | None = None
    """Of those for whom it speaks, as in `Cairn-Signature`."""


@dataclass(frozen=True, slots=True)
class GetUpload(Ask[Upload]):
    """How much of a commit's bytes (their SHA-256) came with earlier parts."""

    id: CommitId
    digest: str


@dataclass(frozen=True, slots=True)
class PutPart(Ask[Upload]):
    """Take these bytes of a commit; with the last of them, take the commit."""

    id: CommitId
    digest: str
    total_bytes: int
    offset_bytes: int
    data: bytes
    signatures: str | None = None
    """On the commit, as in `Cairn-Signature`."""


@dataclass(frozen=True, slots=True)
class GetCommit(Ask[tuple[bytes, str | None]]):
    """A commit's bytes, and the seal on a retract that is the server's."""

    id: CommitId


@dataclass(frozen=True, slots=True)
class GetMissing(Ask[Frame | None]):
    """The first frame of what is missing; `NextFrame` asks for those after it."""

    request: MissingRequest


@dataclass(frozen=True, slots=True)
class NextFrame(Ask[Frame | None]):
    """The next frame of the reply that is coming in; None after the last one."""


@dataclass(frozen=True, slots=True)
class GetIndex(Ask[CellIndex]):
    """A page of all cells, or of those in a box, without their bytes."""

    author: Author | None
    box: Box | None = None
    after: Cell | None = None
    """The last cell of the page before."""


@dataclass(frozen=True, slots=True)
class GetCell(Ask[FetchedCell]):
    """One cell, unless it is the one with this ETag."""

    cell: Cell
    etag: str | None = None


@dataclass(frozen=True, slots=True)
class PutCell(Ask[None]):
    """Take the bytes of a cell that the server had damaged."""

    cell: Cell
    body: bytes
