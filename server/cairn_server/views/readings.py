"""Evidence of a stored cell as it is shown: now, or as it was at a time.

    map with epochs      rows up to that of the time   -->  reading (rules R1, R2 and R4)
    map without epochs   sum of all its commits; of the past, that of the kept commits captured until then

What was taken out of a map is in no reading, whenever it was taken out.
"""

from collections.abc import Iterable, Iterator, Sequence
from typing import overload

import numpy as np

from cairn_map.arrays import Floats
from cairn_map.codec.layer_code import encode_layer_cell, row_bodies
from cairn_map.commits.cursor import ENTRY_FOLD
from cairn_map.commits.ids import CommitId
from cairn_map.epochs.cell_history import CellHistory, cell_history
from cairn_map.epochs.cell_reading import block_times_s
from cairn_map.epochs.epoch import BASE, Epoch, begin_s, epoch_of
from cairn_map.epochs.present import present_of_rows, shown_evidence
from cairn_map.errors import BadInputError, ConflictError, DamagedDataError
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.grid import CellKey, cell_of_key
from cairn_server.cell_room import DECODING, decoded_bytes, voxels_of
from cairn_server.folding.cells_at_rest import (
    check_stored,
    decode_rows,
    decode_stored,
    stored_history,
    stored_surfaces,
    sum_of_contributions,
)
from cairn_server.store.store import Snapshot, Store
from cairn_server.store.store_rows import CellRow, Contribution, MapRow

AFTER = Epoch(0)
"""Row of what came after a time, in the rows of a map without epochs that are compared."""
PAST_ENTRIES_MAX = 512
"""Most log entries of a cell that are added up for its past, some 10 ms each."""


def stored_reading(stored: CellRow, row: MapRow) -> Evidence:
    """Evidence of a stored cell as it is now.

    Raises:
        DamagedDataError: kind `damaged_store`: its bytes are not sound, or do not have its digest.
    """
    if fits(row, stored.voxels):
        return shown_evidence(stored_history(stored, row.layer), row.layer, row.sensor_model)
    check_stored(stored, row.layer)
    return _reading_by_row(stored.key, stored.body, row, None)


def stored_surface_reading(stored: CellRow, row: MapRow) -> Evidence:
    """`stored_reading`, of which voxels without hits and samples may be left out, where that takes less time.

    Raises:
        DamagedDataError: kind `damaged_store`: its bytes are not sound, or do not have its digest.
    """
    return stored_reading(stored, row) if row.layer.has_epochs else stored_surfaces(stored)


def reading_of_body(key: CellKey, body: bytes, row: MapRow) -> Evidence:
    """Reading of the bytes of a cell that were found sound before.

    Raises:
        DamagedDataError: kind `damaged_store`: they are not sound.
    """
    if fits(row, voxels_of(body)):
        return shown_evidence(decode_rows(key, body, row.layer).history, row.layer, row.sensor_model)
    return _reading_by_row(key, body, row, None)


def fits(row: MapRow, voxels: int) -> bool:
    """True if all rows of a cell may be in memory at once; those of a map without epochs are one."""
    return not row.layer.has_epochs or decoded_bytes(row.geometry, voxels) <= DECODING.limit_bytes


class _RowsAtRest(Sequence[Evidence]):
    """Rows of a cell, each decoded whenever it is read."""

    def __init__(self, key: CellKey, bodies: Sequence[bytes]) -> None:
        self._key = key
        self._bodies = bodies

    def __len__(self) -> int:
        return len(self._bodies)

    @overload
    def __getitem__(self, number: int) -> Evidence: ...

    @overload
    def __getitem__(self, number: slice) -> Sequence[Evidence]: ...

    def __getitem__(self, number: int | slice) -> Evidence | Sequence[Evidence]:
        if isinstance(number, slice):
            return _RowsAtRest(self._key, self._bodies[number])
        return decode_stored(self._key, self._bodies[number]).evidence


def _reading_by_row(key: CellKey, body: bytes, row: MapRow, until: Epoch | None) -> Evidence:
    """Reading of a sound cell with more rows than fit in memory at once, one of them at a time; some times slower."""
    bodies = {
        epoch: each for epoch, each in row_bodies(body, key, row.layer).items() if until is None or epoch <= until
    }
    read = present_of_rows(list(bodies), _RowsAtRest(key, list(bodies.values())), row.geometry, row.sensor_model)
    return read.evidence if row.epoch_s is None else read.dated_evidence(row.epoch_s)


def past_reading(snapshot: Snapshot, stored: CellRow, row: MapRow, until_s: float) -> Evidence:
    """Evidence of a stored cell as it was at a time (UTC seconds since 1970), by capture.

    Raises:
        ConflictError, BadInputError, DamagedDataError: as `past_rows`.
    """
    if row.epoch_s is not None and not fits(row, stored.voxels):
        check_stored(stored, row.layer)
        return _reading_by_row(stored.key, stored.body, row, epoch_of(until_s, row.epoch_s))
    return shown_evidence(past_rows(snapshot, stored, row, until_s), row.layer, row.sensor_model)


def reading_at(store: Store, stored: CellRow, row: MapRow, until_s: float | None) -> Evidence:
    """`stored_reading`, or at a time `past_reading` of the map as it is when it is called.

    Raises:
        ConflictError, BadInputError, DamagedDataError: as `past_rows`.
    """
    if until_s is None:
        return stored_reading(stored, row)
    with store.snapshot(row) as snapshot:
        return past_reading(snapshot, stored, row, until_s)


