"""Evidence while it grows: numbering hits, counting, packing, against a dict; and that culling changes nothing."""

import math
from collections import Counter
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from tests.naive import evidence as naive_evidence

from cairn_calib.rig.camera import Camera
from cairn_calib.rig.poses import look_at
from cairn_calib.rig.rig import Rig, Spectrum, mount_camera
from cairn_fusion.mapping.brick_tally import BrickTally, ScanHits, tally_around
from cairn_fusion.mapping.brick_tally_kernels import hit_voxels
from cairn_fusion.mapping.free_space import Carving, Scratch, carving_of, window_of
from cairn_fusion.mapping.integrate import Integrator, integrate_scan, integrate_scans
from cairn_fusion.recording.scan import Scan
from cairn_map.errors import BadInputError
from cairn_map.evidence.channels import INTENSITY
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.evidence_map import EvidenceMap
from cairn_map.evidence.grid import CellKey, Geometry, voxels_in_cell, voxels_of_points

Voxel = tuple[int, int, int]
GEOMETRY = Geometry(voxel_edge_um=50_000, depth=4, channels=(INTENSITY,))
CAMERA = Camera(width=60, height=44, focal_px=(40.0, 41.0), centre_px=(29.0, 21.2), distortion=(-0.2, 0.05, 1e-3, 0, 0))
RIG = Rig(name="eye", cameras={"tof": mount_camera(Spectrum.RANGE, CAMERA, np.eye(4))})
LIMITS = Integrator(min_range_m=0.3, max_range_m=4.0, flying_step_m=math.inf)


