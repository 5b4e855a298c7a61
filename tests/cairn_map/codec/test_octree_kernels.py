"""Kernels of octrees and neighbours against what the words of their docstrings mean, said slowly."""

from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.fixtures.map.made import MIDDLE, PLAIN, SMALL, as_dict, random_evidence, surface_evidence
from tests.naive import evidence as naive_evidence
from tests.naive import octree as naive_octree

from cairn_map.codec.entropy.neighbour_kernels import NONE, STEPS, earlier_rows, index_leaves
from cairn_map.codec.octree.cell_content import content_of
from cairn_map.codec.octree.octree import build_octree
from cairn_map.codec.octree.octree_kernels import leaves_of_rows, list_leaves_into, measure_masks
from cairn_map.evidence.channels import TEMPERATURE
from cairn_map.evidence.evidence import Evidence, packed_evidence
from cairn_map.evidence.grid import Geometry

DEEP = Geometry(depth=6, channels=())
MADE = st.builds(
    lambda seed, geometry, make: (make(seed, geometry), geometry),
    st.integers(0, 10**6),
    st.sampled_from((SMALL, PLAIN, MIDDLE, DEEP)),
    st.sampled_from((random_evidence, lambda seed, geometry: random_evidence(seed, geometry, voxels=600, air=5))),
)
Made = tuple[Evidence, Geometry]


@given(MADE)
def test_leaves_of_rows_are_the_leaves_that_begin_there(made: Made) -> None:
    evidence, geometry = made
    rows = build_octree(evidence, depth=geometry.depth)[1]
    found = leaves_of_rows(rows, evidence.sampled)
    assert found.tolist() == [rows.tolist().index(row) for row in evidence.sampled.tolist()]
    every = leaves_of_rows(rows, rows.astype(np.uint32))
    assert every.tolist() == list(range(len(rows)))
    assert len(leaves_of_rows(rows, np.empty(0, np.uint32))) == 0


@pytest.mark.slow
@given(MADE)
def test_leaves_down_to_any_depth_are_those_of_the_slow_tree(made: Made) -> None:
    evidence, geometry = made
    depth = geometry.depth
    octree, _ = build_octree(evidence, depth=depth)
    root = naive_octree.tree_of(as_dict(evidence), depth)
    for stop in range(1, depth + 1):
        expected = naive_octree.leaves_above(root, depth, stop)
        firsts = np.zeros(depth + 1, np.int64)
        masks, _, leaves = measure_masks(octree.child_masks, octree.leaf_masks, firsts, stop)
        sizes_above = [size for _, size in expected if size > 8 ** (depth - stop)]
        assert masks == firsts[stop] <= len(octree.child_masks)
        assert leaves >= len(sizes_above)
        room = len(expected) + 1
        starts, sizes = np.zeros(room, np.uint32), np.zeros(room, np.int64)
        list_leaves_into(octree.child_masks, octree.leaf_masks, firsts, stop, starts, sizes)
        assert list(zip(starts[:-1].tolist(), sizes[:-1].tolist(), strict=True)) == expected


def test_a_collapsed_leaf_and_an_inner_node_of_one_size_are_told_apart() -> None:
    """`measure_masks` counts leaves alone; where reading stops, inner nodes come on top."""
    evidence = surface_evidence(1, PLAIN)
    octree, _ = build_octree(evidence, depth=3)
    firsts = np.zeros(4, np.int64)
    _, _, leaves = measure_masks(octree.child_masks, octree.leaf_masks, firsts, 2)
    assert leaves == int((octree.sizes >= 8).sum())
    assert 0 < leaves < len(naive_octree.leaves_above(naive_octree.tree_of(as_dict(evidence), 3), 3, 2))


