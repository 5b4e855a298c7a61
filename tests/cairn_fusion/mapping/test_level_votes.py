"""Votes for heights: one a column and surface, the same whatever the order, equal to a slow obvious twin."""

import math
from itertools import groupby

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.fixtures.client.robot_program import INTEGRATOR, RIG, scan_of

from cairn_fusion.mapping.integrate import Integration, integrate_scan, integrate_scans
from cairn_fusion.mapping.level.vote_kernels import CROSSED_BINS, TALL_BINS
from cairn_fusion.mapping.level.votes import GAP_M, votes_of
from cairn_map.errors import BadInputError
from cairn_map.evidence.channels import COLOUR, HEIGHT_OFFSET
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.evidence_map import EvidenceMap
from cairn_map.evidence.grid import CellKey, level_geometry, voxels_in_cell, voxels_of_points

LEVEL = level_geometry()
ORIGIN = np.array([0.03, -0.02, 1.5])
Seen = dict[tuple[int, int, int], tuple[int, int, int | None]]
"""By voxel: hits, misses, offset of its vote in 5 mm."""


def seen_in(diff: dict[CellKey, Evidence]) -> Seen:
    found: Seen = {}
    for key, evidence in diff.items():
        numbers = voxels_in_cell(evidence.voxels, key, LEVEL).tolist()
        votes = {int(row): sums for row, sums in zip(evidence.sampled, evidence.samples.tolist(), strict=True)}
        for n, (x, y, z) in enumerate(numbers):
            offset, weight = votes.get(n, (None, 1))
            assert weight == 1
            found[x, y, z] = (*evidence.counts[n].tolist(), offset)
    return found


def naive_votes(points: np.ndarray) -> Seen:
    """The definition, return by return."""
    found: Seen = {}
    step_nm, gap_nm = 50_000_000, round(GAP_M * 1e9)
    rows = sorted(
        (*voxel, round(point[2] * 1e9), *point)
        for voxel, point in zip(voxels_of_points(points, LEVEL).tolist(), points.tolist(), strict=True)
    )
    for (x, y), column in groupby(rows, key=lambda row: (row[0], row[1])):
        column = sorted(column, key=lambda row: row[3])
        heights = [row[3] for row in column]
        lowest, surfaces = heights[0] // step_nm, [[heights[0]]]
        for height in heights[1:]:
            if height - surfaces[-1][-1] < gap_nm:
                surfaces[-1].append(height)
            else:
                surfaces.append([height])
        crossed = set()
        for _, _, bin_, _, px, py, pz in column:
            shares = [1.0]
            for own, origin, number in ((px, ORIGIN[0], x), (py, ORIGIN[1], y)):
                if origin != own:
                    border = (number + 1 if origin > own else number) * 0.2 - own
                    shares.append(max(border / (origin - own), 0.0))
            entry = math.floor((pz + min(shares) * (ORIGIN[2] - pz)) / 0.05)
            crossed |= set(range(bin_ + 1, entry + 1)) | set(range(entry, bin_))
        returned = {row[2] for row in column}
        for surface in surfaces:
            near = [height for height in surface if height - surface[0] < step_nm]
            vote = surface[0] + sum(height - surface[0] for height in near) // len(near)
            own, top = vote // step_nm, surface[-1] // step_nm
            found[x, y, own] = (1, 0, (vote - own * step_nm + 2_500_000) // 5_000_000)
            if top - own > TALL_BINS:
                found[x, y, top] = (1, 0, None)
        for each in {each for each in crossed - returned if each < max(returned)}:
            if TALL_BINS < each - lowest < CROSSED_BINS:
                found.setdefault((x, y, each), (0, 1, None))
    return found


@settings(deadline=None)  # the first call compiles
@given(seed=st.integers(0, 1 << 32), spread_m=st.sampled_from([0.02, 0.3, 2.0]))
def test_votes_are_those_of_the_definition_in_any_order(seed: int, spread_m: float) -> None:
    rng = np.random.default_rng(seed)
    points = np.concatenate(
        [rng.uniform(-1.0, 1.0, (40, 3)) * (1, 1, spread_m), rng.uniform(-0.3, 0.3, (30, 3)) * (1, 1, 20 * spread_m)]
    )
    expected = naive_votes(points)
    assert seen_in(votes_of(ORIGIN, points, LEVEL)) == expected
    assert seen_in(votes_of(ORIGIN, rng.permutation(points), LEVEL)) == expected


def test_a_bridge_and_the_road_below_both_vote() -> None:
    x, y = (each.ravel() for each in np.meshgrid(np.arange(3, 4, 0.03), np.arange(0, 1, 0.03)))
    road, deck = (np.stack([x, y, np.full(x.size, z)], axis=1) for z in (0.02, 3.22))
    votes = {
        voxel: seen
        for voxel, seen in seen_in(votes_of(ORIGIN, np.concatenate([road, deck]), LEVEL)).items()
        if seen[2] is not None
    }
    assert {voxel[2] for voxel in votes} == {0, 64}
    assert {seen[2] for seen in votes.values()} == {4}


def test_a_wall_votes_at_its_foot_and_its_top_is_hit() -> None:
    wall = np.array([[2.05, 0.05, z] for z in np.arange(0.01, 2.0, 0.1)])
    assert {voxel: seen for voxel, seen in seen_in(votes_of(ORIGIN, wall, LEVEL)).items() if seen[0]} == {
        (10, 0, 0): (1, 0, 2),
        (10, 0, 38): (1, 0, None),
    }


def test_cameras_and_sweeps_vote_once_a_scan_in_any_number_of_threads() -> None:
    scans = [scan_of(seed) for seed in range(6)]
    total = EvidenceMap(LEVEL)
    for scan in scans[::-1]:
        diff = integrate_scan(scan, RIG, LEVEL, integrator=INTEGRATOR)
        assert all((evidence.counts.sum(axis=1) == 1).all() for evidence in diff.values())
        total.merge(diff)
    together = EvidenceMap(LEVEL)
    together.merge(integrate_scans(scans, RIG, LEVEL, integrator=INTEGRATOR, threads=2))
    assert together == total
    sweep = Integration(RIG, LEVEL, INTEGRATOR)
    points = np.array([[1.0, 0.2, -0.4], [np.nan, 0, 0], [0.01, 0, 0], [1.02, 0.2, -0.41]])
    sweep.add_points(points, np.eye(4))
    assert {seen[2] for seen in seen_in(sweep.diff()).values() if seen[0]} == {9}
    assert (sweep.counts.used, sweep.counts.no_return, sweep.counts.too_near) == (2, 1, 1)


def test_nothing_votes_for_nothing_and_far_points_are_refused() -> None:
    assert votes_of(ORIGIN, np.empty((0, 3)), LEVEL) == {}
    with pytest.raises(BadInputError, match="within"):
        votes_of(ORIGIN, np.array([[0.0, 0.0, 1e9]]), LEVEL)


def test_other_channels_of_a_level_get_no_samples() -> None:
    coloured = LEVEL.model_copy(update={"channels": (COLOUR, HEIGHT_OFFSET)})
    for evidence in votes_of(ORIGIN, np.array([[1.0, 1.0, 0.02]]), coloured).values():
        assert evidence.samples.tolist() == [[0, 0, 0, 0, 4, 1]]