def scan_at(eye: npt.NDArray[np.float64], seed: int) -> Scan:
    """A bumpy surface with steps and holes."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[: CAMERA.height, : CAMERA.width]
    range_m = 2.0 + 0.5 * np.sin(x / 7 + seed) + 0.3 * np.cos(y / 5) + (x > 35) * 0.8
    range_m[rng.random(range_m.shape) < 0.002] = np.nan
    pose = look_at(eye, eye + rng.standard_normal(3))
    return Scan(time_s=float(seed), T_map_rig=pose, range_camera="tof", range_m=range_m.astype(np.float32))


def by_voxel(diff: dict[CellKey, Evidence]) -> dict[Voxel, tuple[int, int, tuple[int, ...]]]:
    found = {}
    for key, evidence in diff.items():
        sums = dict(zip(evidence.sampled.tolist(), evidence.samples.tolist(), strict=True))
        voxels = voxels_in_cell(evidence.voxels, key, GEOMETRY).tolist()
        for n, (voxel, counts) in enumerate(zip(voxels, evidence.counts.tolist(), strict=True)):
            found[tuple(voxel)] = (counts[0], counts[1], tuple(sums.get(n, [0] * GEOMETRY.plane_count)))
    return found


@pytest.mark.parametrize("edge_um", [1_000, 20_000, 48_271, 1_000_000])
def test_a_point_is_in_the_voxel_that_the_format_says_even_on_a_border(edge_um: int) -> None:
    geometry = Geometry(voxel_edge_um=edge_um, depth=4)
    rng = np.random.default_rng(edge_um)
    borders = rng.integers(-500, 500, (3000, 3)) * geometry.voxel_edge_m
    points = np.concatenate([borders, borders + 5e-10, borders - 5e-10, rng.normal(0, 400, (3000, 3)) * edge_um / 1e6])
    corner, dims = np.array([-640, -504, -480]), np.array([158, 126, 130])
    found = hit_voxels(points, edge_um * 1000, corner, dims)
    for voxel, number in zip(voxels_of_points(points, geometry) - corner, found.tolist(), strict=True):
        brick = voxel // 8
        if (brick < 0).any() or (brick >= dims).any():
            assert number == -1
            continue
        assert number >> 9 == (brick[2] * dims[1] + brick[1]) * dims[0] + brick[0]
        assert number & 511 == naive_evidence.interleave(*(voxel % 8).tolist())


def carving_of_octants(tally: BrickTally, voxels: npt.NDArray[np.int64], masks: npt.NDArray[np.int32]) -> Carving:
    """Free octants of the bricks that begin at some voxels; nothing is looked at voxel by voxel."""
    brick = (voxels - tally.corner) // 8
    return Carving(
        bricks=(brick[:, 2] * tally.dims[1] + brick[:, 1]) * tally.dims[0] + brick[:, 0],
        masks=masks,
        squares=np.zeros((3, 3), np.float32),
        lens=np.ones(4, np.float32),
        corners_view=np.zeros((3, len(brick)), np.float32),
        offsets_view=np.zeros((3, 512), np.float32),
        min_square=0.0,
    )


@pytest.mark.parametrize("seed", range(3))
def test_a_tally_counts_as_a_dict_does(seed: int) -> None:
    rng = np.random.default_rng(seed)
    tally, hits = BrickTally(GEOMETRY, np.zeros(3), reach_m=2.0), ScanHits()
    struck: Counter[Voxel] = Counter()
    missed: Counter[Voxel] = Counter()
    sums: Counter[Voxel] = Counter()
    for _ in range(4):
        points = rng.normal(0, 0.4, (300, 3))
        voxel_of, count = hits.number(points, tally)
        voxels = [tuple(voxel) for voxel in voxels_of_points(points, GEOMETRY).tolist()]
        assert len(set(voxels)) == count
        assert len({*zip(voxels, voxel_of.tolist(), strict=True)}) == count
        samples = rng.integers(0, 3, (count, 1)) * np.array([5, 1])
        tally.add_hits(hits, samples.astype(np.int64))
        struck.update(set(voxels))
        for voxel, number in set(zip(voxels, voxel_of.tolist(), strict=True)):
            sums[voxel] += int(samples[number, 1])
        bricks = np.unique(rng.integers(-3, 3, (40, 3)), axis=0)
        masks = rng.integers(0, 256, len(bricks)).astype(np.int32)
        tally.add_misses(hits, carving_of_octants(tally, 8 * bricks, masks))
        hits.forget()
        for (x, y, z), mask in zip((8 * bricks).tolist(), masks.tolist(), strict=True):
            free = [n for n in np.ndindex(8, 8, 8) if mask >> (n[0] // 4 + n[1] // 4 * 2 + n[2] // 4 * 4) & 1]
            missed.update({(x + i, y + j, z + k) for i, j, k in free} - set(voxels))
    found = by_voxel(tally.packed())
    assert {voxel: count for voxel, (count, _, _) in found.items() if count} == struck
    assert {voxel: total[1] for voxel, (_, _, total) in found.items() if total[1]} == +sums
    assert {voxel: count for voxel, (_, count, _) in found.items() if count} == missed


@pytest.mark.slow
@pytest.mark.parametrize("edge_um", [25_000, 50_000, 200_000])
@pytest.mark.parametrize("seed", range(3))
def test_culling_leaves_out_and_takes_as_free_only_what_is(seed: int, edge_um: int) -> None:
    geometry = Geometry(voxel_edge_um=edge_um, depth=4, channels=())
    window = window_of(CAMERA)
    assert window is not None
    scan = scan_at(np.array([0.3, -0.2, 0.1]), seed)
    edge_m = geometry.voxel_edge_m
    clear = window.shown(np.nan_to_num(np.maximum(scan.range_m - np.float32(edge_m), 0)))
    box = tally_around(scan.T_map_rig[:3, 3], 4.0, geometry, max_range_m=4.0)
    culled = carving_of(
        *(clear, window, scan.T_map_rig),
        corner=box.corner,
        dims=box.dims,
        voxel_edge_m=edge_m,
        min_range_m=0.3,
        scratch=Scratch(),
    )
    bricks = np.arange(np.prod(box.dims), dtype=np.int64)
    xyz = np.stack([bricks % box.dims[0], bricks // box.dims[0] % box.dims[1], bricks // np.prod(box.dims[:2])], axis=1)
    first = (box.corner + 8 * xyz + 0.5) * edge_m - scan.T_map_rig[:3, 3]
    everything = replace(
        culled,
        bricks=bricks,
        masks=np.full(len(bricks), 0xFF00, np.int32),
        corners_view=(first @ scan.T_map_rig[:3, :3]).T.astype(np.float32),
    )
    known = np.isin(bricks, culled.bricks)
    everything.corners_view[:, culled.bricks] = culled.corners_view[:, : len(culled.bricks)]
    packed = []
    for carving in (culled, everything):
        tally, hits = tally_around(scan.T_map_rig[:3, 3], 4.0, geometry, max_range_m=4.0), ScanHits()
        hits.number(np.empty((0, 3)), tally)
        tally.add_misses(hits, carving)
        packed.append(tally.packed())
    assert packed[0] == packed[1] != {}
    # It did something: most bricks are out of sight, and some are free without a look.
    assert known.mean() < 0.3
    assert edge_um > 100_000 or (culled.masks & 0xFF).any()


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_scans_too_far_apart_for_one_tally_add_up_all_the_same(threads: int) -> None:
    rng = np.random.default_rng(1)
    scans = [scan_at(np.array([4.0 * (n // 2), 0, 0]) + rng.normal(0, 0.3, 3), n) for n in range(8)]
    total = EvidenceMap(GEOMETRY)
    for scan in scans:
        total.merge(integrate_scan(scan, RIG, GEOMETRY, integrator=LIMITS))
    assert integrate_scans(scans, RIG, GEOMETRY, integrator=LIMITS, threads=threads) == total.packed()


def test_a_point_outside_the_box_is_refused_and_leaves_nothing_behind() -> None:
    tally, hits = BrickTally(GEOMETRY, np.zeros(3), reach_m=1.0), ScanHits()
    with pytest.raises(BadInputError, match="outside the tally's box"):
        hits.number(np.array([[0.1, 0.1, 0.1], [9.0, 0.0, 0.0]]), tally)
    hits.forget()
    assert hits.number(np.array([[0.1, 0.1, 0.1]]), tally)[1] == 1
    assert tally.packed() == {}
