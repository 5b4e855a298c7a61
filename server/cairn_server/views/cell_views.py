"""Main's cells as clients ask for them: the octree, a file of another form, or a view at an octree depth.

Pages ask for hundreds of views at once, and nearly all of them were made before, so a cell is decoded only if there is
need to: its row has its digest, and that names the view. To make one takes some 15 ms, most of it to decode the cell.
`view_prefetch` makes the views that a page asks for first before any page does.
"""

import hashlib
import json
import struct
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

from cairn_map.codec.view_code import VERSION, encode_view
from cairn_map.errors import BadInputError, DamagedDataError, NotFoundError
from cairn_map.evidence.grid import CellKey, Geometry, cell_of_key
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_map.evidence.view import ViewStyle
from cairn_map.files.cell_files import CELL_MEDIA_TYPE, MEDIA_TYPES, cell_file
from cairn_server.cell_room import DECODING
from cairn_server.folding.cells import Cells
from cairn_server.folding.cells_at_rest import stored_evidence, stored_surfaces
from cairn_server.store.store import Store
from cairn_server.store.store_rows import CellRow, Head, MapRow

BYTES_MAX = 1 << 26
"""Most bytes of all views kept; 56 cells of 4 cm have 2 MB of views at their voxels, 3 MB at all depths."""
DEPTHS_ABOVE_VOXELS = 3
"""Depth above the voxels of the views that pages ask for first: COARSE in console/src/scene/detail.ts."""
LOOKED_AT_S = 600.0
"""Time for which a map counts as looked at, after a page asked for a view of it."""
FILE_VOXELS_MAX = 1 << 20
"""Known voxels of a cell that is made into an NPZ or PLY file: some 330 bytes of memory each."""
BUNDLE_MEDIA_TYPE = "application/vnd.cairn.views"
BUNDLE_CELLS_MAX = 10_000
BUNDLE_BYTES_MAX = 8 << 20


def first_depth(depth: int) -> int:
    """Octree depth at which a page asks first for a cell of this depth."""
    return max(depth - DEPTHS_ABOVE_VOXELS, 1)


def view_name(row: MapRow, stored: CellRow, depth: int) -> str:
    """Name that tells one view from all others, also from those of another map that once had this name."""
    return f"{row.name}/{style_digest(row)}/{stored.digest.hex()}/{depth}"


def style_digest(row: MapRow) -> str:
    """Digest, 16 hex digits, of everything but the evidence that the looks of a map's cells depend on."""
    return _style_digest(row.geometry, row.sensor_model)


@lru_cache(maxsize=256)
def _style_digest(geometry: Geometry, model: SensorModel) -> str:
    text = f"{VERSION} {geometry.model_dump_json()} {model.model_dump_json()}"
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def cell_etag(row: MapRow, stored: CellRow, suffix: str, depth: int | None) -> str:
    """Strong ETag of a cell: of its octree (no suffix, no depth) by its digest, of any other form by the style, too."""
    if depth is not None:
        suffix = f"view.{depth}"
    return f'"{stored.digest.hex()}.{suffix}.{style_digest(row)}"' if suffix else f'"{stored.digest.hex()}"'


def is_same(etag: str, if_none_match: str | None) -> bool:
    """True if `If-None-Match` names this ETag, or any; weak ones count, too (RFC 9110, section 13.1.2)."""
    if if_none_match is None:
        return False
    named = [text.strip().removeprefix("W/") for text in if_none_match.split(",")]
    return if_none_match.strip() == "*" or etag in named


def view_of_stored(row: MapRow, stored: CellRow, depth: int) -> bytes:
    """View of a stored cell at an octree depth.

    Raises:
        DamagedDataError: kind `damaged_store`: its bytes are not sound.
    """
    # Voxels without a hit have a probability below a half: a view that does not show them can leave out most of a cell.
    read = stored_surfaces if row.sensor_model.p_occupied >= 0.5 else stored_evidence
    with DECODING.of_cell(row.geometry, stored.voxels):
        return encode_view(stored.key, read(stored), row.geometry, row.sensor_model, style=ViewStyle(depth=depth))


