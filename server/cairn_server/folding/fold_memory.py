"""Memory for folding: what each of its parts may take, and where encoded cells wait that do not fit."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Self

from cairn_server.cell_room import SPOOLS_BYTES, CellRoom
from cairn_server.memory_shares import FOLDING_MIN_BYTES, SPOOL_BYTES, MemoryShares
from cairn_server.store.row_spool import RowSpool
from cairn_server.store.store_rows import CellRow

CACHE_BYTES = 512 << 20
"""Standard memory for the cells under change of all maps."""
ROOM_WAIT_S = 600.0
"""Longest wait for the cell that the other lane works on: a second, if the machine is not very busy."""


def folding_room(limit_bytes: int = FOLDING_MIN_BYTES) -> CellRoom:
    """Room for the cells that are changed at the same time."""
    return CellRoom(limit_bytes, wait_s=ROOM_WAIT_S)


@dataclass(frozen=True, slots=True, eq=False)
class FoldMemory:
    """Memory that the lanes of one process share."""

    cells_bytes: int = CACHE_BYTES
    """For the cells under change of all maps, between two steps of a fold."""
    room: CellRoom = field(default_factory=folding_room)
    """For the cell that is just being decoded, changed or encoded."""
    spool_bytes: int = SPOOL_BYTES
    """For the encoded cells of one fold."""
    folder: Path | None = None
    """Folder for encoded cells that do not fit in memory; None: the system's one for temporary files."""

    def spool(self, rows: Iterable[CellRow] = ()) -> RowSpool:
        """Place for the encoded cells of a fold, with these in it."""
        spool = RowSpool(self.folder, memory_bytes=self.spool_bytes)
        for row in rows:
            spool.put(row)
        return spool

    @classmethod
    def of_server(cls, shares: MemoryShares, folder: Path, *, is_all: bool = False) -> Self:
        """Memory for folding in a server's processes; the store is in this folder.

        In a server that does nothing else (`is_all`) cells under change have that of checks, bodies and caches, too.
        """
        room = folding_room(shares.folding_bytes - SPOOLS_BYTES)
        unused_bytes = shares.check_workers * shares.check_bytes + shares.bodies_bytes + shares.caches_bytes
        return cls(unused_bytes if is_all else int(shares.cache_share * CACHE_BYTES), room, folder=folder)
