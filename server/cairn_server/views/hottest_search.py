"""Search for the hottest voxels of a map, which reads the hottest cells alone.

Each cell is kept with the temperature of its hottest voxel (`hottest_k`), which bounds all of its voxels. So cells are
read from the hottest one on, and next to them those of their neighbours that matter: a voxel that was hit once counts
as confirmed if it touches a surface. The search ends when as many voxels are confirmed as are asked for, and none of
the cells left could have a hotter one.
"""

import time
from collections import OrderedDict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import product

import numpy as np

from cairn_map.arrays import Flags, Floats, Words32
from cairn_map.evidence.brick_cell import BrickCell, brick_cell, reading_cell
from cairn_map.evidence.channels import Channel, ChannelKind
from cairn_map.evidence.grid import CELL_LIMIT, CellKey, Geometry, cell_key, cell_of_key, split_voxels, voxels_in_cell
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_map.evidence.voxels import Voxels, measured_or_none
from cairn_map.files.export_request import ExportRequest, cell_may_have
from cairn_map.queries.frozen_map import freeze
from cairn_map.queries.point_queries import first_of_kind
from cairn_map.queries.region_queries import ranked_hottest
from cairn_map.wire.hottest_messages import HottestAnswer, HotVoxel
from cairn_server.access.cancellation import CANCELLATION
from cairn_server.cell_room import DECODING
from cairn_server.folding.cells import CellFaults, Cells
from cairn_server.folding.cells_at_rest import DamagedCellError, sound_cell
from cairn_server.store.store import Snapshot, Store
from cairn_server.store.store_rows import CellRow, MapRow
from cairn_server.views.readings import stored_surface_reading

SEARCH_S = 10.0
CELLS_BYTES = 1 << 27
"""Memory for the cells of one search: where a cell and its neighbours take more, it is looked at alone."""
OCCUPIED_FROM = 0.5
"""Least probability of a voxel that counts."""
ZERO_CELSIUS_K = 273.15


class HottestSearch:
    """Searches for the hottest voxels in the maps of a store; thread-safe."""

    def __init__(self, store: Store, cells: Cells) -> None:
        self._store = store
        self._cells = cells

    def asked(self, row: MapRow, count: int, box: str | None) -> HottestAnswer:
        """The hottest voxels of a map; with a box (x0,y0,z0,x1,y1,z1, metres) of those whose centres lie in it.

        Raises:
            BadInputError: kind `bad_box`; `unknown_channel`: the map has no temperatures.
            DamagedCellError: kind `damaged_store`: a cell is damaged.
        """
        channel = first_of_kind(row.geometry, ChannelKind.TEMPERATURE)
        asked = ExportRequest(box=box)
        asked.bounds_m()
        with self._cells.reading(row) as faults, self._store.snapshot(row) as snapshot:
            listed = {cell.key: cell for cell in snapshot.cells() if cell.voxels}
            search = _Search(snapshot, row, asked, count, listed, faults, channel)
            return search.answer(complete=search.run(end_s=time.monotonic() + SEARCH_S))


@dataclass(frozen=True, slots=True)
class _Part:
    """A few cells of a map as a `FreezableMap`; times of sight are not asked for."""

    geometry: Geometry
    cells: Mapping[CellKey, BrickCell]

    def frozen_cells(self, model: SensorModel, /) -> Mapping[CellKey, BrickCell]:
        """The cells, rising in number."""
        return {key: self.cells[key] for key in sorted(self.cells)}

    def frozen_times(self) -> None:
        """None."""


@dataclass(frozen=True, slots=True)
class _HotCell:
    """Voxels of a cell that are occupied or have samples, and the times of these."""

    bricks: BrickCell
    sampled: Words32
    """(S,) voxels that have samples, rising."""
    measured_s: Floats | None
    """(S, C) as in `Evidence`."""

    @property
    def size_bytes(self) -> int:
        times = 0 if self.measured_s is None else self.measured_s.nbytes
        return self.bricks.size_bytes + self.sampled.nbytes + times


