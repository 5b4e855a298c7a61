"""Warm-up: every kernel of this package is run once on a few voxels, so that Numba compiles it ahead and caches it.

The kernels are run through the public functions, because a kernel is compiled again for each type of its arguments:
read-only arrays, as decoding gives them, are another type than those that a robot made.
"""

import os
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from cairn_map.codec.cell_code import Profile, decode_canonical_cell, encode_cell
from cairn_map.codec.cell_reading import cell_reader
from cairn_map.codec.view_code import decode_view, encode_view
from cairn_map.epochs.cell_history import cell_history, row_fingerprint
from cairn_map.epochs.cell_reading import CellReading
from cairn_map.epochs.epoch import BASE, Epoch
from cairn_map.epochs.present import present
from cairn_map.errors import BadInputError, NotFoundError
from cairn_map.evidence.brick_cell import brick_cell, reading_cell
from cairn_map.evidence.channels import classes_channel, planes_and_squares
from cairn_map.evidence.compact_cell import HeldCell
from cairn_map.evidence.evidence import (
    COUNT_MAX,
    SUM_MAX,
    Evidence,
    every_sum_has_weight,
    largest,
    packed_evidence,
)
from cairn_map.evidence.evidence_kernels import channel_above
from cairn_map.evidence.evidence_map import EvidenceMap
from cairn_map.evidence.fingerprint import fingerprint
from cairn_map.evidence.grid import BRICK_DEPTH, CellKey, Geometry, cell_key, level_geometry, voxels_in_cell
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_map.kernels.numba_runtime import report_compiling
from cairn_map.queries.frozen_map import FreezableMap
from cairn_map.queries.layers.layered_snapshot import LayeredSnapshot
from cairn_map.queries.map_snapshot import snapshot_of
from cairn_map.queries.native.point_handle import PointHandle
from cairn_map.render.camera_rays import look_at, pinhole
from cairn_map.render.ground_picture import ground_cell, ground_columns
from cairn_map.render.map_picture import layer_picture, layer_values
from cairn_map.render.map_render import MapRenderer
from cairn_map.render.partial_map import ReadCell, draw_as_needed, read_cell
from cairn_map.render.pose_spread import PoseSpread
from cairn_map.render.render_kernels import blend_into
from cairn_map.render.render_picture import GROUND_LAYERS, SCALES, Layer

NICE = 10
"""Niceness of the processes that share the warm-up: work that is being done comes first."""
GEOMETRY = Geometry(depth=BRICK_DEPTH)
CLASSED = Geometry(depth=BRICK_DEPTH, channels=(classes_channel(("any",)),))


@dataclass(frozen=True, slots=True)
class _Voxels:
    """Evidence of a few voxels: as a robot makes it, and as it is read, which are different types of arrays."""

    made: list[Evidence]
    """Many voxels; two with numbers as large as they may be; two with small ones."""
    read: list[Evidence]

    @property
    def all(self) -> list[Evidence]:
        return self.made + self.read


def warm_up() -> None:
    """Call every kernel of this package."""
    for part in PARTS.values():
        part()


def warm_up_models() -> None:
    """Encode and decode a few voxels by the models of profile small, and encode what was so read."""
    modelled = decode_canonical_cell(encode_cell(_key(), _many_voxels(), GEOMETRY, profile=Profile.SMALL).data).evidence
    encode_cell(_key(), modelled, GEOMETRY)
    decode_view(encode_view(_key(), modelled, GEOMETRY, SensorModel()))


def warm_up_codec() -> None:
    """Encode a few voxels, and decode them as a whole and in parts, with numbers of every size."""
    for evidence in _voxels().made:
        reader = cell_reader(encode_cell(_key(), evidence, GEOMETRY).data)
        _ = reader.octree().brick_count
        for c in range(len(GEOMETRY.channels)):
            reader.channel(c)
        reader.bricks(0, 1)
    votes = packed_evidence(np.zeros(1, np.uint32), np.ones((1, 2), np.int32), np.ones((1, 2), np.int64), CLASSED)
    cell_reader(encode_cell(_key(), votes, CLASSED).data).channel(0)