@pytest.mark.slow
@given(MADE)
def test_the_index_of_leaves_finds_who_holds_each_place(made: Made) -> None:
    evidence, geometry = made
    depth = geometry.depth
    octree, _ = build_octree(evidence, depth=depth)
    brick_of, leaf_of = index_leaves(octree.starts, octree.sizes, depth)
    holders: dict[int, int] = {}
    for n, (start, _, _) in enumerate(
        leaves := naive_octree.leaves_of(naive_octree.tree_of(as_dict(evidence), depth), depth)
    ):
        holders |= dict.fromkeys(range(start, start + leaves[n][1]), n)
    found: dict[int, int] = {}
    for brick, table in enumerate(brick_of.tolist()):
        places = range(512 * brick, 512 * brick + 512)
        if table <= -2:
            found |= dict.fromkeys(places, -2 - table)
        elif table != NONE:
            held = zip(places, leaf_of[table].tolist(), strict=True)
            found |= {place: leaf for place, leaf in held if leaf != NONE}
    assert found == holders


@pytest.mark.slow
@given(MADE, st.data())
def test_earlier_rows_are_those_beside_that_come_before(made: Made, data: st.DataObject) -> None:
    evidence, geometry = made
    depth = geometry.depth
    octree, _ = build_octree(evidence, depth=depth)
    voxels = np.nonzero(octree.sizes == 1)[0]
    leaves = voxels[np.random.default_rng(data.draw(st.integers(0, 99))).random(len(voxels)) < 0.7]
    found = earlier_rows(octree.starts, leaves, *index_leaves(octree.starts, octree.sizes, depth), depth)
    row_at = {naive_evidence.deinterleave(start): s for s, start in enumerate(octree.starts[leaves].tolist())}
    for (x, y, z), s in row_at.items():
        rows = [row_at.get((x + i, y + j, z + k), NONE) for i, j, k in STEPS.tolist()]
        assert found[s].tolist() == [row if row < s else NONE for row in rows]


def test_the_steps_are_all_that_can_come_before() -> None:
    """The 13 of 26 neighbours whose Morton number is lower somewhere, and no other."""
    lower = set()
    for corner in product((1, 2, 3, 4), repeat=3):
        for step in product((-1, 0, 1), repeat=3):
            place = tuple(v + d for v, d in zip(corner, step, strict=True))
            if naive_evidence.interleave(*place) < naive_evidence.interleave(*corner):
                lower.add(step)
    assert set(map(tuple, STEPS.tolist())) <= lower
    assert all(sum(abs(d) for d in step) == 3 for step in lower - set(map(tuple, STEPS.tolist())))


@pytest.mark.parametrize("geometry", [SMALL, MIDDLE])
def test_content_of_a_surface_has_its_samples_at_voxels(geometry: Geometry) -> None:
    content = content_of(surface_evidence(1, geometry), geometry)
    assert (content.octree.sizes[content.sampled] == 1).all()


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("depth", [3, 4])
def test_blocks_of_equal_voxels_collapse_as_in_the_slow_tree(depth: int, seed: int) -> None:
    """Nodes of 8, 64 and 512 voxels that are all alike, but for a voxel that is missing, differs or has a sample."""
    rng, geometry = np.random.default_rng(seed), Geometry(depth=depth, channels=(TEMPERATURE,))
    voxels = np.arange(8**depth, dtype=np.uint32)
    blocks = rng.choice([8, 64, 512])
    counts = np.stack([np.zeros(len(voxels)), rng.integers(1, 3, 8**depth)[voxels // blocks]], axis=1).astype(np.int32)
    counts[rng.integers(0, len(voxels), seed)] = 1, 7
    samples = np.zeros((len(voxels), geometry.plane_count), np.int64)
    samples[rng.integers(0, len(voxels), seed // 2)] = 4, 16, 1
    kept = np.sort(rng.permutation(len(voxels))[seed // 3 :])
    evidence = packed_evidence(voxels[kept], counts[kept], samples[kept], geometry)
    octree, rows = build_octree(evidence, depth=depth)
    root = naive_octree.tree_of(as_dict(evidence), depth)
    assert (bytes(octree.child_masks), bytes(octree.leaf_masks)) == naive_octree.masks_of(root, depth)
    found = zip(octree.starts.tolist(), octree.sizes.tolist(), strict=True)
    assert list(found) == [(place, size) for place, size, _ in naive_octree.leaves_of(root, depth)]
    assert evidence.voxels[rows].tolist() == octree.starts.tolist()