@dataclass(slots=True)
class _Search:
    """One search under way."""

    snapshot: Snapshot
    row: MapRow
    asked: ExportRequest
    count: int
    listed: dict[CellKey, CellRow]
    """Cells of the snapshot that hold something."""
    faults: CellFaults
    channel: Channel
    """Channel of the temperatures."""
    kept: OrderedDict[CellKey, _HotCell] = field(default_factory=OrderedDict)
    """Cells that were decoded, those used last at the end."""
    kept_bytes: int = 0
    sure: list[HotVoxel] = field(default_factory=list)
    doubtful: list[HotVoxel] = field(default_factory=list)
    searched: int = 0

    def run(self, *, end_s: float) -> bool:
        """Look at cells from the hottest one on; True once no other one can change the answer."""
        geometry, is_whole = self.row.geometry, True
        hot = [(cell.hottest_k, key) for key, cell in self.listed.items() if cell.hottest_k is not None]
        asked = [(kelvin, key) for kelvin, key in hot if cell_may_have(key, geometry, self.asked)]
        for kelvin, key in sorted(asked, reverse=True):
            if len(self.sure) == self.count and kelvin <= self.sure[-1].mean:
                return is_whole
            if time.monotonic() > end_s:
                return False
            CANCELLATION.get().check()
            is_whole &= self._look(key)
        return is_whole

    def answer(self, *, complete: bool) -> HottestAnswer:
        """All that was found."""
        voxels = [*self.sure, *self.doubtful][: self.count]
        return HottestAnswer(cursor=str(self.snapshot.head), complete=complete, searched=self.searched, voxels=voxels)

    def _look(self, key: CellKey) -> bool:
        """Add the hottest voxels of a cell; False if its neighbours take too much memory, so that some are in doubt."""
        self.searched += 1
        cells = {key: self._cell(key)}
        alone = self._with(key, self._ranked(key, cells))
        # A voxel at the border may touch a surface of the next cell: then it counts before all that are in doubt.
        sure = alone[0]
        wanted = self._beyond_border(key, cells[key].bricks, sure[-1].mean if len(sure) == self.count else -np.inf)
        size_bytes = cells[key].size_bytes
        for each in wanted:
            cell = self._cell(each)
            size_bytes += cell.size_bytes
            if size_bytes > CELLS_BYTES:
                self.sure, self.doubtful = alone
                return False
            cells[each] = cell
        self.sure, self.doubtful = self._with(key, self._ranked(key, cells)) if wanted else alone
        return True

    def _ranked(self, key: CellKey, cells: Mapping[CellKey, _HotCell]) -> tuple[Voxels, Flags]:
        """Hottest voxels of a cell, and which of them are confirmed by what these cells hold."""
        part = _Part(self.row.geometry, {each: cell.bricks for each, cell in cells.items()})
        frozen, box_m = freeze(part, self.row.sensor_model), np.stack(self.asked.bounds_m())
        voxels, are_sure = ranked_hottest(frozen, self.count, min_probability=OCCUPIED_FROM, box_m=box_m, only=key)
        return self._dated(voxels, cells[key]), are_sure

    def _dated(self, voxels: Voxels, cell: _HotCell) -> Voxels:
        """Voxels of a cell with the times of their temperatures, where the map has epochs."""
        if cell.measured_s is None:
            return voxels
        places = np.searchsorted(cell.sampled, split_voxels(voxels.numbers, self.row.geometry)[1])
        measured_s = cell.measured_s[places, self.row.geometry.channels.index(self.channel)]
        name = self.channel.name
        return replace(voxels, readings={name: replace(voxels.readings[name], measured_s=measured_s)})

    def _with(self, key: CellKey, ranked: tuple[Voxels, Flags]) -> tuple[list[HotVoxel], list[HotVoxel]]:
        """The hottest confirmed voxels, and the others, of all cells so far and this one."""
        voxels, are_sure = ranked
        rows = np.nonzero(are_sure)[0], np.nonzero(~are_sure)[0]
        sure = [*self.sure, *_hot_voxels(voxels.rows(rows[0]), key, confirmed=True)]
        doubtful = [*self.doubtful, *_hot_voxels(voxels.rows(rows[1]), key, confirmed=False)]
        first, second = (sorted(some, key=lambda voxel: -voxel.mean)[: self.count] for some in (sure, doubtful))
        return first, second

    def _beyond_border(self, key: CellKey, cell: BrickCell, least_k: float) -> list[CellKey]:
        """Neighbours of the voxels of a cell that were hit once, are hotter than this, and lie at its border."""
        evidence, geometry = cell.packed(), self.row.geometry
        planes = geometry.planes_of(self.channel.name)
        sums = evidence.samples[:, planes]
        weights = np.maximum(sums[:, -1], 1)
        kelvin = self.channel.zero + self.channel.step * sums[:, 0] / weights
        wanted = (sums[:, -1] > 0) & (evidence.counts[evidence.sampled][:, 0] <= 1) & (kelvin > least_k)
        local = voxels_in_cell(evidence.voxels[evidence.sampled[wanted]], key, geometry) % geometry.side
        sides = np.unique((local == geometry.side - 1).astype(np.int64) - (local == 0), axis=0).tolist()
        steps = {step for side in sides for step in product(*({0, each} for each in side)) if any(step)}
        near = (tuple(a + b for a, b in zip(cell_of_key(key), step, strict=True)) for step in sorted(steps))
        inside = ((i, j, k) for i, j, k in near if all(-CELL_LIMIT <= n < CELL_LIMIT for n in (i, j, k)))
        return [found for each in inside if (found := cell_key(each)) in self.listed]

    def _cell(self, key: CellKey) -> _HotCell:
        """Occupied voxels of a cell, and those with samples."""
        if key in self.kept:
            self.kept.move_to_end(key)
            return self.kept[key]
        row = self.row
        stored = sound_cell(self.snapshot, key, row.layer, self.faults.healed)
        if stored is None:
            raise DamagedCellError(key, "a cell is listed, but is not there")
        with DECODING.of_cell(row.geometry, stored.voxels):
            evidence = stored_surface_reading(stored, row)
            keep = evidence.occupied(row.sensor_model)
            keep[evidence.sampled] = True
            evidence = evidence.where(keep)
            if evidence.odds is None:
                bricks = brick_cell(row.geometry, [evidence])
            else:
                bricks = reading_cell(row.geometry, evidence, row.sensor_model)
            made = _HotCell(bricks, evidence.voxels[evidence.sampled], evidence.measured_s)
        self.kept[key] = made
        self.kept_bytes += made.size_bytes
        while self.kept_bytes > CELLS_BYTES and len(self.kept) > 1:
            self.kept_bytes -= self.kept.popitem(last=False)[1].size_bytes
        return made


def _hot_voxels(voxels: Voxels, key: CellKey, *, confirmed: bool) -> Iterator[HotVoxel]:
    reading = voxels.of_kind(ChannelKind.TEMPERATURE)
    assert reading is not None and reading.spread is not None and reading.sigma is not None  # noqa: S101 - was looked up
    for n in range(len(voxels)):
        mean = float(reading.mean[n])
        hits, misses = voxels.counts[n].tolist()
        yield HotVoxel(
            voxel=tuple(voxels.numbers[n].tolist()),
            cell=cell_of_key(key),
            point_m=tuple(np.round(voxels.centres_m[n], 6).tolist()),
            confirmed=confirmed,
            probability=float(voxels.probability[n]),
            hits=hits,
            misses=misses,
            mean=mean,
            unit=reading.channel.unit,
            celsius=round(mean - ZERO_CELSIUS_K, 2),
            weight=int(reading.weight[n]),
            spread=float(reading.spread[n]),
            sigma=float(reading.sigma[n]),
            measured_s=measured_or_none(reading, n),
        )
