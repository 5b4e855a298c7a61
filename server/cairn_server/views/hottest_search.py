"""Search for the hottest voxels of a map, which reads the hottest cells alone.

Each cell is kept with the temperature of its hottest voxel (`hottest_k`), which bounds all of its voxels. So cells are
read from the hottest one on, each with its neighbours, because a voxel that was hit once counts as confirmed if it
touches a surface; and the search ends when as many voxels are confirmed as are asked for, and none of the cells left
could have a hotter one.
"""

import time
from collections import OrderedDict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from itertools import product

import numpy as np

from cairn_map.evidence.brick_cell import BrickCell, brick_cell, reading_cell
from cairn_map.evidence.channels import ChannelKind
from cairn_map.evidence.grid import CELL_LIMIT, CellKey, Geometry, cell_key, cell_of_key
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_map.evidence.voxels import Voxels
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
from cairn_server.views.readings import stored_reading

SEARCH_S = 10.0
VOXELS_MAX = 1 << 20
"""Known voxels of the cells that are in memory at once, some 100 MB: where a cell and its neighbours have more, it is
looked at alone."""
OCCUPIED_FROM = 0.5
"""Least probability of a voxel that counts."""
ZERO_CELSIUS_K = 273.15
AROUND = list(product((-1, 0, 1), repeat=3))


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
        first_of_kind(row.geometry, ChannelKind.TEMPERATURE)
        asked = ExportRequest(box=box)
        asked.bounds_m()
        with self._cells.reading(row) as faults, self._store.snapshot(row) as snapshot:
            listed = {cell.key: cell for cell in snapshot.cells() if cell.voxels}
            search = _Search(snapshot, row, asked, count, listed, faults)
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
    kept: OrderedDict[CellKey, BrickCell] = field(default_factory=OrderedDict)
    """Cells that were decoded, those used last at the end."""
    kept_voxels: int = 0
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
        around = self._around(key)
        is_whole = sum(self.listed[each].voxels for each in around) <= VOXELS_MAX
        part = _Part(self.row.geometry, {each: self._cell(each) for each in (around if is_whole else [key])})
        low, high = self.asked.bounds_m()
        voxels, are_sure = ranked_hottest(
            freeze(part, self.row.sensor_model),
            self.count,
            min_probability=OCCUPIED_FROM,
            box_m=np.stack([low, high]),
            only=key,
        )
        for found, is_sure in ((self.sure, True), (self.doubtful, False)):
            found += _hot_voxels(voxels.rows(np.nonzero(are_sure == is_sure)[0]), key, confirmed=is_sure)
            found.sort(key=lambda voxel: -voxel.mean)
            del found[self.count :]
        self.searched += 1
        return is_whole

    def _around(self, key: CellKey) -> list[CellKey]:
        """A cell and its neighbours that hold something."""
        around = (np.array(cell_of_key(key)) + np.array(AROUND)).tolist()
        inside = (each for each in around if all(-CELL_LIMIT <= n < CELL_LIMIT for n in each))
        return [found for each in inside if (found := cell_key(tuple(each))) in self.listed]

    def _cell(self, key: CellKey) -> BrickCell:
        if key in self.kept:
            self.kept.move_to_end(key)
            return self.kept[key]
        row = self.row
        stored = sound_cell(self.snapshot, key, row.layer, self.faults.healed)
        if stored is None:
            raise DamagedCellError(key, "a cell is listed, but is not there")
        with DECODING.of_cell(row.geometry, stored.voxels):
            evidence = stored_reading(stored, row)
            if evidence.odds is None:
                made = brick_cell(row.geometry, [evidence])
            else:
                made = reading_cell(row.geometry, evidence, row.sensor_model)
        self.kept[key] = made
        self.kept_voxels += self.listed[key].voxels
        while self.kept_voxels > VOXELS_MAX and len(self.kept) > 1:
            self.kept_voxels -= self.listed[self.kept.popitem(last=False)[0]].voxels
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
        )
