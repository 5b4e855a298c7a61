"""Pictures of a map from any pose, made where the map is: for operators, and for robots that have no room for it.

Bounded, because anybody who may read may ask: pixels and range by the request itself, cells, voxels and time here, and
so many pictures are made at a time. A picture depends on the request and on the map's head alone, and so does its ETag.
"""

import hashlib
import logging
import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache, partial

import numpy as np

from cairn_map.arrays import Flags, Ints
from cairn_map.commits.cursor import Cursor
from cairn_map.epochs.moment import time_from_text
from cairn_map.errors import BadInputError, DamagedDataError, UnreachableError
from cairn_map.evidence.brick_cell import brick_cell, reading_cell
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.grid import CellKey, cell_of_key
from cairn_map.render.camera_rays import cells_in_sight, with_cells_around
from cairn_map.render.ground_picture import GroundCell, GroundColumns, check_layer, ground_cell, ground_columns
from cairn_map.render.map_picture import Ages, arrays_of, layer_picture, layer_values, npz_of
from cairn_map.render.map_render import MapRenderer, SurfaceImage
from cairn_map.render.partial_map import Drawing, ReadCell, draw_as_needed, read_cell
from cairn_map.render.render_picture import Layer, png_of
from cairn_map.render.render_request import RenderRequest
from cairn_map.warm_up import warm_up_pictures
from cairn_server.access.cancellation import CANCELLATION, Cancellation
from cairn_server.cell_room import DECODING
from cairn_server.folding.cells import Cells
from cairn_server.folding.cells_at_rest import DamagedCellError, row_of_cell, sound_cell
from cairn_server.folding.read_cache import State, state_of
from cairn_server.folding.single_flight import MadeOnce
from cairn_server.store.stamps import Stamps, decode_stamps, no_stamps
from cairn_server.store.store import Snapshot, Store
from cairn_server.store.store_rows import CellRow, MapRow
from cairn_server.views.readings import moment_name, past_reading, past_times_s, stored_reading

log = logging.getLogger(__name__)

VERSION = 2
"""Version of the looks of pictures: part of their ETags."""
CELLS_IN_VIEW_MAX = 4096
VOXELS_READ_MAX = 1 << 26
"""Most voxels of all cells that one picture reads."""
RENDER_S = 10.0
RENDERS_AT_ONCE = 2
WAIT_S = 5.0
"""Longest wait for another picture to be made."""
THREADS = 2
CELLS_BYTES = 224 << 20
"""Memory for cells of all maps that are ready to be drawn."""
GROUND_BYTES = 32 << 20
"""Memory for surfaces of level cells that are ready to be drawn."""
LISTS_BYTES = 64 << 20
"""Memory for lists of cells."""
LISTED_BYTES = 500
TIMES_MAX = 100_000
Listing = tuple[dict[CellKey, CellRow], Ints]
CellName = tuple[State, Layer, str | None]
"""State of a cell, layer in which it is drawn, and time at which it is read; None: now."""
GroundName = tuple[State, str | None]
"""State of a level's cell, and time at which it is read."""


@dataclass(frozen=True, slots=True)
class AskedView:
    """A picture's ETag, the state that it shows, and its bytes; none if the asker has them."""

    etag: str
    head: Cursor
    body: bytes | None


@dataclass(slots=True)
class _Task:
    """One picture under way."""

    snapshot: Snapshot
    row: MapRow
    until_s: float | None
    """Time at which the map is read, UTC seconds since 1970; None: now."""
    layer: Layer
    """Layer whose values are read from cells; depths and ages need none."""
    listed: dict[CellKey, CellRow]
    """Cells of the snapshot that hold something."""
    end_s: float
    """Steady time at which the picture must be ready."""
    cancellation: Cancellation
    healed: list[CellRow]
    """Collects the cells that were rebuilt from the log."""
    voxels: int = 0
    """Voxels of the cells read so far."""

    def name_of(self, key: CellKey) -> CellName:
        """Key of a cell that is ready for this picture, among those of all pictures."""
        state, moment = self.ground_name_of(key)
        return state, self.layer, moment

    def ground_name_of(self, key: CellKey) -> GroundName:
        """Key of a level's cell among those of all pictures, whatever layer they are drawn in."""
        moment = None if self.until_s is None else moment_name(self.row, self.until_s)
        return state_of(self.snapshot, self.listed[key]), moment

    def count_voxels(self, wanted: Sequence[CellKey]) -> None:
        """Count the voxels of cells that are about to be read.

        Raises:
            BadInputError: kind `too_large`.
        """
        self.voxels += sum(self.listed[key].voxels for key in wanted)
        if self.voxels > VOXELS_READ_MAX:
            raise BadInputError(
                "too_large", f"more than {VOXELS_READ_MAX} voxels are in the cells in sight; lower range_m"
            )

    def check_time(self) -> None:
        """End what takes too long, or is not wanted any more.

        Raises:
            BadInputError: kind `too_costly`, `cut_off`.
            UnreachableError: kind `shutting_down`.
        """
        self.cancellation.check()
        if time.monotonic() > self.end_s:
            raise BadInputError(
                "too_costly", f"the picture takes more than {RENDER_S:g} s; ask for fewer pixels, or less range_m"
            )


