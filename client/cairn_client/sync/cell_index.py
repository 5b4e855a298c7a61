"""The whole cell index, page by page."""

from cairn_client.sync.requests import Box, Conversation, GetIndex
from cairn_map.commits.ids import Author
from cairn_map.errors import UnreachableError
from cairn_map.evidence.grid import Cell
from cairn_map.wire.messages import INDEX_PAGE, CellIndex


def whole_index(author: Author | None = None, *, box: Box | None = None) -> Conversation[CellIndex]:
    """All entries under the header of the first page: one whose `lm` is above its cursor changed while we asked.

    Raises:
        UnreachableError: kind `no_end`: the server was replaced or restored meanwhile; ask again.
    """
    index = page = yield from GetIndex(author, box)
    cells, start = list(page.cells), index.header.to_cursor
    while len(page.cells) >= INDEX_PAGE:
        page = yield from GetIndex(author, box, after=Cell(*page.cells[-1].cell))
        cells += page.cells
        to = page.header.to_cursor
        if to.log_id != start.log_id or to.seq < start.seq:
            raise UnreachableError("no_end", "the server's map was replaced while its cells were listed")
    return index.model_copy(update={"cells": cells})
