"""Requests of a robot to a server, as messages, and conversations made of them. No I/O.

A conversation is a generator that yields asks, is sent the answers, and returns its result; errors of the server or
the link are thrown into it. So the same rules run over HTTP (`http_link`), between the two ends of a relay, and in a
simulator that keeps time itself.

    def conversation() -> Conversation[int]:
        index = yield from GetIndex(author)
        return len(index.cells)
"""

from collections.abc import Callable, Generator
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np
import numpy.typing as npt

from cairn_client.sync.indexed_cells import IndexedCells, MapIndex, listed_page
from cairn_client.sync.responses import FetchedCell
from cairn_map.commits.commit import Commit
from cairn_map.commits.ids import Author, CommitId
from cairn_map.errors import BadInputError, CairnError, DamagedDataError, UnreachableError
from cairn_map.evidence.grid import Cell, CellKey, cell_of_key
from cairn_map.wire.frames import Frame
from cairn_map.wire.messages import INDEX_PAGE, CellIndex, MissingRequest, ReplyHeader, Upload

A = TypeVar("A")
T = TypeVar("T")

Box = tuple[Cell, Cell]
"""Lowest and highest cell, inclusive."""

INDEX_CELLS_MAX = 1 << 20
"""Cells of a map whose index is held: 109 MB, and five times the largest map that was measured."""


class Ask(Generic[A]):
    """A request that is answered by an A."""

    __slots__ = ()

    def __iter__(self) -> Generator["Ask[Any]", Any, A]:
        """Ask, and wait for the answer: `answer = yield from ask`."""
        answer: A = yield self
        return answer


Conversation = Generator[Ask[Any], Any, T]
"""A generator of asks that returns a T."""


def hold(conversation: Conversation[T], answer: Callable[[Ask[Any]], Any]) -> T:
    """Result of a conversation whose asks are answered by a function.

    Raises:
        CairnError: an error of `answer` that the conversation does not deal with itself.
    """
    try:
        ask = next(conversation)
        while True:
            try:
                found = answer(ask)
            except CairnError as exc:
                ask = conversation.throw(exc)
            else:
                ask = conversation.send(found)
    except StopIteration as end:
        result: T = end.value
        return result


@dataclass(frozen=True, slots=True)
class Push(Ask[None]):
    """Push of a commit; answered when the server has it for good."""

    commit: Commit
    seal: str | None = None
    """Seal of a retract that is the server's own; None for any other commit."""
    signatures: str | None = None
    """Signatures of those for whom the commit speaks, as in `Cairn-Signature`."""


@dataclass(frozen=True, slots=True)
class GetUpload(Ask[Upload]):
    """Question for how many of a commit's bytes (named by their SHA-256) came with earlier parts."""

    id: CommitId
    digest: str


@dataclass(frozen=True, slots=True)
class PutPart(Ask[Upload]):
    """Push of a part of a commit's bytes; with the last of them, the commit is pushed."""

    id: CommitId
    digest: str
    total_bytes: int
    offset_bytes: int
    data: bytes
    signatures: str | None = None
    """Signatures on the commit, as in `Cairn-Signature`."""


@dataclass(frozen=True, slots=True)
class GetCommit(Ask[tuple[bytes, str | None]]):
    """Question for a commit's bytes, and for the seal of a retract that is the server's."""

    id: CommitId


@dataclass(frozen=True, slots=True)
class GetMissing(Ask[Frame | None]):
    """Question for the first frame of what is missing; `NextFrame` asks for those after it."""

    request: MissingRequest


@dataclass(frozen=True, slots=True)
class NextFrame(Ask[Frame | None]):
    """Question for the next frame of the reply that is coming in; answered None after the last one."""


@dataclass(frozen=True, slots=True)
class GetIndex(Ask[CellIndex]):
    """Question for a page of the index of all cells, or of those in a box."""

    author: Author | None
    box: Box | None = None
    after: Cell | None = None
    """The last cell of the page before."""
    held: ReplyHeader | None = None
    """Header of an earlier state, whose vector need not come again."""


@dataclass(frozen=True, slots=True)
class GetView(Ask[bytes]):
    """Question for the view of one cell: its voxels, free ones, too, as they read now."""

    cell: Cell


@dataclass(frozen=True, slots=True)
class GetCell(Ask[FetchedCell]):
    """Question for one cell, unless it is the one with this ETag."""

    cell: Cell
    etag: str | None = None


@dataclass(frozen=True, slots=True)
class PutCell(Ask[None]):
    """Return of the bytes of a cell that the server had damaged."""

    cell: Cell
    body: bytes


def whole_index(
    author: Author | None = None, *, box: Box | None = None, held: ReplyHeader | None = None
) -> Conversation[MapIndex]:
    """Index of all cells, page by page, under the header of the first page.

    An entry whose `lm` is above the header's cursor changed between two pages.

    Raises:
        UnreachableError: kind `no_end`: the server was replaced or restored meanwhile; ask again.
        DamagedDataError: kind `bad_message`: the cells do not rise in number, so the pages might never end.
        BadInputError: kind `too_large`: more than `INDEX_CELLS_MAX` cells.
    """
    page = yield from GetIndex(author, box, held=held)
    header, start = page.header, page.header.to_cursor
    tables = [listed_page(page.cells)]
    count, last_key = len(page.cells), _last_key(tables[0], after=None)
    while len(page.cells) >= INDEX_PAGE and last_key is not None:
        page = yield from GetIndex(author, box, after=cell_of_key(last_key), held=held)
        to = page.header.to_cursor
        if to.log_id != start.log_id or to.seq < start.seq:
            raise UnreachableError("no_end", "the server's map was replaced while its cells were listed")
        tables.append(listed_page(page.cells))
        last_key = _last_key(tables[-1], after=last_key)
        count += len(page.cells)
        if count > INDEX_CELLS_MAX:
            raise BadInputError("too_large", f"the map has more than {INDEX_CELLS_MAX} cells here; ask for a box of it")
    return MapIndex(header, IndexedCells(np.concatenate(tables)))


def _last_key(page: npt.NDArray[np.void], *, after: CellKey | None) -> CellKey | None:
    """Number of a page's last cell; the numbers must rise, from `after` on."""
    keys = page["key"]
    if not len(keys):
        return after
    before = -1 if after is None else after
    if int(keys[0]) <= before or (keys[1:] <= keys[:-1]).any():
        raise DamagedDataError("bad_message", "the index names a cell twice, or its cells do not rise in number")
    return CellKey(int(keys[-1]))
