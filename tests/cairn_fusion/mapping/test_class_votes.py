"""Votes of label images: against a slow twin, in any order, from any camera; and what label images may not be."""

import tracemalloc
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from tests.fixtures.fusion.scans import PINHOLE, random_scan, rig_of

from cairn_calib.rig.rig import Rig, Spectrum, mount_camera
from cairn_fusion.mapping import class_votes
from cairn_fusion.mapping.beam_returns import returns_of
from cairn_fusion.mapping.integrate import Integrator, integrate_scan, integrate_scans
from cairn_fusion.mapping.integrate import Method as IntegrationMethod
from cairn_fusion.recording.scan import Scan
from cairn_map.errors import BadInputError
from cairn_map.evidence.channels import Channel, ChannelKind, classes_channel
from cairn_map.evidence.evidence import every_sum_has_weight, packed_evidence
from cairn_map.evidence.grid import CellKey, Geometry, cell_key, split_voxels, voxels_of_points

GEOMETRY = Geometry(voxel_edge_um=100_000, depth=4, channels=(classes_channel(("wall", "floor", "chair")),))
PLAIN = GEOMETRY.model_copy(update={"channels": ()})
NAMES = {0: None, 1: "wall", 2: "floor", 5: "chair", 6: "wall", 9: "other"}
NUMBER_OF = {"wall": 0, "floor": 1, "chair": 2, "other": 3}
RIG = Rig(
    name="eyes",
    cameras={
        "tof": mount_camera(Spectrum.RANGE, PINHOLE, np.eye(4)),
        "left": mount_camera(Spectrum.COLOUR, PINHOLE, np.eye(4)),
    },
)


def labelled(seed: int, camera: str = "tof", **changes: object) -> Scan:
    labels = np.random.default_rng(seed).choice([0, 1, 1, 1, 2, 5, 6, 9], (30, 40)).astype(np.uint16)
    return replace(random_scan(PINHOLE, seed), **({"labels": {camera: labels}, "label_names": NAMES} | changes))


def naive_votes(scans: list[Scan]) -> dict[tuple[int, int], list[int]]:
    """By cell and place the sums of one vote: pixels of all scans counted one by one, the range camera's own labels."""
    pixels: dict[tuple[int, int], Counter[int]] = {}
    for scan in scans:
        returns = returns_of(scan, RIG, min_range_m=0.1, max_range_m=None, flying_step_m=0.05)
        cells, places = split_voxels(voxels_of_points(returns.points_map, GEOMETRY), GEOMETRY)
        for pixel, cell, place in zip(returns.pixels.tolist(), cells.tolist(), places.tolist(), strict=True):
            name = NAMES[int(scan.labels["tof"].ravel()[pixel])]
            if name is not None:
                pixels.setdefault((cell, place), Counter())[NUMBER_OF[name]] += 1
    votes = {}
    for key, counted in pixels.items():
        (winner, first), *rest = sorted(counted.items(), key=lambda item: (-item[1], item[0]))
        lead, total = first - (rest[0][1] if rest else 0), sum(counted.values())
        weight = max(1, min(lead, 4, next(w for w in range(5) if w * total >= 4 * lead)))
        votes[key] = [weight * (winner == number) for number in range(3)] + [weight]
    return votes


@pytest.mark.parametrize("seeds", [[1], [1, 1], [1, 2, 3]])
def test_votes_are_those_of_the_slow_twin(seeds: list[int]) -> None:
    scans = [labelled(seed) for seed in seeds]
    diff = integrate_scans(scans, RIG, GEOMETRY, integrator=Integrator(), threads=2)
    found = {
        (int(key), int(cell.voxels[row])): sums
        for key, cell in diff.items()
        for row, sums in zip(cell.sampled.tolist(), cell.samples.tolist(), strict=True)
    }
    assert found == naive_votes(scans)
    assert all(every_sum_has_weight(cell.samples, GEOMETRY) for cell in diff.values())


def test_hits_and_misses_are_those_of_a_map_without_classes_in_any_order_of_scans() -> None:
    scans = [labelled(seed) for seed in range(4)]
    diff = integrate_scans(scans, RIG, GEOMETRY, integrator=Integrator())
    plain = integrate_scans(scans, RIG, PLAIN, integrator=Integrator())
    assert {key: cell.counts.tolist() for key, cell in diff.items()} == {
        key: cell.counts.tolist() for key, cell in plain.items()
    }
    assert integrate_scans(scans[::-1], RIG, GEOMETRY, integrator=Integrator(), threads=1) == diff


def test_another_camera_labels_what_it_sees_and_each_camera_has_a_vote() -> None:
    own, other = labelled(1), labelled(1, "left")
    both = replace(own, labels={**own.labels, **other.labels})
    one, two, sums = (
        integrate_scan(scan, RIG, GEOMETRY, integrator=Integrator(sample_spread_voxels=np.inf))
        for scan in (own, other, both)
    )
    weights = [sum(int(cell.samples[:, -1].sum()) for cell in diff.values()) for diff in (one, two, sums)]
    assert weights[0] > 0 and weights[1] > 0 and weights[2] == weights[0] + weights[1]
    cast = integrate_scan(own, RIG, GEOMETRY, integrator=Integrator(method=IntegrationMethod.CAST))
    assert any(len(cell.sampled) for cell in cast.values())


