"""Evidence of one cell by epoch: a row of sums for the base and for each epoch in which it was seen.

    base     sums without a time
    epoch 3  sums of what was captured in it       merging adds row by row: integers, so any order gives equal rows
    epoch 9  ...

A row holds evidence or is not there: what a retract empties is gone. Time decides how rows are read (`present.py`),
never how they are added.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from cairn_map.epochs.epoch import BASE, Epoch, check_epoch
from cairn_map.errors import BadInputError
from cairn_map.evidence.blocks import Blocks, of_blocks, without_blocks
from cairn_map.evidence.brick_cell import difference, sum_evidence
from cairn_map.evidence.evidence import Evidence, empty_evidence
from cairn_map.evidence.evidence_kernels import cell_seeds, epoch_seeds
from cairn_map.evidence.fingerprint import MASK, ZERO, Fingerprint, fingerprint_of_seeds
from cairn_map.evidence.grid import CellKey, Geometry

ROWS_MAX = 1 << 16
"""Most rows of a cell: 91 days of being seen in every epoch of 120 s."""


@dataclass(frozen=True, slots=True, eq=False)
class CellHistory:
    """Rows of one cell, rising in epoch, none of them empty; equal if all rows are."""

    rows: Mapping[Epoch, Evidence]

    def __post_init__(self) -> None:
        epochs = list(self.rows)
        if epochs != sorted(epochs) or not all(len(row) for row in self.rows.values()):
            raise BadInputError("bad_evidence", "a cell's rows must rise in epoch and hold evidence")
        for epoch in epochs:
            check_epoch(epoch)

    def __iter__(self) -> Iterator[Epoch]:
        return iter(self.rows)

    def __len__(self) -> int:
        return len(self.rows)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, CellHistory) and dict(self.rows) == dict(other.rows)

    def __hash__(self) -> int:
        return hash(tuple(self.rows))

    @property
    def size_bytes(self) -> int:
        """Memory held by the rows' arrays."""
        return sum(row.size_bytes for row in self.rows.values())

    def total(self, geometry: Geometry) -> Evidence:
        """Sum of all rows (rule T5): what a map without epochs would hold of the same commits."""
        return sum_evidence(self.rows.values(), geometry)

    def of_blocks(self, blocks: Blocks) -> "CellHistory":
        """Rows of the voxels in some blocks."""
        return cell_history({epoch: of_blocks(row, blocks) for epoch, row in self.rows.items()})

    def without_blocks(self, blocks: Blocks) -> "CellHistory":
        """Rows of the voxels outside of some blocks."""
        return cell_history({epoch: without_blocks(row, blocks) for epoch, row in self.rows.items()})

    def until(self, epoch: Epoch) -> "CellHistory":
        """Rows up to an epoch, which is included: what had been captured then."""
        return CellHistory({mine: row for mine, row in self.rows.items() if mine <= epoch})


NOTHING = CellHistory({})
"""History of a cell that no commit touched."""


def cell_history(rows: Mapping[Epoch, Evidence]) -> CellHistory:
    """History of rows in any order; empty ones are left out.

    Raises:
        BadInputError: kind `bad_epoch`, or `too_large`: more than `ROWS_MAX` rows.
    """
    if len(rows) > ROWS_MAX:
        raise BadInputError("too_large", f"a cell has at most {ROWS_MAX} rows of epochs, got {len(rows)}")
    return CellHistory({epoch: rows[epoch] for epoch in sorted(rows) if len(rows[epoch])})


def merged(histories: Iterable[CellHistory], geometry: Geometry) -> CellHistory:
    """Sum of histories of one cell, row by row; their order does not matter.

    Raises:
        BadInputError: kind `evidence_overflow`, `bad_evidence` or `too_large`.
    """
    parts: dict[Epoch, list[Evidence]] = {}
    for history in histories:
        for epoch, row in history.rows.items():
            parts.setdefault(epoch, []).append(row)
    sums = {epoch: mine[0] if len(mine) == 1 else sum_evidence(mine, geometry) for epoch, mine in parts.items()}
    return cell_history(sums)


def unmerged(whole: CellHistory, part: CellHistory, geometry: Geometry) -> CellHistory:
    """A history without a part that was merged into it: `unmerged(merged([a, b]), b) == a`.

    Raises:
        BadInputError: kind `evidence_overflow` or `bad_evidence`.
    """
    nothing = empty_evidence(geometry)
    left = {epoch: difference(whole.rows.get(epoch, nothing), row, geometry) for epoch, row in part.rows.items()}
    return cell_history({**whole.rows, **left})


def history_fingerprint(history: CellHistory, key: CellKey, *, layer_word: int) -> Fingerprint:
    """Fingerprint of a cell's rows, linear in them; one that moved to another epoch has another (rule T7).

    Args:
        history: the rows; their numbers may be negative.
        key: the cell's number.
        layer_word: `MapLayer.word`; with 0, the fingerprint of a cell that has a base alone is that of its evidence.
    """
    rows = history.rows.items()
    return sum((row_fingerprint(row, epoch, key, layer_word=layer_word) for epoch, row in rows), ZERO)


def row_fingerprint(row: Evidence, epoch: Epoch, key: CellKey, *, layer_word: int) -> Fingerprint:
    """Part of a cell's fingerprint that one row makes; arguments as for `history_fingerprint`."""
    cell = np.uint64((key + layer_word) & MASK)
    seeds = cell_seeds(cell) if epoch == BASE else epoch_seeds(cell, np.int64(epoch))
    return fingerprint_of_seeds(row, seeds)
