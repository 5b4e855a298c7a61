"""Parts of a map as files that leave: made cell by cell while they are sent, of one state of the map.

Nothing is read from the store while a link is slow: the chosen cells, a few bytes a voxel, are first laid aside in a
temporary file, and their points counted, because files begin with their number; of an octree the cells' branches are
laid aside. The file is gone as soon as the answer is, however it ends. So an export needs the memory of one cell,
whatever its size.
"""

import heapq
import logging
import math
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from typing import IO

from cairn_map.commits.cursor import Cursor
from cairn_map.epochs.moment import time_from_text
from cairn_map.errors import BadInputError, CairnError, DeniedError, UnreachableError
from cairn_map.evidence.evidence import Evidence, empty_evidence
from cairn_map.evidence.grid import CellKey
from cairn_map.files.export_request import ExportRequest, cell_may_have, node_geometry
from cairn_map.files.octomap import TREE_FORMATS, branch_of_cell, cells_at_border, tree_file, tree_of_cells
from cairn_map.files.octomap_nodes import Nodes
from cairn_map.files.point_clouds import (
    About,
    PointBounds,
    Table,
    found_in_cell,
    point_file,
    points_of_cell,
    size_of_file,
)
from cairn_server.access.cancellation import CANCELLATION
from cairn_server.cell_room import DECODING, voxels_of
from cairn_server.folding.cells import Cells
from cairn_server.folding.cells_at_rest import DamagedCellError, sound_cell
from cairn_server.store.store import Snapshot, Store
from cairn_server.store.store_rows import CellRow, MapRow
from cairn_server.views.readings import body_and_reading, reading_of_body

log = logging.getLogger(__name__)

VOXELS_EXPORTED_MAX = 1 << 28
"""Most known voxels of the cells of an export."""
PIECE_BYTES = 1 << 16
"""Bytes that are sent before the token is looked up again: a minute of the slowest link."""
COUNT_S = 60.0
COUNTS_AT_ONCE = 2
WAIT_S = 5.0
"""Longest wait for another export to be counted."""


@dataclass(frozen=True, slots=True)
class Export:
    """A file on its way: the state that it is of, its size (None: not known yet), and its bytes."""

    head: Cursor
    count: int
    size_bytes: int | None
    parts: Iterator[bytes]
    aside: IO[bytes]
    """Temporary file that the bytes are made of."""

    def close(self) -> None:
        """Drop the temporary file of an export that is not sent."""
        self.aside.close()


def while_allowed(export: Export, check: Callable[[], object]) -> Export:
    """Export that a check precedes piece by piece: what it raises ends the file, since the token may have ended.

    An unreadable store is no reason to cut a file off.
    """

    def pieces() -> Iterator[bytes]:
        for part in export.parts:
            for start in range(0, len(part), PIECE_BYTES):
                try:
                    check()
                except DeniedError:
                    export.close()
                    raise
                except CairnError as exc:
                    log.warning("cannot look the token of an export up: %s", exc.message)
                yield part[start : start + PIECE_BYTES]

    return replace(export, parts=pieces())


class MapExports:
    """Exports of a store; thread-safe."""

    def __init__(self, store: Store, cells: Cells) -> None:
        self._store = store
        self._cells = cells
        self._room = threading.BoundedSemaphore(COUNTS_AT_ONCE)

    def asked(self, row: MapRow, asked: ExportRequest) -> Export:
        """Export of the map in its present state.

        Raises:
            BadInputError: kind `bad_box`, `bad_style`; `too_large`: the cells have too many voxels; `too_costly`.
            UnreachableError: kind `busy`: others are being counted.
            DamagedCellError: kind `damaged_store`: a chosen cell is damaged.
        """
        asked.depth_in(row.geometry)
        asked.bounds_m()
        file = _TreeFile(row, asked) if asked.format in TREE_FORMATS else _PointFile(row, asked)
        with self._turn(), self._cells.reading(row) as faults, self._store.snapshot(row) as snapshot:
            head = snapshot.head
            aside = tempfile.TemporaryFile()  # noqa: SIM115 - goes with its last reader
            try:
                sizes = _laid_aside(aside, snapshot, file, faults.healed)
            except BaseException:
                aside.close()
                raise
        return Export(head, file.count, file.size_bytes, file.parts(_bodies(aside, sizes)), aside)

    @contextmanager
    def _turn(self) -> Iterator[None]:
        if not self._room.acquire(timeout=WAIT_S):
            raise UnreachableError("busy", "other exports are being counted", retry_after_s=1.0)
        try:
            yield
        finally:
            self._room.release()