def test_votes_for_many_classes_take_little_more_memory_than_their_evidence() -> None:
    many = Geometry(voxel_edge_um=100_000, depth=4, channels=(classes_channel(tuple(f"c{n}" for n in range(63))),))
    voxels = np.stack(np.unravel_index(np.arange(16**4), (64, 32, 32)), axis=1).astype(np.int64)
    votes, rng = class_votes.ClassVotes(many), np.random.default_rng(1)
    for camera in "abcde":
        votes.count(camera, voxels, rng.integers(0, 64, len(voxels)))
    tracemalloc.start()
    diff = votes.joined({})
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert sum(int(cell.samples[:, -1].sum()) for cell in diff.values()) == 5 * len(voxels)
    assert peak < 2 * sum(cell.size_bytes for cell in diff.values())


@pytest.mark.parametrize("reach", [2, 50, 1 << 27])
def test_pixels_are_counted_whatever_the_voxels_and_in_whatever_parts_they_come(reach: int) -> None:
    rng = np.random.default_rng(reach)
    voxels, classes = rng.integers(-reach, reach, (400, 3)), rng.integers(-1, 64, 400)
    counts = class_votes.PixelCounts()
    for part in np.split(np.arange(400), [0, 1, 3, 50, 390]):
        counts.add(voxels[part], classes[part])
    pixels: dict[tuple[int, ...], Counter[int]] = {}
    for voxel, number in zip(voxels.tolist(), classes.tolist(), strict=True):
        if number >= 0:
            pixels.setdefault(tuple(voxel), Counter())[number] += 1
    found, winners, _ = counts.votes()
    assert dict(zip(map(tuple, found.tolist()), winners.tolist(), strict=True)) == {
        voxel: min(each, key=lambda number: (-each[number], number)) for voxel, each in pixels.items()
    }
    assert counts.pixels[: counts.pairs].sum() == np.count_nonzero(classes >= 0)


def test_votes_where_nothing_was_hit_and_readings_of_other_channels_are_kept() -> None:
    dose = Channel(kind=ChannelKind.SCALAR, name="dose", unit="uSv/h", step=0.1, zero=0.0)
    both = GEOMETRY.model_copy(update={"channels": (dose, *GEOMETRY.channels)})
    counted = packed_evidence(
        np.array([3, 9], np.uint32),
        np.array([[1, 0], [0, 1]]),
        np.array([[0, 0], [7, 1]]),
        class_votes.without_classes(both),
    )
    votes = class_votes.ClassVotes(both)
    votes.count("tof", np.array([[1, 1, 0], [0, 1, 1]]), np.array([2, 3]))  # places 3 and 6, one of them never hit
    joined = votes.joined({CellKey(cell_key((0, 0, 0))): counted})[cell_key((0, 0, 0))]
    assert joined.voxels.tolist() == [3, 6, 9] and joined.counts.tolist() == [[1, 0], [0, 0], [0, 1]]
    assert joined.sampled.tolist() == [0, 1, 2]
    assert joined.samples.tolist() == [[0, 0, 0, 0, 1, 1], [0, 0, 0, 0, 0, 1], [7, 1, 0, 0, 0, 0]]


def test_labels_of_a_map_without_classes_are_left_aside() -> None:
    assert integrate_scan(labelled(1), RIG, PLAIN, integrator=Integrator()) == integrate_scan(
        random_scan(PINHOLE, 1), rig_of(PINHOLE), PLAIN, integrator=Integrator()
    )


@pytest.mark.parametrize(
    ("changes", "kind"),
    [
        ({"label_names": {0: None}}, "unknown_label"),
        ({"label_names": NAMES | {1: "wal"}}, "unknown_class"),
        ({"label_names": NAMES | {70_000: "wall"}}, "bad_labels"),
        ({"label_names": NAMES | {-1: "wall"}}, "bad_labels"),
        ({"labels": {"tof": np.ones((40, 30), np.uint8)}}, "image_size"),
        ({"labels": {"tof": np.ones((30, 40), np.int32)}}, "bad_scan"),
        ({"labels": {"tof": np.ones((30, 40, 3), np.uint8)}}, "bad_scan"),
        ({"labels": {"absent": np.ones((30, 40), np.uint8)}}, "unknown_camera"),
        ({"points_m": np.ones((3, 3), np.float32)}, "bad_scan"),
    ],
)
def test_labels_that_fit_nothing_are_refused(changes: dict[str, object], kind: str) -> None:
    with pytest.raises(BadInputError) as refused:
        integrate_scan(labelled(1, **changes), RIG, GEOMETRY, integrator=Integrator())
    assert refused.value.kind == kind