class ViewCache:
    """Views used last, by name; thread-safe. A name says all of what a view is, so none is ever stale."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._views: OrderedDict[str, bytes] = OrderedDict()
        self._size_bytes = 0
        self._looks_s: dict[int, float] = {}
        """By the number of a map: steady time at which a page asked for a view of it last."""
        self.made = 0
        """Count of the views put in."""

    def note_look(self, number: int) -> None:
        """Note that a page asks for views of a map."""
        with self._lock:
            self._looks_s[number] = time.monotonic()

    def looked_at(self) -> frozenset[int]:
        """Numbers of the maps that pages looked at of late."""
        since_s = time.monotonic() - LOOKED_AT_S
        with self._lock:
            self._looks_s = {number: look_s for number, look_s in self._looks_s.items() if look_s > since_s}
            return frozenset(self._looks_s)

    def is_looked_at(self, number: int) -> bool:
        """True if a page looked at a map of late."""
        with self._lock:
            return time.monotonic() - self._looks_s.get(number, -LOOKED_AT_S) < LOOKED_AT_S

    def ready(self, name: str) -> bytes | None:
        """View of a name, if it is kept."""
        with self._lock:
            found = self._views.get(name)
            if found is not None:
                self._views.move_to_end(name)
            return found

    def view(self, name: str, make: Callable[[], bytes]) -> bytes:
        """View of a name, made unless it is kept."""
        found = self.ready(name)
        if found is not None:
            return found
        # Not under the lock: two threads may make the same view at once, which is rare and does no harm.
        made = make()
        with self._lock:
            if name not in self._views:
                self._views[name] = made
                self._size_bytes += len(made)
                self.made += 1
            while self._size_bytes > BYTES_MAX:
                self._size_bytes -= len(self._views.popitem(last=False)[1])
        return made

    def has(self, name: str) -> bool:
        """True if the view of a name is kept."""
        with self._lock:
            return name in self._views


@dataclass(frozen=True, slots=True)
class CellAnswer:
    """One cell in the form asked for, and the state that it was read from."""

    stored: CellRow
    head: Head
    etag: str
    data: bytes | None
    """Bytes in the form asked for; None: the client has them, by its `If-None-Match`."""


class CellViews:
    """Cells of all maps of a store in the forms that clients ask for; called from many threads."""

    def __init__(self, store: Store, cells: Cells) -> None:
        self._store = store
        self._cells = cells
        self.cache = ViewCache()

    def asked(
        self, row: MapRow, key: CellKey, suffix: str, depth: int | None, *, known: str | None = None
    ) -> CellAnswer:
        """One cell: its octree, a file by suffix, or (with a depth) a view; without data if `known` names its ETag.

        Raises:
            NotFoundError: kind `no_cell`: it was never seen.
            BadInputError: kind `too_costly`: the file would be too large to be made in memory.
            DamagedCellError: kind `damaged_store`: it is damaged and cannot be rebuilt.
        """
        if depth is not None:
            self.cache.note_look(row.number)
            try:
                return self._answer(row, key, self._cells.unchecked(row, key), suffix, depth, known)
            except DamagedDataError:
                pass  # rebuilt from the log below, if that is possible
        return self._answer(row, key, self._cells.sound(row, key), suffix, depth, known)

    def ready(self, row: MapRow) -> tuple[int, bytes]:
        """Octree depth of a page's first views, and those that are ready, in one answer.

        For each of the first `BUNDLE_CELLS_MAX` cells, numbers little endian:

            uint32  bytes of the head      head: JSON, `cell` [i, j, k] and `etag` of the cell's own route
            uint32  bytes of the view      view (FORMAT.md 15)

        Nothing is made for it: 15 us a cell. Views that are missing are asked for by cell.
        """
        depth = first_depth(row.geometry.depth)
        self.cache.note_look(row.number)
        with self._store.snapshot(row) as snapshot:
            cells = [cell for cell in snapshot.cells(limit=BUNDLE_CELLS_MAX) if cell.voxels]
        found = bytearray()
        for cell in cells:
            view = self.cache.ready(view_name(row, cell, depth))
            if view is None:
                continue
            head = json.dumps({"cell": cell_of_key(cell.key), "etag": cell_etag(row, cell, "view", depth)}).encode()
            if len(found) + 8 + len(head) + len(view) > BUNDLE_BYTES_MAX:
                break
            for part in (head, view):
                found += struct.pack("<I", len(part)) + part
        return depth, bytes(found)

    def _answer(
        self,
        row: MapRow,
        key: CellKey,
        found: tuple[CellRow | None, Head],
        suffix: str,
        depth: int | None,
        known: str | None,
    ) -> CellAnswer:
        stored, head = found
        if stored is None:
            raise NotFoundError(
                "no_cell", f"no robot has seen cell {','.join(map(str, cell_of_key(key)))} of map {row.name}"
            )
        etag = cell_etag(row, stored, suffix, depth)
        data = None if is_same(etag, known) else self._data(row, stored, suffix, depth)
        return CellAnswer(stored, head, etag, data)

    def _data(self, row: MapRow, stored: CellRow, suffix: str, depth: int | None) -> bytes:
        if depth is not None:
            return self.cache.view(view_name(row, stored, depth), lambda: view_of_stored(row, stored, depth))
        if not suffix:
            return stored.body
        if suffix != "view" and stored.voxels > FILE_VOXELS_MAX:
            raise BadInputError(
                "too_costly",
                f"a cell of at most {FILE_VOXELS_MAX} known voxels comes as .{suffix[:16]}, this one has "
                f"{stored.voxels}; take the cell itself, or an export of its box, which is made piece by piece",
            )
        with DECODING.of_cell(row.geometry, stored.voxels):
            return cell_file(suffix, stored.key, stored_evidence(stored), row.geometry, row.sensor_model)[0]


def media_type_of(suffix: str, depth: int | None) -> str:
    """Media type of a cell in this form."""
    if depth is not None:
        return MEDIA_TYPES["view"]
    return MEDIA_TYPES[suffix] if suffix else CELL_MEDIA_TYPE
