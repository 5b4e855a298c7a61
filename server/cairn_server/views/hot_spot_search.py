"""Search for the hot spots of a map, which reads only cells that changed since the last one.

    cell, by its digest                  -->  its warm pieces and its floors, kept: some kilobytes
    cell and log entry that changed it   -->  who measured its hottest voxels, kept
    pieces of all cells that are warm    -->  spots, joined for each answer

Cells whose hottest voxel is below the threshold are not read, but for those below a spot, in which its floor may be.
"""

import math
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from cairn_map.arrays import Int32s
from cairn_map.commits.cursor import ENTRY_FOLD
from cairn_map.commits.ids import CommitId
from cairn_map.errors import BadInputError, DamagedDataError
from cairn_map.evidence.channels import ChannelKind
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.grid import Cell, CellKey, cell_key, centres_of_voxels, check_cubes, split_voxels
from cairn_map.files.export_request import ExportRequest
from cairn_map.queries.hot_spots import (
    WARM_K,
    CellPieces,
    Spots,
    cells_over_floor,
    joined_spots,
    over_floor_m,
    pieces_of_cell,
    ranked_spots,
)
from cairn_map.queries.point_queries import first_of_kind
from cairn_map.wire.hot_spot_messages import HotSpotEntry, HotSpotsAnswer
from cairn_server.access.cancellation import CANCELLATION
from cairn_server.cell_room import DECODING, voxels_of
from cairn_server.folding.cells import CellFaults, Cells
from cairn_server.folding.cells_at_rest import DamagedCellError, decode_stored, row_of_cell, sound_cell
from cairn_server.folding.read_cache import State, state_of
from cairn_server.folding.single_flight import MadeOnce
from cairn_server.store.store import Snapshot, Store
from cairn_server.store.store_rows import CellRow, MapRow
from cairn_server.views.cell_views import style_digest
from cairn_server.views.hottest_search import ZERO_CELSIUS_K
from cairn_server.views.readings import stored_surface_reading

SEARCH_S = 1.0
"""Time of one answer: it has the hottest first, and who asks again gets the rest, since what was read is kept."""
WITNESS_S = 0.4
"""Time in an answer for who measured its spots: a diff is decoded in some 5 ms; the next answer has more of them."""
PIECES_BYTES = 40 << 20
"""Memory for the pieces of cells of all maps, some 3 kB for a cell; and most that one search holds."""
WITNESSES_BYTES = 8 << 20
WITNESS_BYTES = 400
"""Memory of one witness."""
ENTRIES_MAX = 32
"""Most of a cell's newest log entries of which the evidence is looked at."""


@dataclass(frozen=True, slots=True)
class Witness:
    """Newest commit with samples of a voxel."""

    commit: CommitId
    captured_s: tuple[float, float] | None


Witnesses = Mapping[int, Witness]
"""By place of a voxel in its cell; those that no commit is known of are left out."""


class HotSpotSearch:
    """Searches for hot spots in the maps of a store; thread-safe."""

    def __init__(self, store: Store, cells: Cells, *, cache_share: float = 1.0) -> None:
        """Search with caches of this part of their standard sizes."""
        self._store = store
        self._cells = cells
        self._pieces: MadeOnce[tuple[str, bytes, CellKey, float], CellPieces] = MadeOnce(
            limit_bytes=int(cache_share * PIECES_BYTES), size_of=lambda cell: cell.size_bytes + 500, idle_s=math.inf
        )
        self._witnesses: MadeOnce[tuple[State, tuple[int, ...]], Witnesses] = MadeOnce(
            limit_bytes=int(cache_share * WITNESSES_BYTES),
            size_of=lambda found: WITNESS_BYTES * (1 + len(found)),
            idle_s=math.inf,
        )

    def prepare(self, row: MapRow, stored: CellRow, evidence: Evidence) -> None:
        """Make what the standard threshold takes of a cell that was read for something else; surfaces suffice."""
        if stored.hottest_k is not None and stored.hottest_k >= WARM_K:
            name = style_digest(row), stored.digest, stored.key, WARM_K
            self._pieces.get(name, lambda: pieces_of_cell(stored.key, evidence, row.geometry, row.sensor_model, WARM_K))

    def asked(self, row: MapRow, *, over_k: float, voxels_min: int, count: int, box: str | None) -> HotSpotsAnswer:
        """The hot spots of a map, at most `count`; with a box of those whose hottest voxel's centre lies in it.

        Raises:
            BadInputError: kind `bad_box`; `unknown_channel`: the map has no temperatures; `too_costly`: too much of
                it is above the threshold; `level_layer`.
            DamagedCellError: kind `damaged_store`: a cell is damaged.
        """
        check_cubes(row.geometry)
        first_of_kind(row.geometry, ChannelKind.TEMPERATURE)
        box_m = ExportRequest(box=box).bounds_m()
        with self._cells.reading(row) as faults, self._store.snapshot(row) as snapshot:
            listed = {cell.key: cell for cell in snapshot.cells() if cell.voxels}
            search = _Search(
                snapshot, row, over_k, listed, faults, self._pieces, self._witnesses, time.monotonic() + SEARCH_S
            )
            is_whole = search.run()
            spots = ranked_spots(joined_spots(search.found.values()), row.geometry, voxels_min=voxels_min, box_m=box_m)
            return HotSpotsAnswer(
                cursor=str(snapshot.head),
                over_k=over_k,
                complete=is_whole,
                total=len(spots),
                spots=search.described(spots.rows(np.arange(min(count, len(spots))))),
                read=search.read,
            )