def warm_up_sums() -> None:
    """Merge, take out again and fingerprint a few voxels."""
    voxels = _voxels()
    for evidence in voxels.all:
        for held in voxels.made[:2]:
            cell = brick_cell(GEOMETRY, [held])
            for change in (cell.merge, cell.unmerge):
                with suppress(BadInputError):
                    change(evidence)
            cell.packed()
        fingerprint(evidence, _key())
        row_fingerprint(evidence, Epoch(0), _key(), layer_word=0)
        largest(evidence.counts, evidence.samples)
        every_sum_has_weight(evidence.samples, GEOMETRY)
        channel_above(evidence.samples, planes_and_squares(GEOMETRY.channels), 1)
        voxels_in_cell(evidence.voxels, _key(), GEOMETRY)
        for rows in ({BASE: evidence}, {BASE: evidence, Epoch(0): evidence}):
            with suppress(BadInputError):
                present(cell_history(rows), GEOMETRY, SensorModel())


def warm_up_queries() -> None:
    """Ask a map of one cell everything: one of sums, and one of readings."""
    voxels = _voxels()
    for evidence in voxels.made[:2]:
        whole = EvidenceMap(GEOMETRY)
        whole.replace(_key(), evidence)
        _ask(whole)
    for evidence in voxels.all:
        _ask(_OneReading(evidence, GEOMETRY))


def warm_up_pictures() -> None:
    """Draw a cell that was read, in every layer, as a server does: one of sums, and one of a history."""
    model = SensorModel()
    read = decode_canonical_cell(encode_cell(_key(), _many_voxels(), GEOMETRY).data).evidence
    reading = present(cell_history({BASE: read, Epoch(0): read}), GEOMETRY, model).evidence
    for cell in (brick_cell(GEOMETRY, [read]), reading_cell(GEOMETRY, reading, model)):
        for layer in [layer for layer in Layer if layer not in GROUND_LAYERS]:
            _draw(read_cell(cell, GEOMETRY, model, layer), model, layer)
    level = level_geometry()
    voted = packed_evidence(np.zeros(1, np.uint32), np.ones((1, 2), np.int32), np.ones((1, 2), np.int64), level)
    ground = ground_columns({_key(): ground_cell(voted, _key(), level, model)}, level)
    ground.seen(pinhole(4, 4, focal_px=4), look_at((-1, 0.1, 0.1), (0, 0, 0)), range_max_m=2.0)


SERVER_PARTS = {
    "models": warm_up_models,
    "codec": warm_up_codec,
    "sums": warm_up_sums,
    "pictures": warm_up_pictures,
}
"""Parts that a server needs, the longest first (19, 8, 7 and 5 s of a core), so that processes may share them."""
SERVER_KERNELS = 70
"""Kernels that these parts compile, not counting those that others call."""
CHECK_PARTS = ("models", "codec", "sums")
"""Those of them that a check of commits needs."""
PARTS = SERVER_PARTS | {"queries": warm_up_queries}


def _draw(cell: ReadCell, model: SensorModel, layer: Layer) -> None:
    renderer = MapRenderer()
    drawing = draw_as_needed(
        renderer,
        GEOMETRY,
        model,
        {},
        [_key()],
        lambda keys: dict.fromkeys(keys, cell),
        sight=pinhole(4, 4, focal_px=4),
        T_map_camera=look_at((-1, 0.1, 0.1), (0, 0, 0)),
        range_max_m=2.0,
    )
    values = layer_values(renderer, drawing.snapshot, drawing.seen, layer)
    layer_picture(values, drawing.seen, SCALES[layer], PoseSpread.of_sigmas(0.01, 0.01))


