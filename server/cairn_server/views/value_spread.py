"""Spread of a whole map's values: the ends of the page's colour bar, the same for all who look, from all sides.

    cell  -->  voxels in each layer, and in each step of temperature  -->  kept by digest  -->  sums over all cells

A cell takes some 15 ms, most of it to decode, and is counted again only when it changed.
"""

import math
import threading
import time
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cairn_map.arrays import Ints
from cairn_map.evidence.channels import Channel, ChannelKind
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.grid import CellKey, voxels_in_cell
from cairn_map.wire.spread_messages import BINS_MAX, Spread, SpreadAnswer
from cairn_server.cell_room import DECODING
from cairn_server.folding.cells import Cells
from cairn_server.folding.cells_at_rest import DamagedCellError, sound_cell
from cairn_server.store.store import Store
from cairn_server.store.store_rows import MapRow
from cairn_server.views.cell_views import style_digest
from cairn_server.views.readings import stored_surface_reading

STEP_K = 0.25
"""Width of the bins of temperature; cameras are exact to some 2 K."""
COUNT_S = 2.0
"""Time for which one request counts cells; the next one goes on."""
KEPT_BYTES_MAX = 16 << 20
"""Memory for the counts of all cells: some 1 kB a cell."""
NO_COUNTS = np.empty((0, 2), np.int64)


@dataclass(frozen=True, slots=True)
class CellSpread:
    """Counts of the occupied voxels of one cell."""

    layers: Ints
    """(L, 2) layer of the lattice, and voxels in it."""
    heats: Ints
    """(T, 2) bin of temperature, and voxels in it."""
    ends_k: tuple[float, float] | None
    """Lowest and highest mean, K; None: no voxel has one."""

    @property
    def size_bytes(self) -> int:
        """Memory of the arrays, and of what holds them."""
        return self.layers.nbytes + self.heats.nbytes + 400


class ValueSpread:
    """Spreads of the values of a store's maps; thread-safe."""

    def __init__(self, store: Store, cells: Cells) -> None:
        self._store = store
        self._cells = cells
        self._lock = threading.Lock()
        self._counting = threading.Lock()
        self._kept: OrderedDict[tuple[str, bytes, CellKey], CellSpread] = OrderedDict()
        self._kept_bytes = 0
        self.counted = 0
        """Count of the cells that were decoded."""

    def asked(self, row: MapRow) -> SpreadAnswer:
        """Spread of a map's values as it is now; while another request counts cells, of those that are counted.

        Raises:
            DamagedCellError: kind `damaged_store`: a cell is damaged.
        """
        if not self._counting.acquire(blocking=False):
            return self._answer(row, -math.inf)
        try:
            return self._answer(row, time.monotonic() + COUNT_S)
        finally:
            self._counting.release()

    def _answer(self, row: MapRow, end_s: float) -> SpreadAnswer:
        """Sums over all cells, of which those that are not counted yet are until a steady time."""
        found: list[CellSpread] = []
        is_complete = True
        style, channel = style_digest(row), _temperature(row)
        with self._cells.reading(row) as faults, self._store.snapshot(row) as snapshot:
            for listed in snapshot.cells():
                if not listed.voxels:
                    continue
                name = style, listed.digest, listed.key
                known = self._ready(name)
                if known is None and time.monotonic() > end_s:
                    is_complete = False
                    continue
                if known is None:
                    stored = sound_cell(snapshot, listed.key, row.layer, faults.healed)
                    if stored is None:
                        raise DamagedCellError(listed.key, "a cell is listed, but is not there")
                    with DECODING.of_cell(row.geometry, stored.voxels):
                        known = cell_spread(listed.key, stored_surface_reading(stored, row), row, channel)
                    self._keep(name, known)
                found.append(known)
            cursor = str(snapshot.head)
        return SpreadAnswer(
            cursor=cursor,
            complete=is_complete,
            cells=len(found),
            height=_heights(found, row.geometry.voxel_height_m),
            temperature=None if channel is None else _temperatures(found, channel.unit),
        )

    def _ready(self, name: tuple[str, bytes, CellKey]) -> CellSpread | None:
        with self._lock:
            found = self._kept.get(name)
            if found is not None:
                self._kept.move_to_end(name)
            return found

    def _keep(self, name: tuple[str, bytes, CellKey], spread: CellSpread) -> None:
        with self._lock:
            self.counted += 1
            if name in self._kept:
                return
            self._kept[name] = spread
            self._kept_bytes += spread.size_bytes
            while self._kept_bytes > KEPT_BYTES_MAX and len(self._kept) > 1:
                self._kept_bytes -= self._kept.popitem(last=False)[1].size_bytes


def cell_spread(key: CellKey, evidence: Evidence, row: MapRow, channel: Channel | None) -> CellSpread:
    """Counts of the occupied voxels of a cell, by layer and by temperature."""
    geometry, seen = row.geometry, evidence.occupied(row.sensor_model)
    layers = _counted(voxels_in_cell(evidence.voxels[seen], key, geometry)[:, 2])
    if channel is None:
        return CellSpread(layers, NO_COUNTS, None)
    sums = evidence.samples[:, geometry.planes_of(channel.name)]
    has_any = seen[evidence.sampled] & (sums[:, -1] > 0)
    if not has_any.any():
        return CellSpread(layers, NO_COUNTS, None)
    kelvin = channel.zero + channel.step * sums[has_any, 0] / sums[has_any, -1]
    ends_k = float(kelvin.min()), float(kelvin.max())
    return CellSpread(layers, _counted(np.floor(kelvin / STEP_K).astype(np.int64)), ends_k)


def _counted(places: Ints) -> Ints:
    """(B, 2) each number, rising, and how often it is there."""
    return np.stack(np.unique(places, return_counts=True), axis=1).astype(np.int64)


def _temperature(row: MapRow) -> Channel | None:
    return next((each for each in row.geometry.channels if each.kind is ChannelKind.TEMPERATURE), None)


def _heights(found: Sequence[CellSpread], height_m: float) -> Spread | None:
    bins = [spread.layers for spread in found if len(spread.layers)]
    if not bins:
        return None
    least = min(int(each[0, 0]) for each in bins)
    most = max(int(each[-1, 0]) for each in bins)
    ends_m = (least + 0.5) * height_m, (most + 0.5) * height_m
    return _spread("m", ends_m, bins, height_m)


def _temperatures(found: Sequence[CellSpread], unit: str) -> Spread | None:
    warm = [spread for spread in found if spread.ends_k is not None]
    if not warm:
        return None
    ends = [spread.ends_k for spread in warm if spread.ends_k is not None]
    ends_k = min(low for low, _ in ends), max(high for _, high in ends)
    return _spread(unit, ends_k, [spread.heats for spread in warm], STEP_K)


def _spread(unit: str, ends: tuple[float, float], bins: Sequence[Ints], step: float) -> Spread:
    """Histogram of counts by number, with steps wide enough for `BINS_MAX` bins."""
    places, counts = np.concatenate(bins).T
    while int(places.max()) - int(places.min()) >= BINS_MAX:
        places, step = places // 2, 2 * step
    first = int(places.min())
    sums = np.bincount(places - first, weights=counts).astype(np.int64)
    return Spread(unit=unit, least=ends[0], most=ends[1], begin=first * step, step=step, counts=[int(n) for n in sums])