@dataclass(slots=True)
class _Search:
    """One search under way."""

    snapshot: Snapshot
    row: MapRow
    over_k: float
    listed: Mapping[CellKey, CellRow]
    """Cells of the snapshot that hold something."""
    faults: CellFaults
    pieces: MadeOnce[tuple[str, bytes, CellKey, float], CellPieces]
    witnesses: MadeOnce[tuple[State, tuple[int, ...]], Witnesses]
    end_s: float
    """Steady time at which it ends."""
    found: dict[CellKey, CellPieces] = field(default_factory=dict)
    """Pieces of the cells that were looked at."""
    read: int = 0
    """Cells that had to be read."""

    def run(self) -> bool:
        """Look at all cells that are warm, the hottest first; False if the time did not suffice.

        Raises:
            BadInputError: kind `too_costly`.
        """
        size_bytes = 0
        warm = [(cell.hottest_k, key) for key, cell in self.listed.items() if cell.hottest_k is not None]
        for kelvin, key in sorted(warm, reverse=True):
            if kelvin < self.over_k:
                return True
            if time.monotonic() > self.end_s:
                return False
            self.found[key] = self._of_cell(key)
            size_bytes += self.found[key].size_bytes
            if size_bytes > PIECES_BYTES:
                raise BadInputError(
                    "too_costly",
                    f"too much of the map is warmer than {self.over_k:g} K: ask for a higher temperature",
                )
        return True

    def described(self, spots: Spots) -> list[HotSpotEntry]:
        """Spots as an answer has them, with their heights over the floor and who measured them."""
        geometry = self.row.geometry
        seen, heights = self._seen(spots), self._heights(spots)
        points = np.round(centres_of_voxels(spots.peaks, geometry), 6).tolist()
        low_m = np.round(spots.low * geometry.voxel_edge_um / 1e6, 6).tolist()
        high_m = np.round((spots.high + 1) * geometry.voxel_edge_um / 1e6, 6).tolist()
        told = []
        for n, confirmed in enumerate(spots.confirmed.tolist()):
            hits, misses = spots.counts[n].tolist()
            kelvin, measured_s = float(spots.kelvin[n]), float(spots.measured_s[n])
            told.append(
                HotSpotEntry(
                    voxel=tuple(spots.peaks[n].tolist()),
                    point_m=tuple(points[n]),
                    kelvin=round(kelvin, 3),
                    celsius=round(kelvin - ZERO_CELSIUS_K, 2),
                    sigma=round(float(spots.sigma[n]), 4),
                    weight=int(spots.weight[n]),
                    hits=hits,
                    misses=misses,
                    confirmed=confirmed,
                    voxels=int(spots.voxels[n]),
                    low_m=tuple(low_m[n]),
                    high_m=tuple(high_m[n]),
                    over_floor_m=heights[n],
                    measured_s=None if math.isnan(measured_s) else measured_s,
                    commit=str(seen[n].commit) if n in seen else None,
                    captured_s=seen[n].captured_s if n in seen else None,
                )
            )
        return told

    def _of_cell(self, key: CellKey) -> CellPieces:
        """Pieces of a listed cell."""
        CANCELLATION.get().check()
        row = self.row
        name = style_digest(row), self.listed[key].digest, key, self.over_k

        def make() -> CellPieces:
            self.read += 1
            with DECODING.of_cell(row.geometry, self.listed[key].voxels):
                # A damaged cell is rebuilt from the log.
                try:
                    surfaces = stored_surface_reading(self._stored(key), row)
                except DamagedDataError:
                    surfaces = stored_surface_reading(self._rebuilt(key), row)
                return pieces_of_cell(key, surfaces, row.geometry, row.sensor_model, self.over_k)

        return self.pieces.get(name, make)

    def _stored(self, key: CellKey) -> CellRow:
        """A listed cell as it is at rest."""
        stored = row_of_cell(self.snapshot, key)
        if stored is None:
            raise DamagedCellError(key, "a cell is listed, but is not there")
        return stored

    def _rebuilt(self, key: CellKey) -> CellRow:
        """A damaged cell, made again from the log."""
        rebuilt = sound_cell(self.snapshot, key, self.row.layer, self.faults.healed)
        if rebuilt is None:
            raise DamagedCellError(key, "a cell is listed, but is not there")
        return rebuilt

    def _heights(self, spots: Spots) -> list[float | None]:
        """Height of each spot's hottest voxel over the floor."""
        surfaces: dict[Cell, Int32s] = {}
        peaks = [(x, y, z) for x, y, z in spots.peaks.tolist()]
        for peak in peaks:
            for cell in cells_over_floor(peak, self.row.geometry):
                if cell in surfaces or (key := cell_key(cell)) not in self.listed:
                    continue
                if key in self.found or time.monotonic() < self.end_s:
                    surfaces[cell] = (self.found.get(key) or self._of_cell(key)).surfaces
        return [over_floor_m(peak, surfaces, self.row.geometry) for peak in peaks]

    def _seen(self, spots: Spots) -> dict[int, Witness]:
        """Witnesses of spots, by row, of the first cells as far as the time goes."""
        keys, places = split_voxels(spots.peaks, self.row.geometry)
        end_s = time.monotonic() + WITNESS_S
        seen: dict[int, Witness] = {}
        for key in dict.fromkeys(keys.tolist()):
            rows = np.nonzero(keys == key)[0].tolist()
            wanted = tuple(sorted(int(places[n]) for n in rows))
            listed = self.listed[CellKey(key)]
            name = state_of(self.snapshot, listed), wanted
            found = self.witnesses.here(name)
            if found is None:
                if time.monotonic() > end_s:
                    continue
                found = self.witnesses.get(name, partial(self._witnesses, listed, wanted))
            seen |= {n: found[int(places[n])] for n in rows if int(places[n]) in found}
        return seen

    def _witnesses(self, listed: CellRow, places: Iterable[int]) -> Witnesses:
        """Newest commits of a cell that have samples of these voxels and were not taken out."""
        folded: dict[CommitId, int] = {}
        for entry in self.snapshot.contributions(listed.key, after_seq=0, newest=ENTRIES_MAX):
            if entry.kind == ENTRY_FOLD:
                folded[entry.commit] = entry.seq
            else:
                folded.pop(entry.commit, None)
        missing, found = set(places), dict[int, Witness]()
        channel = first_of_kind(self.row.geometry, ChannelKind.TEMPERATURE)
        weight = self.row.geometry.planes_of(channel.name).stop - 1
        for commit, seq in sorted(folded.items(), key=lambda each: -each[1]):
            body = self.snapshot.diff(commit, listed.key) if missing else None
            if body is None:
                # Evidence that is not kept is the newest of those after it, too.
                return found
            with DECODING.of_cell(self.row.geometry, voxels_of(body)):
                evidence = decode_stored(listed.key, body).evidence
            measured = evidence.voxels[evidence.sampled[evidence.samples[:, weight] > 0]]
            here = missing & set(measured[np.isin(measured, list(missing))].tolist())
            (said,) = self.snapshot.log(after_seq=seq - 1, limit=1)
            found |= dict.fromkeys(here, Witness(commit, said.captured_s))
            missing -= here
        return found