class MapViews:
    """Draws maps of a store; thread-safe."""

    def __init__(self, store: Store, cells: Cells, *, cache_share: float = 1.0) -> None:
        """Draw the maps of a store, with caches of this part of their standard size."""
        self._store = store
        self._cells = cells
        self._room = threading.BoundedSemaphore(RENDERS_AT_ONCE)
        self._read_cells: MadeOnce[CellName, ReadCell] = MadeOnce(
            limit_bytes=int(cache_share * CELLS_BYTES), size_of=lambda read: read.size_bytes
        )
        self._ground_cells: MadeOnce[GroundName, GroundCell] = MadeOnce(
            limit_bytes=int(cache_share * GROUND_BYTES), size_of=lambda read: read.size_bytes
        )
        self._lists: MadeOnce[Cursor, Listing] = MadeOnce(
            limit_bytes=int(cache_share * LISTS_BYTES), size_of=lambda listing: LISTED_BYTES * (1 + len(listing[0]))
        )
        self._times: dict[bytes, float] = {}
        """By the chain at the entry."""

    def asked(self, row: MapRow, request: RenderRequest, *, known: str | None) -> AskedView:
        """A picture of the map as it is now, or None for its bytes if the asker `known`s them by `If-None-Match`.

        Raises:
            BadInputError: kinds `unknown_channel`, `not_level`: the map has no such layer; `too_large`: too many cells
                or voxels are in sight; `too_costly`: it takes too long.
            UnreachableError: kind `busy`: others are being made.
            DamagedCellError: kind `damaged_store`: a cell in sight is damaged.
        """
        check_layer(row.geometry, request.layer)
        _get_ready()
        until_s = None if request.at is None else time_from_text(request.at)
        with self._cells.reading(row) as faults, self._store.snapshot(row) as snapshot:
            etag = _etag(snapshot.head, request)
            if known is not None and etag in known:
                return AskedView(etag, snapshot.head, None)
            with self._turn():
                end_s = time.monotonic() + RENDER_S
                listed, places = self._listing(snapshot)
                layer, cancellation = _read_of(request.layer), CANCELLATION.get()
                task = _Task(snapshot, row, until_s, layer, listed, end_s, cancellation, faults.healed)
                draw = self._ground_body if row.geometry.is_flat else self._body
                return AskedView(etag, snapshot.head, draw(task, places, request))

    @contextmanager
    def _turn(self) -> Iterator[None]:
        if not self._room.acquire(timeout=WAIT_S):
            raise UnreachableError("busy", "other pictures are being made", retry_after_s=1.0)
        try:
            yield
        finally:
            self._room.release()

    def _body(self, task: _Task, places: Ints, request: RenderRequest) -> bytes:
        drawing, renderer = self._drawing(task, places, request)
        snapshot, seen = drawing.snapshot, drawing.seen
        ages = None
        if request.layer is Layer.AGE:
            ages = self._ages(task, _cells_seen(drawing.snapshot.frozen.keys, seen))
        values = layer_values(renderer, snapshot, seen, request.layer, ages)
        task.check_time()
        if request.format == "npz":
            return npz_of(arrays_of(values, seen, request.layer, request.spread))
        return png_of(layer_picture(values, seen, request.scale, request.spread))

    def _ground_body(self, task: _Task, places: Ints, request: RenderRequest) -> bytes:
        """A picture of a level layer."""
        ground = self._ground(task, places, request)
        image = ground.seen(request.sight, request.T_map_camera, range_max_m=request.range_m, on_share=task.check_time)
        seen, ages = image.seen, None
        if request.layer is Layer.AGE:
            ages = self._ages(task, _cells_seen(ground.keys, seen))
        values = image.values(request.layer, ages)
        task.check_time()
        if request.format == "npz":
            return npz_of(arrays_of(values, seen, request.layer, request.spread))
        return png_of(layer_picture(values, seen, request.scale, request.spread, shade=image.shade))

    def _ground(self, task: _Task, places: Ints, request: RenderRequest) -> GroundColumns:
        """The cells in sight, and those around them: what a surface is, its neighbours say."""
        wanted = with_cells_around(places, self._inside(task, places, request))
        found: dict[CellKey, GroundCell] = {}
        for key, is_wanted in zip(task.listed, wanted.tolist(), strict=True):
            if is_wanted:
                task.check_time()
                name = task.ground_name_of(key)
                if self._ground_cells.here(name) is None:
                    task.count_voxels([key])
                found[key] = self._ground_cells.get(name, partial(_surfaces, task, key))
        return ground_columns(found, task.row.geometry)

    def _inside(self, task: _Task, places: Ints, request: RenderRequest) -> Flags:
        """(C,) True for the cells that may be in sight."""
        edges_m = task.row.geometry.cell_edges_m
        inside = cells_in_sight(
            places, request.sight, request.T_map_camera, edges_m=edges_m, range_max_m=request.range_m
        )
        if inside.sum() > CELLS_IN_VIEW_MAX:
            raise BadInputError(
                "too_large", f"{inside.sum()} cells are in sight, {CELLS_IN_VIEW_MAX} at most may be; lower range_m"
            )
        return inside

    def _drawing(self, task: _Task, places: Ints, request: RenderRequest) -> tuple[Drawing, MapRenderer]:
        geometry, model, sight, T = task.row.geometry, task.row.sensor_model, request.sight, request.T_map_camera
        inside = self._inside(task, places, request)
        keys = [key for key, is_inside in zip(task.listed, inside, strict=True) if is_inside]
        kept = {key: self._read_cells.here(task.name_of(key)) for key in keys}
        here = {key: read for key, read in kept.items() if read is not None}
        renderer = MapRenderer(threads=THREADS, on_share=task.check_time)
        drawing = draw_as_needed(
            renderer,
            geometry,
            model,
            here,
            keys,
            lambda wanted: self._read(task, wanted),
            sight=sight,
            T_map_camera=T,
            range_max_m=request.range_m,
        )
        return drawing, renderer

    def _listing(self, snapshot: Snapshot) -> Listing:
        """Cells that hold something, by number, and where they are (C, 3)."""

        def make() -> Listing:
            listed = {cell.key: cell for cell in snapshot.cells() if cell.voxels}
            return listed, np.array([cell_of_key(key) for key in listed], np.int64).reshape(-1, 3)

        return self._lists.get(snapshot.head, make)

    def _read(self, task: _Task, wanted: Sequence[CellKey]) -> dict[CellKey, ReadCell]:
        """Cells from the store, decoded side by side."""
        task.check_time()
        task.count_voxels(wanted)
        stored = {key: row_of_cell(task.snapshot, key) for key in wanted}

        def make(key: CellKey) -> ReadCell:
            return self._read_cells.get(task.name_of(key), lambda: _ready(stored[key], task))

        found: dict[CellKey, ReadCell] = {}
        with ThreadPoolExecutor(THREADS) as pool:
            tries = {key: pool.submit(make, key) for key in wanted}
        for key, made in tries.items():
            try:
                found[key] = made.result()
            except DamagedDataError:
                sound = sound_cell(task.snapshot, key, task.row.layer, task.healed)
                found[key] = _ready(sound, task)
        return found

    def _ages(self, task: _Task, keys: Sequence[CellKey]) -> Ages:
        """Times (UTC seconds) of the last measurement of everything seen; now is the newest one of what is in the map.

        So the picture depends on the map alone. Where a commit states no time, or one was taken out since, the age is
        unknown.
        """
        if task.until_s is not None:
            return _past_ages(task, keys, task.until_s)
        stamps = {key: self._stamps(task, key) for key in keys}
        entries = {int(seq) for each in stamps.values() for seq in np.unique(each)} - {0}
        newest_s = task.snapshot.newest_captured_s()
        times = {seq: self._time_of(task, seq) for seq in sorted(entries)}
        numbers, moments = np.array([0, *times]), np.array([np.nan, *times.values()])
        changes = {key: moments[np.searchsorted(numbers, each)] for key, each in stamps.items()}
        return Ages(changes, now=np.nan if newest_s is None else newest_s)

    def _stamps(self, task: _Task, key: CellKey) -> Stamps:
        """Stamps of a cell; if they are damaged, none, so that its age is unknown."""
        stored, depth = row_of_cell(task.snapshot, key), task.row.geometry.depth
        if stored is None:
            raise DamagedCellError(key, "a cell is listed, but is not there")
        try:
            return decode_stamps(stored.stamps, depth=depth, lm=stored.lm)
        except DamagedDataError as exc:
            log.error("cell %s: %s; its age is unknown", cell_of_key(key), exc.message)
            return no_stamps(depth)

    def _time_of(self, task: _Task, seq: int) -> float:
        """Time of the last scan of an entry's commit; NaN where it states none, or the entry takes it out."""
        chain = task.snapshot.chain_at(seq) or b""
        known = self._times.get(chain)
        if known is not None:
            return known
        task.check_time()
        entries = task.snapshot.log(after_seq=seq - 1, limit=1)
        captured_s = entries[0].captured_s if entries and entries[0].kind == "+" else None
        time_s = captured_s[1] if captured_s else np.nan
        if len(self._times) >= TIMES_MAX:
            self._times.clear()  # another picture may look at the same time
        self._times[chain] = time_s
        return time_s


