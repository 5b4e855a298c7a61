"""A level's cell as it is drawn: one voxel a surface, which the elevation has, too; obstacles; nothing that few saw."""

import numpy as np
import pytest
from tests.naive.evidence import deinterleave, interleave

from cairn_map.codec.view_code import decode_view, encode_view
from cairn_map.evidence.channels import HEIGHT_OFFSET
from cairn_map.evidence.evidence import Evidence, packed_evidence
from cairn_map.evidence.evidence_map import EvidenceMap
from cairn_map.evidence.grid import Geometry, cell_key
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_map.evidence.view import HEIGHT_RESOLUTION_M, ViewStyle
from cairn_map.queries.level.shown_surfaces import shown_surfaces
from cairn_map.queries.map_snapshot import snapshot_of

LEVEL = Geometry(voxel_edge_um=200_000, height_step_um=50_000, depth=4, channels=(HEIGHT_OFFSET,))
MODEL = SensorModel()
KEY = cell_key((0, 0, 0))
Row = tuple[tuple[int, int, int], int, int, int]
"""Voxel, hits, votes, and sum of their heights over its lower face, in steps of 5 mm."""


def evidence_of(rows: list[Row]) -> Evidence:
    places = np.array([interleave(*number) for number, *_ in rows], np.uint32)
    sums = np.array([[hits, 0, total, votes] for _, hits, votes, total in rows])
    return packed_evidence(places, sums[:, :2], sums[:, 2:], LEVEL)


def shown(rows: list[Row]) -> dict[tuple[int, int, int], float | None]:
    """Height in bins of each voxel that is drawn; None for an obstacle."""
    found = shown_surfaces(evidence_of(rows), LEVEL, MODEL)
    heights: dict[int, float | None] = dict.fromkeys(range(len(found)))
    for row, (total, votes) in zip(found.sampled.tolist(), found.samples.tolist(), strict=True):
        heights[row] = int(deinterleave(int(found.voxels[row]))[2]) + total / votes / 10
    return {deinterleave(int(found.voxels[row])): height for row, height in heights.items()}


def test_votes_of_three_bins_are_one_surface_with_their_mean() -> None:
    rows: list[Row] = [((1, 2, 5), 4, 4, 20), ((1, 2, 6), 4, 4, 0), ((1, 2, 7), 8, 8, 16)]
    assert shown(rows) == {(1, 2, 5): pytest.approx((4 * 5.5 + 4 * 6 + 8 * 7.2) / 16, abs=0.01)}


def test_a_bridge_stays_over_its_road_and_what_few_saw_does_not() -> None:
    rows: list[Row] = [
        ((0, 0, 1), 10, 10, 50),
        ((0, 0, 8), 1, 1, 5),
        ((0, 0, 12), 30, 30, 30),
        ((0, 1, 3), 1, 1, 5),
        ((0, 2, 3), 9, 9, 0),
        ((0, 2, 7), 9, 0, 0),
        ((0, 2, 11), 1, 0, 0),
    ]
    assert shown(rows) == {(0, 0, 1): 1.5, (0, 0, 12): 12.1, (0, 2, 3): 3.0, (0, 2, 7): None}


def test_the_lowest_surfaces_are_those_of_the_elevation() -> None:
    rng = np.random.default_rng(5)
    rows: list[Row] = []
    for number in {tuple(each) for each in rng.integers(0, 16, (1500, 3)).tolist()}:
        votes = int(rng.integers(0, 9))
        total = int(rng.integers(0, 10 * votes)) if votes else 0
        rows.append(((number[0], number[1], number[2]), max(votes, 1), votes, total))
    whole = EvidenceMap(LEVEL)
    whole.merge({KEY: evidence_of(rows)})
    ground = snapshot_of(whole).elevation(box_m=[[0, 0, 0], [3.199, 3.199, 0.799]])
    lowest: dict[tuple[int, int], float] = {}
    for (x, y, _), height in shown(rows).items():
        if height is not None:
            lowest[x, y] = min(height, lowest.get((x, y), np.inf))
    known = {(int(x), int(y)) for y, x in np.argwhere(np.isfinite(ground.height_m))}
    assert {*lowest} == known
    assert len(known) > 150
    for (x, y), bins in lowest.items():
        # Sums of heights are in steps of 5 mm.
        assert bins * 0.05 == pytest.approx(ground.height_m[y, x], abs=1e-9)


@pytest.mark.parametrize("depth", [4, 2])
def test_a_page_s_view_has_heights_over_the_nodes_lower_faces(depth: int) -> None:
    rows: list[Row] = [((1, 2, 5), 4, 4, 20), ((2, 2, 6), 4, 4, 0)]
    evidence = shown_surfaces(evidence_of(rows), LEVEL, MODEL)
    style = ViewStyle(depth, is_for_page=True, scalar_step=HEIGHT_RESOLUTION_M)
    view = decode_view(encode_view(KEY, evidence, LEVEL, MODEL, style=style)).view
    found = {
        deinterleave(int(view.nodes[row])): steps
        for row, steps in zip(view.scalar_rows, view.scalar_steps.tolist(), strict=True)
    }
    bins = {4: {(1, 2, 5): [25], (2, 2, 6): [0]}, 2: {(0, 0, 1): [(75 + 100) / 2, 100]}}
    assert {node: pytest.approx(steps, abs=1) for node, steps in bins[depth].items()} == found
    # Exports and robots get views without them.
    plain = decode_view(encode_view(KEY, evidence, LEVEL, MODEL, style=ViewStyle(depth))).view
    assert not len(plain.scalar_rows)


def test_air_changes_no_surface_in_another_column() -> None:
    """Bins of 12 mm are no whole number of steps; a view is made with the air of a cell, and without it."""
    rng = np.random.default_rng(3)
    places = np.unique(rng.integers(1, 8**LEVEL.depth, 300)).astype(np.uint32)
    sums = np.stack([np.full(len(places), 3), np.full(len(places), 2)], axis=1)
    counts = np.tile([2, 0], (len(places), 1))
    fine = LEVEL.model_copy(update={"height_step_um": 12_000})
    alone = packed_evidence(places, counts, sums, fine)
    with_air = packed_evidence(
        np.insert(places, 0, 0), np.insert(counts, 0, [0, 1], axis=0), np.insert(sums, 0, [0, 0], axis=0), fine
    )
    expected, found = shown_surfaces(alone, fine, MODEL), shown_surfaces(with_air, fine, MODEL)
    np.testing.assert_array_equal(found.voxels, expected.voxels)
    np.testing.assert_array_equal(found.samples, expected.samples)


def test_nothing_is_shown_of_nothing() -> None:
    none = evidence_of([((0, 0, 0), 1, 0, 0)]).where(np.zeros(1, np.bool_))
    assert len(shown_surfaces(none, LEVEL, MODEL)) == 0
    assert shown([((0, 0, 0), 1, 0, 0)]) == {}
