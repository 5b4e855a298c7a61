"""Warm-up: every kernel of this package is run once on a few voxels, so that Numba compiles it ahead and caches it.

The kernels are run through the public functions, because a kernel is compiled again for each type of its arguments:
read-only arrays, as decoding gives them, are another type than those that a robot made.
"""

from collections.abc import Mapping
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
from cairn_map.errors import BadInputError
from cairn_map.evidence.brick_cell import brick_cell
from cairn_map.evidence.channels import planes_and_squares
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
from cairn_map.evidence.grid import BRICK_DEPTH, CellKey, Geometry, cell_key, voxels_in_cell
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_map.queries.frozen_map import FreezableMap
from cairn_map.queries.map_snapshot import snapshot_of
from cairn_map.render.camera_rays import look_at, pinhole
from cairn_map.render.map_picture import layer_picture, layer_values
from cairn_map.render.map_render import MapRenderer
from cairn_map.render.partial_map import ReadCell, draw_as_needed, read_cell
from cairn_map.render.pose_spread import PoseSpread
from cairn_map.render.render_kernels import blend_into
from cairn_map.render.render_picture import SCALES, Layer


def warm_up() -> None:
    """Encode, decode, view, merge, take out again and fingerprint a few voxels, with numbers of every size."""
    geometry = Geometry(depth=BRICK_DEPTH)
    key = cell_key((0, 0, 0))
    small, large = _many_voxels(geometry), _two_voxels(geometry, COUNT_MAX)
    made = [small, large, _two_voxels(geometry, 1)]
    modelled = decode_canonical_cell(encode_cell(key, small, geometry, profile=Profile.SMALL).data).evidence
    read = [decode_canonical_cell(encode_cell(key, it, geometry).data).evidence for it in (modelled, *made[1:])]
    for evidence in (*made, *read):
        for held in (small, large):
            cell = brick_cell(geometry, [held])
            for change in (cell.merge, cell.unmerge):
                with suppress(BadInputError):
                    change(evidence)
            cell.packed()
        fingerprint(evidence, key)
        row_fingerprint(evidence, Epoch(0), key, layer_word=0)
        largest(evidence.counts, evidence.samples)
        every_sum_has_weight(evidence.samples, geometry)
        channel_above(evidence.samples, planes_and_squares(geometry.channels), 1)
        voxels_in_cell(evidence.voxels, key, geometry)
        present(cell_history({BASE: evidence}), geometry, SensorModel())
    decode_view(encode_view(key, modelled, geometry, SensorModel()))
    for evidence in made:
        reader = cell_reader(encode_cell(key, evidence, geometry).data)
        _ = reader.octree().brick_count
        for c in range(len(geometry.channels)):
            reader.channel(c)
        reader.bricks(0, 1)
    for evidence in (small, large):
        whole = EvidenceMap(geometry)
        whole.replace(key, evidence)
        _ask(whole)
    for evidence in (*made, *read):
        _ask(_OneReading(evidence, geometry))
    warm_up_pictures()


def warm_up_pictures() -> None:
    """Draw a cell that was read, in every layer, as a server does."""
    geometry, model, key = Geometry(depth=BRICK_DEPTH), SensorModel(), cell_key((0, 0, 0))
    stored = encode_cell(key, _many_voxels(geometry), geometry).data
    whole = brick_cell(geometry, [decode_canonical_cell(stored).evidence])
    for layer in Layer:
        _draw(key, read_cell(whole, geometry, model, layer), geometry, model, layer)


def _draw(key: CellKey, cell: ReadCell, geometry: Geometry, model: SensorModel, layer: Layer) -> None:
    renderer = MapRenderer()
    drawing = draw_as_needed(
        renderer,
        geometry,
        model,
        {},
        [key],
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
        return {cell_key((0, 0, 0)): reading.cell()}

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
    blend_into(np.zeros((1, 3), np.uint8), np.zeros((1, 4), np.uint8), np.zeros((1, 3), np.uint8))


def _many_voxels(geometry: Geometry) -> Evidence:
    """As many as make models pay: profile small falls back to the fast one otherwise."""
    places = np.arange(0, 512, 3, dtype=np.uint32)
    noise = (places * np.uint32(2654435761)) >> np.uint32(20)
    counts = np.stack([places % 2, noise % 5], axis=1).astype(np.int32)
    samples = np.where(places[:, None] % 2 == 1, np.ones(geometry.plane_count, np.int64), 0)
    return packed_evidence(places, counts, samples, geometry)


def _two_voxels(geometry: Geometry, count: int) -> Evidence:
    """A count, and sums as large as they may be."""
    counts = np.array([[0, 1], [count, 0]])
    samples = np.array([[0] * geometry.plane_count, [SUM_MAX] * geometry.plane_count], np.int64)
    return packed_evidence(np.array([0, 511], np.uint32), counts, samples, geometry)