def _get_ready() -> None:
    """Load the kernels that draw, or compile them, which takes a minute the first time and counts for no picture.

    Raises:
        UnreachableError: kind `busy`: another request is at it.
    """
    if not _loading.acquire(timeout=WAIT_S):
        raise UnreachableError("busy", "the code that draws is being compiled", retry_after_s=5.0)
    try:
        _loaded()
    finally:
        _loading.release()


@cache
def _loaded() -> None:
    warm_up_pictures()


_loading = threading.Lock()


def _read_of(layer: Layer) -> Layer:
    """The layer whose values are taken from cells' sums: of depths and ages, none, as for depths."""
    return Layer.DEPTH if layer is Layer.AGE else layer


def _cells_seen(keys: Sequence[CellKey], seen: SurfaceImage) -> list[CellKey]:
    """Cells of which a pixel shows something; `keys`: by slot."""
    return [keys[slot] for slot in np.unique(seen.slots[seen.hit]).tolist()]


def _past_ages(task: _Task, keys: Sequence[CellKey], until_s: float) -> Ages:
    """Times of the last measurement, until a time, of everything seen; now is that time."""
    changes = {}
    for key in keys:
        task.check_time()
        stored = sound_cell(task.snapshot, key, task.row.layer, task.healed)
        if stored is None:
            raise DamagedCellError(key, "a cell is listed, but is not there")
        with DECODING.of_cell(task.row.geometry, stored.voxels):
            changes[key] = past_times_s(task.snapshot, stored, task.row, until_s)
    return Ages(changes, now=until_s)