def body_and_reading(snapshot: Snapshot, stored: CellRow, row: MapRow, until_s: float | None) -> tuple[bytes, Evidence]:
    """Reading of a stored cell, now or at a time, and bytes of which `reading_of_body` makes it again.

    Raises:
        ConflictError, BadInputError, DamagedDataError: as `past_rows`.
    """
    if until_s is None:
        return stored.body, stored_reading(stored, row)
    rows = past_rows(snapshot, stored, row, until_s)
    return encode_layer_cell(stored.key, rows, row.layer).data, shown_evidence(rows, row.layer, row.sensor_model)


def past_rows(snapshot: Snapshot, stored: CellRow, row: MapRow, until_s: float) -> CellHistory:
    """Rows of a stored cell that were captured up to a time; evidence without a time is older than any.

    Raises:
        ConflictError: kind `not_known`: evidence of then is not kept apart from later evidence any more.
        BadInputError: kind `too_costly`: too many commits are to be added up.
        DamagedDataError: kind `damaged_store`: the cell, or a commit that it is made of, is not sound.
    """
    if row.epoch_s is not None:
        return stored_history(stored, row.layer).until(epoch_of(until_s, row.epoch_s))
    until, _ = kept_contributions(snapshot, stored, row, until_s)
    return sum_of_contributions(snapshot, stored.key, until, row.layer).history()


def past_times_s(snapshot: Snapshot, stored: CellRow, row: MapRow, until_s: float) -> Floats:
    """Times of a stored cell's blocks as `block_times_s` has them, of what `past_reading` shows.

    Of a map with epochs they are the first instants of epochs, else the last scans of commits.

    Raises:
        ConflictError, BadInputError, DamagedDataError: as `past_rows`.
    """
    if row.epoch_s is None:
        until, _ = kept_contributions(snapshot, stored, row, until_s)
        return block_times_s(_dated_diffs(snapshot, stored.key, until), row.geometry.depth)
    check_stored(stored, row.layer)
    last, epoch_s = epoch_of(until_s, row.epoch_s), row.epoch_s
    dated = (
        (begin_s(epoch, epoch_s), decode_stored(stored.key, body).evidence)
        for epoch, body in row_bodies(stored.body, stored.key, row.layer).items()
        if BASE < epoch <= last
    )
    return block_times_s(dated, row.geometry.depth)


def _dated_diffs(
    snapshot: Snapshot, key: CellKey, contributions: Iterable[Contribution]
) -> Iterator[tuple[float, Evidence]]:
    """Time of the last scan, NaN if it is not stated, and evidence of each commit of a cell."""
    for entry in contributions:
        (said,) = snapshot.log(after_seq=entry.seq - 1, limit=1)
        body = snapshot.diff(entry.commit, key)
        if body is None:
            raise DamagedDataError("damaged_store", f"a diff of cell {cell_of_key(key)} is not there")
        yield said.captured_s[1] if said.captured_s else np.nan, decode_stored(key, body).evidence


def rows_around(snapshot: Snapshot, stored: CellRow, row: MapRow, since_s: float, until_s: float | None) -> CellHistory:
    """Rows of a stored cell, to be compared before and after a time.

    Those of a map with epochs are all. One without gets two: the base, of what was captured until `since_s`, and
    `AFTER`, of what came until `until_s` (None: now).

    Raises:
        ConflictError, BadInputError, DamagedDataError: as `past_rows`.
    """
    if row.layer.has_epochs:
        return stored_history(stored, row.layer)
    before, later = kept_contributions(snapshot, stored, row, since_s)
    after = [each for each in later if until_s is None or was_captured(snapshot, each, row, until_s)]
    sums = [sum_of_contributions(snapshot, stored.key, part, row.layer).history().rows for part in (before, after)]
    return cell_history({epoch: rows[BASE] for epoch, rows in zip((BASE, AFTER), sums, strict=True) if rows})


def kept_contributions(
    snapshot: Snapshot, stored: CellRow, row: MapRow, until_s: float
) -> tuple[list[Contribution], list[Contribution]]:
    """Commits that a cell without epochs is made of: those captured until a time or at none, and those after it.

    Raises:
        ConflictError, BadInputError: as `past_rows`.
    """
    name = f"cell {','.join(map(str, cell_of_key(stored.key)))} of map {row.name}"
    if stored.gone_seq:
        raise ConflictError(
            "not_known",
            f"the past of {name} is not known: evidence that it is made of is not kept apart any more; maps with "
            "epochs keep it",
        )
    found = snapshot.contributions(stored.key, after_seq=0, newest=PAST_ENTRIES_MAX + 1)
    if len(found) > PAST_ENTRIES_MAX:
        raise BadInputError(
            "too_costly",
            f"the past of {name} is the sum of more than {PAST_ENTRIES_MAX} commits; maps with epochs keep it ready",
        )
    # What was taken out is in no past; a commit is folded again only after it was.
    folded: dict[CommitId, Contribution] = {}
    for entry in found:
        if entry.kind == ENTRY_FOLD:
            folded[entry.commit] = entry
        else:
            folded.pop(entry.commit, None)
    parts: tuple[list[Contribution], list[Contribution]] = ([], [])
    for entry in folded.values():
        parts[not was_captured(snapshot, entry, row, until_s)].append(entry)
    return parts


def was_captured(snapshot: Snapshot, entry: Contribution, row: MapRow, until_s: float) -> bool:
    """True if the commit of an entry is read at a time: by its epoch, or of a map without epochs by its last scan."""
    if row.epoch_s is not None:
        return entry.epoch <= epoch_of(until_s, row.epoch_s)
    (said,) = snapshot.log(after_seq=entry.seq - 1, limit=1)
    return said.captured_s is None or said.captured_s[1] <= until_s


def moment_name(row: MapRow, until_s: float) -> str:
    """Name that is the same for times at which a map reads the same because they are of one epoch."""
    return f"e{epoch_of(until_s, row.epoch_s)}" if row.epoch_s is not None else repr(until_s)