class _PointFile:
    """Point file: cells are laid aside as they are stored, and read a second time for their points."""

    unseen_cells = ()

    def __init__(self, row: MapRow, asked: ExportRequest) -> None:
        self.row, self.asked, self.until_s = row, asked, _until_s(asked)
        self._found = PointBounds()
        edges_m = node_geometry(row.geometry, asked).voxel_edges_m
        classes = next((channel.classes for channel in row.geometry.channels if channel.classes), ())
        self._about = About(row.name, edges_m, has_times=row.layer.has_epochs, classes=classes)

    def kept(self, key: CellKey, body: bytes, evidence: Evidence) -> bytes:
        """Bytes of a cell to be laid aside; empty if it has nothing that is asked for."""
        found = found_in_cell(key, evidence, self.row.geometry, self.row.sensor_model, self.asked)
        self._found = self._found.joined(found)
        return body if found.count else b""

    @property
    def count(self) -> int:
        return self._found.count

    @property
    def size_bytes(self) -> int | None:
        return size_of_file(self.asked.format, self._found, self._about)

    def parts(self, bodies: Iterator[tuple[CellKey, bytes]]) -> Iterator[bytes]:
        tables = (self._points(key, body) for key, body in bodies)
        return point_file(self.asked.format, self._found, tables, self._about)

    def _points(self, key: CellKey, body: bytes) -> Table:
        geometry, model = self.row.geometry, self.row.sensor_model
        with DECODING.of_cell(geometry, voxels_of(body)):
            evidence = reading_of_body(key, body, self.row)
            return points_of_cell(key, evidence, geometry, model, self.asked)


class _TreeFile:
    """Octree file: of each cell its subtree is laid aside, as it will stand in the file."""

    size_bytes = None

    def __init__(self, row: MapRow, asked: ExportRequest) -> None:
        self.row, self.asked, self.until_s = row, asked, _until_s(asked)
        self.unseen_cells = cells_at_border(row.geometry, row.sensor_model, asked)
        self._roots: list[Nodes] = []

    def kept(self, key: CellKey, _: bytes, evidence: Evidence) -> bytes:
        """Bytes of a cell to be laid aside; empty if it has nothing that is asked for, or is one leaf."""
        found = branch_of_cell(key, evidence, self.row.geometry, self.row.sensor_model, self.asked)
        if found is None:
            return b""
        self._roots.append(found[0])
        return found[1]

    @cached_property
    def _nodes(self) -> Nodes:
        return tree_of_cells(self._roots, self.row.geometry, self.row.sensor_model, self.asked)

    @property
    def count(self) -> int:
        return int(self._nodes["leaves"][0]) if len(self._nodes) else 0

    def parts(self, bodies: Iterator[tuple[CellKey, bytes]]) -> Iterator[bytes]:
        about = str(About(self.row.name, node_geometry(self.row.geometry, self.asked).voxel_edges_m))
        in_turn = (body for _, body in bodies)
        return tree_file(self.asked.format, self._nodes, in_turn, self.row.geometry, about)


def _cells_in_turn(snapshot: Snapshot, file: _PointFile | _TreeFile) -> Iterator[tuple[CellKey, int]]:
    """Cells that may have what is asked for, rising in number, with their known voxels; 0: unseen, or nothing known."""
    listed = (
        (cell.key, cell.voxels)
        for cell in snapshot.cells()
        if cell.voxels and cell_may_have(cell.key, file.row.geometry, file.asked)
    )
    before: CellKey | None = None
    # Of a cell that is in both the one with voxels comes first.
    for key, voxels in heapq.merge(
        listed, ((key, 0) for key in file.unseen_cells), key=lambda cell: (cell[0], -cell[1])
    ):
        if key != before:
            yield key, voxels
        before = key


def _laid_aside(
    aside: IO[bytes], snapshot: Snapshot, file: _PointFile | _TreeFile, healed: list[CellRow]
) -> list[tuple[CellKey, int]]:
    """Cells that have what is asked for, rising in number, with the sizes of their bytes."""
    until_s, row = math.inf, file.row
    voxels, sizes = 0, list[tuple[CellKey, int]]()
    cancellation = CANCELLATION.get()
    for key, known in _cells_in_turn(snapshot, file):
        cancellation.check()
        voxels += known
        if voxels > VOXELS_EXPORTED_MAX:
            raise BadInputError(
                "too_large", f"more than {VOXELS_EXPORTED_MAX} voxels are in these cells; ask for a box"
            )
        if time.monotonic() > until_s:
            raise BadInputError("too_costly", f"counting the points takes more than {COUNT_S:g} s; ask for a box")
        with DECODING.of_cell(row.geometry, known):
            if known:
                stored = sound_cell(snapshot, key, row.layer, healed)
                if stored is None:
                    raise DamagedCellError(key, "a cell is listed, but is not there")
                kept = file.kept(key, *body_and_reading(snapshot, stored, row, file.until_s))
            else:
                kept = file.kept(key, b"", empty_evidence(row.geometry))
        if until_s == math.inf:
            until_s = time.monotonic() + COUNT_S  # not from the start: with the first cell kernels may be compiled
        if kept:
            aside.write(kept)
            sizes.append((key, len(kept)))
    return sizes


def _until_s(asked: ExportRequest) -> float | None:
    return None if asked.at is None else time_from_text(asked.at)


def _bodies(aside: IO[bytes], sizes: list[tuple[CellKey, int]]) -> Iterator[tuple[CellKey, bytes]]:
    with aside:
        aside.seek(0)
        for key, size_bytes in sizes:
            yield key, aside.read(size_bytes)