def _ready(stored: CellRow | None, task: _Task) -> ReadCell:
    """A stored cell, checked and ready to be drawn."""
    geometry, model = task.row.geometry, task.row.sensor_model
    with DECODING.of_cell(geometry, 0 if stored is None else stored.voxels):
        evidence = _evidence(stored, task)
        is_sum = evidence.odds is None
        cell = brick_cell(geometry, [evidence]) if is_sum else reading_cell(geometry, evidence, model)
        return read_cell(cell, geometry, model, task.layer)


def _surfaces(task: _Task, key: CellKey) -> GroundCell:
    """Surfaces and obstacles of a level's stored cell."""
    stored = sound_cell(task.snapshot, key, task.row.layer, task.healed)
    with DECODING.of_cell(task.row.geometry, task.listed[key].voxels):
        return ground_cell(_evidence(stored, task), key, task.row.geometry, task.row.sensor_model)


def _evidence(stored: CellRow | None, task: _Task) -> Evidence:
    """A stored cell as it reads at the picture's time.

    Raises:
        DamagedDataError: kind `damaged_store`.
    """
    if stored is None:
        raise DamagedDataError("damaged_store", "a cell is listed, but is not there")
    with DECODING.of_cell(task.row.geometry, stored.voxels):
        if task.until_s is None:
            return stored_reading(stored, task.row)
        return past_reading(task.snapshot, stored, task.row, task.until_s)


def _etag(head: Cursor, request: RenderRequest) -> str:
    """Strong: the same map and the same request give the same bytes."""
    text = f"{VERSION} {head} {request.model_dump_json(exclude={'at'})}" + (f" {request.at}" if request.at else "")
    return f'"{hashlib.sha256(text.encode()).hexdigest()[:32]}"'
