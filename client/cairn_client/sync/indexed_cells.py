"""Cells of a map's index, all of them in one array: 104 bytes each, where a message of the index takes 1.4 kB.

A server may list any number of cells up to the limit of an index (`requests.INDEX_CELLS_MAX`), whether they exist or
not. A caller that needs all of them takes columns; single ones come out as the entries that they came as.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from cairn_map.evidence.grid import CellKey, cell_keys, cell_of_key, cells_of_keys
from cairn_map.wire.messages import CellEntry, ReplyHeader

ENTRY = np.dtype(
    [
        ("key", np.uint64),
        ("size_bytes", np.int64),
        ("lm", np.int64),
        ("held_lm", np.int64),
        ("voxels", np.int64),
        ("hottest_k", np.float64),
        # Bytes, with their zeros at the end.
        ("digest", "V32"),
        ("fingerprint", "V16"),
    ]
)
UNKNOWN = -1
"""A `held_lm` that is None."""


@dataclass(frozen=True, slots=True)
class IndexedCells:
    """Cells of an index, by rising number."""

    table: npt.NDArray[np.void]
    """(N,) `ENTRY`."""

    def __len__(self) -> int:
        return len(self.table)

    def __iter__(self) -> Iterator[CellEntry]:
        return (self[n] for n in range(len(self.table)))

    def __getitem__(self, n: int) -> CellEntry:
        row: Any = self.table[n]
        return CellEntry(
            cell=cell_of_key(int(row["key"])),
            size_bytes=int(row["size_bytes"]),
            digest=row["digest"].tobytes().hex(),
            lm=int(row["lm"]),
            fingerprint=row["fingerprint"].tobytes().hex(),
            voxels=int(row["voxels"]),
            hottest_k=None if np.isnan(row["hottest_k"]) else float(row["hottest_k"]),
            held_lm=None if row["held_lm"] == UNKNOWN else int(row["held_lm"]),
        )

    def find(self, key: CellKey) -> CellEntry | None:
        """The entry of a cell; None if it is not listed."""
        n = int(np.searchsorted(self.table["key"], np.uint64(key)))
        return self[n] if n < len(self.table) and int(self.table["key"][n]) == key else None

    @property
    def cells(self) -> npt.NDArray[np.int64]:
        """(N, 3) indices of the cells."""
        return cells_of_keys(self.table["key"])

    @property
    def keys_with_evidence(self) -> list[CellKey]:
        """Numbers of the cells in which some voxel is known."""
        found: list[CellKey] = self.table["key"][self.table["voxels"] > 0].tolist()
        return found


@dataclass(frozen=True, slots=True)
class MapIndex:
    """Index of all cells of a map, or of a box of it."""

    header: ReplyHeader
    cells: IndexedCells


def listed_page(entries: Sequence[CellEntry]) -> npt.NDArray[np.void]:
    """(N,) `ENTRY`, the cells of one page in its order.

    Raises:
        BadInputError: kind `cell_range`: a cell is beyond the numbered space.
    """
    table = np.zeros(len(entries), ENTRY)
    table["key"] = cell_keys([entry.cell for entry in entries])
    for name in ("size_bytes", "lm", "voxels"):
        table[name] = [getattr(entry, name) for entry in entries]
    table["held_lm"] = [UNKNOWN if entry.held_lm is None else entry.held_lm for entry in entries]
    table["hottest_k"] = np.array([entry.hottest_k for entry in entries], np.float64)
    for name in ("digest", "fingerprint"):
        texts = "".join(getattr(entry, name) for entry in entries)
        table[name] = np.frombuffer(bytes.fromhex(texts), ENTRY[name])
    return table
