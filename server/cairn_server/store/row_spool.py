"""Encoded cells on their way to the store: in memory up to a bound, beyond it in a file in the folder of the store.

A fold writes all of its cells at once, and how large those are is not its commits' doing: a commit of 4096 voxels may
touch 4096 cells of a megabyte each.
"""

import os
import pickle
import tempfile
import weakref
from collections.abc import Iterator
from pathlib import Path

from cairn_map.evidence.grid import CellKey
from cairn_server.store.store_rows import CellRow

ROW_BYTES = 512
"""Memory of a row besides its body and stamps."""
PREFIX, SUFFIX = "fold-", ".rows"


class RowSpool:
    """Rows by cell, to be read by rising number; one thread at a time. Pickled, it reads the same file."""

    def __init__(self, folder: Path | None = None, *, memory_bytes: int) -> None:
        """Without a folder the file is in the system's one for temporary files."""
        self._folder = folder
        self._memory_bytes = memory_bytes
        self._rows: dict[CellKey, CellRow] = {}
        self._rows_bytes = 0
        self._places: dict[CellKey, tuple[int, int]] = {}
        """First byte and length in the file of the rows that are not in memory."""
        self._path: Path | None = None
        self._end = 0

    def __len__(self) -> int:
        return len(self._rows) + len(self._places)

    def __contains__(self, key: object) -> bool:
        return key in self._rows or key in self._places

    def __iter__(self) -> Iterator[CellRow]:
        for key in sorted([*self._rows, *self._places]):
            row = self.get(key)
            if row is not None:
                yield row

    def put(self, row: CellRow) -> None:
        """Keep a row, in the place of the one that its cell may have."""
        self.drop(row.key)
        self._rows[row.key] = row
        self._rows_bytes += _size_bytes(row)
        if self._rows_bytes > self._memory_bytes:
            self._spill()

    def get(self, key: CellKey) -> CellRow | None:
        """Row of a cell, or None."""
        place = self._places.get(key)
        if self._path is None or place is None:
            return self._rows.get(key)
        first, size = place
        with self._path.open("rb") as file:
            file.seek(first)
            row: CellRow = pickle.loads(file.read(size))  # noqa: S301 - our own file
        return row

    def drop(self, key: CellKey) -> None:
        """Forget a cell's row, if it has one."""
        row = self._rows.pop(key, None)
        self._rows_bytes -= _size_bytes(row) if row is not None else 0
        self._places.pop(key, None)

    def _spill(self) -> None:
        """Write the rows in memory to the end of the file."""
        if self._path is None:
            handle, name = tempfile.mkstemp(SUFFIX, PREFIX, self._folder)
            os.close(handle)
            self._path = Path(name)
            weakref.finalize(self, self._path.unlink, missing_ok=True)
        with self._path.open("ab") as file:
            for key, row in self._rows.items():
                data = pickle.dumps(row, pickle.HIGHEST_PROTOCOL)
                self._places[key] = self._end, len(data)
                self._end += file.write(data)
        self._rows.clear()
        self._rows_bytes = 0


def remove_spools(folder: Path) -> None:
    """Remove the files of processes that were killed; only while no process folds."""
    for path in folder.glob(f"{PREFIX}*{SUFFIX}"):
        path.unlink(missing_ok=True)


def _size_bytes(row: CellRow) -> int:
    return len(row.body) + len(row.stamps) + ROW_BYTES