@dataclass(frozen=True, slots=True)
class _OneReading:
    """A map of one cell with two rows of the same evidence, of which the newest grows."""

    evidence: Evidence
    geometry: Geometry

    def frozen_cells(self, model: SensorModel) -> Mapping[CellKey, HeldCell]:
        row = brick_cell(self.geometry, [self.evidence])
        rows = {BASE: row.copy(), Epoch(0): row}
        reading = CellReading(self.geometry, model, lambda: rows)
        reading.cell()
        with suppress(BadInputError):
            # One voxel: changes that take more memory than the cell has are dropped, and all rows read again.
            grown = self.evidence.where(np.arange(len(self.evidence)) < 1)
            row.merge(grown)
            reading.note(Epoch(0), grown, 1)
        return {_key(): reading.cell()}

    def frozen_times(self) -> None:
        return None


def _ask(whole: FreezableMap) -> None:
    """Every query of a map of one cell."""
    snapshot = snapshot_of(whole)
    points = np.full((1, 3), snapshot.geometry.voxel_edge_m / 2)
    snapshot.state_at(points)
    snapshot.counts_at(points)
    snapshot.log_odds_at(points)
    snapshot.colour_at(points)
    snapshot.cast_rays(points, np.ones((1, 3)), max_range_m=1)
    snapshot.check_sphere(points, radius_m=0.1)
    snapshot.nearest_occupied(points, radius_m=1)
    snapshot.nearest_unknown(points, radius_m=1)
    snapshot.frontier()
    snapshot.height_map()
    snapshot_of(EvidenceMap(level_geometry())).elevation()
    with suppress(NotFoundError):
        snapshot.grounds()
    snapshot.floor_grid(ground_m=0.0)
    LayeredSnapshot({"fine": snapshot, "coarse": snapshot}).height_map()
    with PointHandle(snapshot) as handle:
        _ = handle.state_address, handle.states_address
    blend_into(np.zeros((1, 3), np.uint8), np.zeros((1, 4), np.uint8), np.zeros((1, 3), np.uint8))


def _key() -> CellKey:
    # Not when the module is imported: it calls a kernel.
    return cell_key((0, 0, 0))


def _voxels() -> _Voxels:
    made = [_many_voxels(), _two_voxels(COUNT_MAX), _two_voxels(1)]
    return _Voxels(made, [decode_canonical_cell(encode_cell(_key(), it, GEOMETRY).data).evidence for it in made])


def _many_voxels() -> Evidence:
    """As many as make models pay: profile small falls back to the fast one otherwise."""
    places = np.arange(0, 512, 3, dtype=np.uint32)
    noise = (places * np.uint32(2654435761)) >> np.uint32(20)
    counts = np.stack([places % 2, noise % 5], axis=1).astype(np.int32)
    samples = np.where(places[:, None] % 2 == 1, np.ones(GEOMETRY.plane_count, np.int64), 0)
    return packed_evidence(places, counts, samples, GEOMETRY)


def _two_voxels(count: int) -> Evidence:
    """A count, and sums as large as they may be."""
    counts = np.array([[0, 1], [count, 0]])
    samples = np.array([[0] * GEOMETRY.plane_count, [SUM_MAX] * GEOMETRY.plane_count], np.int64)
    return packed_evidence(np.array([0, 511], np.uint32), counts, samples, GEOMETRY)


def _say(kernel: str) -> None:
    sys.stdout.write(f"{kernel}\n")
    sys.stdout.flush()


def main(names: Sequence[str]) -> None:
    """Call the parts of these names that standard input says, each by a byte, and print each kernel to be compiled.

    Any number of processes read the same pipe: each takes a part when it has done with the one before.
    """
    os.nice(NICE)
    report_compiling(_say)
    while number := os.read(sys.stdin.fileno(), 1):
        PARTS[names[number[0]]]()


if __name__ == "__main__":
    main(sys.argv[1:])
