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
from dataclasses import dataclass, replace
from functools import lru_cache

from cairn_map.codec.cell_code import encode_cell
from cairn_map.codec.layer_code import encode_layer_cell
from cairn_map.codec.view_code import VERSION, encode_view
from cairn_map.epochs.cell_history import history_fingerprint
from cairn_map.errors import BadInputError, DamagedDataError, NotFoundError
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.fingerprint import Fingerprint, fingerprint
from cairn_map.evidence.grid import CellKey, Geometry, cell_of_key
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_map.evidence.view import FULL_STYLE, HEIGHT_RESOLUTION_M, Extent, ViewStyle
from cairn_map.files.cell_files import CELL_MEDIA_TYPE, MEDIA_TYPES, cell_file
from cairn_map.queries.level.shown_surfaces import shown_surfaces
from cairn_server.cell_room import DECODING
from cairn_server.folding.cells import Cells
from cairn_server.folding.cells_at_rest import stored_history
from cairn_server.store.store import Store
from cairn_server.store.store_rows import CellRow, Head, MapRow
from cairn_server.views.readings import (
    moment_name,
    past_rows,
    reading_at,
    stored_reading,
    stored_surface_reading,
)

BYTES_MAX = 1 << 26
"""Most bytes of all views kept; 56 cells of 4 cm have 2 MB of views at their voxels, 3 MB at all depths."""
DEPTHS_ABOVE_VOXELS = 3
"""Depth above the voxels of the views that pages ask for first: COARSE in console/src/scene/detail.ts."""
LOOKED_AT_S = 600.0
"""Time for which a map counts as looked at, after a page asked for a view of it."""
FILE_VOXELS_MAX = 1 << 20
"""Known voxels of a cell that is made into an NPZ or PLY file: some 330 bytes of memory each."""
TOTAL = "total"
"""Form of a cell of a map with epochs: the sum of its rows, as a cell of version 1."""
LOOKS = 3
"""Number of the way in which views for a page are made: another one makes all their ETags others."""
BUNDLE_MEDIA_TYPE = "application/vnd.cairn.views"
BUNDLE_CELLS_MAX = 10_000
BUNDLE_BYTES_MAX = 8 << 20


@dataclass(frozen=True, slots=True)
class CellForm:
    """Form of a cell that a client asks for; by default the octree as it is."""

    suffix: str = ""
    """Suffix of a file, or `TOTAL`."""
    depth: int | None = None
    """Octree depth of a view; None: another form is asked for."""
    at_s: float | None = None
    """Time at which the cell is read, UTC seconds since 1970; None: now."""
    is_known: bool = False
    """True for a view of all known nodes, with log-odds: a robot shows it while the rows are on their way."""

    @property
    def known_style(self) -> ViewStyle:
        """Style of a view of all known nodes."""
        return replace(FULL_STYLE, depth=self.depth, extent=Extent.KNOWN)

    @property
    def media_type(self) -> str:
        """Media type of its bytes."""
        return MEDIA_TYPES["view"] if self.depth is not None else MEDIA_TYPES.get(self.suffix, CELL_MEDIA_TYPE)


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
    text = f"{VERSION}.{LOOKS} {geometry.model_dump_json()} {model.model_dump_json()}"
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def cell_etag(row: MapRow, stored: CellRow, form: CellForm) -> str:
    """Strong ETag of a cell: of its octree by its digest, of any other form by the style and the time, too."""
    name = form.suffix if form.depth is None else f"view.{form.depth}"
    if form.is_known:
        name += ".known"
    if form.at_s is not None:
        name += f".{moment_name(row, form.at_s)}"
    return f'"{stored.digest.hex()}.{name}.{style_digest(row)}"' if name else f'"{stored.digest.hex()}"'


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
    with DECODING.of_cell(row.geometry, stored.voxels):
        return view_of_reading(row, stored, shown_reading(row, stored), depth)


def shown_reading(row: MapRow, stored: CellRow) -> Evidence:
    """Evidence of a stored cell, as far as a view shows it.

    Raises:
        DamagedDataError: kind `damaged_store`: its bytes are not sound.
    """
    # Voxels without a hit have a probability below a half: a view that does not show them can leave out most of a cell.
    return (stored_surface_reading if row.sensor_model.p_occupied >= 0.5 else stored_reading)(stored, row)


def view_of_reading(row: MapRow, stored: CellRow, evidence: Evidence, depth: int) -> bytes:
    """View for a page of what was read of a stored cell, at an octree depth."""
    shown, style = page_reading(row, evidence, depth)
    return encode_view(stored.key, shown, row.geometry, row.sensor_model, style=style)


def page_reading(row: MapRow, evidence: Evidence, depth: int) -> tuple[Evidence, ViewStyle]:
    """Evidence and style of the view for a page of what was read of a cell: of a level its surfaces, with heights."""
    style = ViewStyle(depth, is_for_page=True)
    if not row.geometry.is_flat:
        return evidence, style
    shown = shown_surfaces(evidence, row.geometry, row.sensor_model)
    return shown, replace(style, scalar_step=HEIGHT_RESOLUTION_M)


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
    fingerprint: Fingerprint | None
    """Fingerprint of the octree; None if the octree asked for is not the stored one, and is not made."""


