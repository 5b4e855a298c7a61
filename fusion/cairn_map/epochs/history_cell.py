"""Rows of one cell in the form to which evidence is added: open as sums, or at rest as bytes.

    epoch 12   sums          changed, or the newest: commits go on coming to it
    epoch 9    bytes         not touched since: copied into the cell's file, not coded again
    base       bytes

A map without epochs has the base alone. `merge` and `unmerge` are exact inverses, in any order, because both are
integer addition, row by row. A row's fingerprint is linear, too: those of few changes are added to it, instead of one
of all voxels at the end. `CellHistory` is the same as a value; `codec.history_code` has the bytes.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

from cairn_map.epochs.cell_history import ROWS_MAX, CellHistory, cell_history
from cairn_map.epochs.epoch import Epoch
from cairn_map.epochs.layer import MapLayer
from cairn_map.errors import BadInputError
from cairn_map.evidence.brick_cell import BrickCell, brick_cell
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.fingerprint import ZERO, Fingerprint
from cairn_map.evidence.grid import CellKey

VOXEL_BYTES = 4
"""Least memory of a voxel in the bricks of a cell, known or not."""


class CodedRow(NamedTuple):
    """One row as bytes, and what is known of its evidence."""

    data: bytes
    """A cell file of version 1."""
    digest: bytes
    fingerprint: Fingerprint
    """Part of the cell's fingerprint."""
    voxels: int
    hottest_k: float | None
    """`cell_order.hottest_k` of the row."""


@dataclass(frozen=True, slots=True)
class RowCoding:
    """Code of rows as bytes; `codec.history_code.row_coding` is the one of the map format."""

    encode: Callable[[CellKey, Epoch, Evidence, Fingerprint], CodedRow]
    """Bytes of evidence of this fingerprint."""
    decode: Callable[[CodedRow], Evidence]
    fingerprint: Callable[[CellKey, Epoch, Evidence], Fingerprint]


class _Row:
    """Sums, bytes, or both if the bytes are of these sums; and the fingerprint of either."""

    __slots__ = ("coded", "fingerprint", "sums", "voxels_left")

    def __init__(self, sums: BrickCell | None, coded: CodedRow | None, fingerprint: Fingerprint, voxels: int) -> None:
        self.sums = sums
        self.coded = coded
        self.fingerprint: Fingerprint | None = fingerprint
        """None: it is to be computed of all voxels."""
        self.voxels_left = voxels
        """Voxels of changes up to which adding their fingerprints is less work than that of all voxels."""

    @property
    def size_bytes(self) -> int:
        return (self.sums.size_bytes if self.sums else 0) + (len(self.coded.data) if self.coded else 0)


class HistoryCell:
    """Sums of evidence over one cell, by epoch; not thread-safe."""

    __slots__ = ("_coding", "_rows", "key", "layer")

    def __init__(self, key: CellKey, layer: MapLayer, coding: RowCoding) -> None:
        """Make a cell without rows."""
        self.key = key
        self.layer = layer
        self._coding = coding
        self._rows: dict[Epoch, _Row] = {}

    def __iter__(self) -> Iterator[Epoch]:
        """Epochs of the rows, rising; one that lost its evidence is in it until the next `coded`."""
        return iter(sorted(self._rows))

    def put(self, epoch: Epoch, row: CodedRow) -> None:
        """Add a row of which there is none yet, as its bytes."""
        self._rows[epoch] = _Row(None, row, row.fingerprint, row.voxels)

    def open(self, epoch: Epoch, evidence: Evidence, fingerprint: Fingerprint) -> None:
        """Add a row of which there is none yet, as the sums of its evidence, which has this fingerprint."""
        self._rows[epoch] = _Row(brick_cell(self.layer.geometry, [evidence]), None, fingerprint, len(evidence))

    def merge(self, epoch: Epoch, diff: Evidence) -> None:
        """Add a diff to the row of an epoch.

        Raises:
            BadInputError: kind `evidence_overflow`: a sum would leave its range; `bad_evidence`: it is of another
                geometry; `too_large`: one row more than `ROWS_MAX`; nothing was changed.
        """
        self._sums(epoch).merge(diff)
        self._note_change(epoch, diff, Fingerprint.__add__)

    def unmerge(self, epoch: Epoch, diff: Evidence) -> None:
        """Take a diff out of the row of an epoch; after it, the cell is what it was before `merge(epoch, diff)`.

        Raises:
            BadInputError: as `merge`.
        """
        self._sums(epoch).unmerge(diff)
        self._note_change(epoch, diff, Fingerprint.__sub__)

    def history(self) -> CellHistory:
        """All rows as packed evidence."""
        return cell_history({epoch: self._packed(row) for epoch, row in self._rows.items()})

    def coded(self) -> dict[Epoch, CodedRow]:
        """All rows as bytes, rising in epoch; only those that changed are coded. Rows without evidence go."""
        for epoch in sorted(self._rows):
            row = self._rows[epoch]
            if row.coded is None:
                evidence = self._packed(row)
                if len(evidence):
                    if row.fingerprint is None:
                        row.fingerprint = self._coding.fingerprint(self.key, epoch, evidence)
                    row.coded = self._coding.encode(self.key, epoch, evidence, row.fingerprint)
                    row.voxels_left = len(evidence)
                else:
                    del self._rows[epoch]
        return {epoch: row.coded for epoch in self if (row := self._rows[epoch]).coded is not None}

    def rest(self) -> None:
        """Hold the rows at rest as bytes: all but the newest, to which commits go on coming."""
        newest = max(self._rows, default=None)
        for epoch, row in self._rows.items():
            if epoch == newest and row.sums is not None:
                # Without epochs nothing but these sums is ever coded, so bytes would be held for nothing.
                row.coded = row.coded if self.layer.has_epochs else None
            elif row.coded is not None:
                row.sums = None

    @property
    def voxels_max(self) -> int:
        """Bound of the voxels that have evidence, each counted in each row."""
        return sum(
            row.sums.counts.size_bytes // VOXEL_BYTES if row.sums else row.coded.voxels if row.coded else 0
            for row in self._rows.values()
        )

    @property
    def size_bytes(self) -> int:
        """Memory held by the rows' arrays and bytes."""
        return sum(row.size_bytes for row in self._rows.values())

    def _note_change(
        self, epoch: Epoch, diff: Evidence, add: Callable[[Fingerprint, Fingerprint], Fingerprint]
    ) -> None:
        row = self._rows[epoch]
        row.coded = None
        row.voxels_left -= len(diff)
        if row.fingerprint is not None and row.voxels_left >= 0:
            row.fingerprint = add(row.fingerprint, self._coding.fingerprint(self.key, epoch, diff))
        else:
            row.fingerprint = None

    def _sums(self, epoch: Epoch) -> BrickCell:
        row = self._rows.get(epoch)
        if row is None:
            if len(self._rows) >= ROWS_MAX:
                raise BadInputError("too_large", f"a cell has at most {ROWS_MAX} rows of epochs")
            row = self._rows[epoch] = _Row(BrickCell(self.layer.geometry), None, ZERO, 0)
        if row.sums is None:
            row.sums = brick_cell(self.layer.geometry, [self._packed(row)])
        return row.sums

    def _packed(self, row: _Row) -> Evidence:
        if row.sums is not None:
            return row.sums.packed()
        assert row.coded is not None  # noqa: S101 - a row has sums or bytes
        return self._coding.decode(row.coded)