class CellViews:
    """Cells of all maps of a store in the forms that clients ask for; called from many threads."""

    def __init__(self, store: Store, cells: Cells) -> None:
        self._store = store
        self._cells = cells
        self.cache = ViewCache()

    def asked(self, row: MapRow, key: CellKey, form: CellForm, *, known: str | None = None) -> CellAnswer:
        """One cell in some form; without data if `known` names its ETag.

        Raises:
            NotFoundError: kind `no_cell`: it was never seen.
            BadInputError: kind `too_costly`: the file would be too large to be made in memory.
            ConflictError: kind `not_known`: evidence of that time is not kept apart any more.
            DamagedCellError: kind `damaged_store`: it is damaged and cannot be rebuilt.
        """
        if form.depth is not None:
            self.cache.note_look(row.number)
            try:
                return self._answer(row, key, self._cells.unchecked(row, key), form, known)
            except DamagedDataError:
                pass  # rebuilt from the log below, if that is possible
        return self._answer(row, key, self._cells.sound(row, key), form, known)

    def ready(self, row: MapRow) -> tuple[int, bytes]:
        """Octree depth of a page's first views, and those that are ready, in one answer.

        For each of the first `BUNDLE_CELLS_MAX` cells, numbers little endian:

            uint32  bytes of the head      head: JSON, `cell` [i, j, k] and `etag` of the cell's own route
            uint32  bytes of the view      view (FORMAT.md 15)

        Nothing is made for it: 15 us a cell. Views that are missing are asked for by cell.
        """
        depth = first_depth(row.geometry.depth)
        form = CellForm("view", depth)
        self.cache.note_look(row.number)
        with self._store.snapshot(row) as snapshot:
            cells = [cell for cell in snapshot.cells(limit=BUNDLE_CELLS_MAX) if cell.voxels]
        found = bytearray()
        for cell in cells:
            view = self.cache.ready(view_name(row, cell, depth))
            if view is None:
                continue
            head = json.dumps({"cell": cell_of_key(cell.key), "etag": cell_etag(row, cell, form)}).encode()
            if len(found) + 8 + len(head) + len(view) > BUNDLE_BYTES_MAX:
                break
            for part in (head, view):
                found += struct.pack("<I", len(part)) + part
        return depth, bytes(found)

    def _answer(
        self, row: MapRow, key: CellKey, found: tuple[CellRow | None, Head], form: CellForm, known: str | None
    ) -> CellAnswer:
        stored, head = found
        if stored is None:
            raise NotFoundError(
                "no_cell", f"no robot has seen cell {','.join(map(str, cell_of_key(key)))} of map {row.name}"
            )
        etag = cell_etag(row, stored, form)
        is_octree = form.depth is None and form.suffix in ("", TOTAL)
        fingerprint = None if is_octree and form != CellForm() else stored.fingerprint
        if is_same(etag, known):
            return CellAnswer(stored, head, etag, None, fingerprint)
        if fingerprint is None:
            return CellAnswer(stored, head, etag, *self._octree(row, stored, form))
        return CellAnswer(stored, head, etag, self._data(row, stored, form), fingerprint)

    def _data(self, row: MapRow, stored: CellRow, form: CellForm) -> bytes:
        """The octree as it is stored, a file, or a view."""
        if form == CellForm():
            return stored.body
        if form.depth is not None and not form.is_known:
            return self._view(row, stored, form, form.depth)
        # Of a cell with epochs the voxels are counted in each row, and it is read as one.
        if not row.layer.has_epochs:
            _check_file(form, stored.voxels)
        with DECODING.of_cell(row.geometry, stored.voxels):
            evidence = reading_at(self._store, stored, row, form.at_s)
            if form.is_known:
                return encode_view(stored.key, evidence, row.geometry, row.sensor_model, style=form.known_style)
            _check_file(form, len(evidence))
            return cell_file(form.suffix, stored.key, evidence, row.geometry, row.sensor_model)[0]

    def _view(self, row: MapRow, stored: CellRow, form: CellForm, depth: int) -> bytes:
        """View at an octree depth."""
        name, until_s = view_name(row, stored, depth), form.at_s
        if until_s is None:
            return self.cache.view(name, lambda: view_of_stored(row, stored, depth))

        def make() -> bytes:
            with DECODING.of_cell(row.geometry, stored.voxels):
                return view_of_reading(row, stored, reading_at(self._store, stored, row, until_s), depth)

        return self.cache.view(f"{name}/{moment_name(row, until_s)}", make)

    def _octree(self, row: MapRow, stored: CellRow, form: CellForm) -> tuple[bytes, Fingerprint]:
        """Rows up to a time, or the sum of them as a cell of version 1, and the fingerprint of these bytes."""
        key, layer = stored.key, row.layer
        with DECODING.of_cell(row.geometry, stored.voxels):
            if form.at_s is None:
                history = stored_history(stored, layer)
            else:
                with self._store.snapshot(row) as snapshot:
                    history = past_rows(snapshot, stored, row, form.at_s)
            if form.suffix == TOTAL:
                total = history.total(row.geometry)
                return encode_cell(key, total, row.geometry).data, fingerprint(total, key)
            found = history_fingerprint(history, key, layer_word=layer.word)
            return encode_layer_cell(key, history, layer).data, found


def _check_file(form: CellForm, voxels: int) -> None:
    """Refuse a file of more voxels than are made into one in memory.

    Raises:
        BadInputError: kind `too_costly`.
    """
    if form.suffix != "view" and voxels > FILE_VOXELS_MAX:
        raise BadInputError(
            "too_costly",
            f"a cell of at most {FILE_VOXELS_MAX} known voxels comes as .{form.suffix[:16]}, this one has {voxels}; "
            "take the cell itself, or an export of its box, which is made piece by piece",
        )
