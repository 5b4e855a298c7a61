"""Channels of classes: what their lists may be, the laws of their sums, and how votes are read."""

import numpy as np
import pytest
from pydantic import ValidationError
from tests.fixtures.map.classed import CLASSED, MANY, classed_evidence

from cairn_map.epochs.cell_history import cell_history
from cairn_map.epochs.epoch import BASE, Epoch
from cairn_map.epochs.present import present
from cairn_map.errors import BadInputError
from cairn_map.evidence.brick_cell import brick_cell, difference, sum_evidence
from cairn_map.evidence.channels import CLASSES_MAX, COLOUR, Channel, ChannelKind, class_colours, classes_channel
from cairn_map.evidence.evidence import every_sum_has_weight, packed_evidence
from cairn_map.evidence.fingerprint import fingerprint
from cairn_map.evidence.grid import CellKey, Geometry, cell_key
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_map.evidence.view import ViewStyle, view_of
from cairn_map.evidence.voxels import joined_voxels, reading_of_sums, voxels_of_evidence
from cairn_map.files.cell_files import npz_file, ply_file

KEY = cell_key((-1, 0, 2))
WALL = CLASSED.channels[0]


@pytest.mark.parametrize("geometry", [CLASSED, MANY], ids=["four", "64"])
def test_votes_add_up_in_any_order_and_are_taken_out_again(geometry: Geometry) -> None:
    diffs = [classed_evidence(seed, geometry) for seed in range(4)]
    whole = sum_evidence(diffs, geometry)
    assert sum_evidence(diffs[::-1], geometry) == whole
    cell = brick_cell(geometry, diffs)
    cell.unmerge(diffs[1])
    rest = sum_evidence([diffs[0], *diffs[2:]], geometry)
    assert cell.packed() == rest
    assert difference(whole, rest, geometry) == diffs[1]
    first, *others = (fingerprint(diff, KEY) for diff in diffs)
    assert sum(others, first) == fingerprint(whole, KEY)
    assert every_sum_has_weight(whole.samples, geometry)


def test_each_class_has_a_weight_of_its_own_in_the_fingerprint() -> None:
    def one(plane: int) -> str:
        samples = np.zeros((1, MANY.plane_count), np.int64)
        samples[0, [plane, 63]] = 1, 1
        evidence = packed_evidence(np.zeros(1, np.uint32), np.ones((1, 2), np.int32), samples, MANY)
        return fingerprint(evidence, KEY).hex()

    assert len({one(plane) for plane in range(64)}) == 64


@pytest.mark.parametrize(
    ("votes", "found"),
    [
        ([0, 0, 0, 0], (None, False)),
        ([1, 0, 0, 1], ("wall", True)),  # one vote is not sure
        ([2, 0, 0, 2], ("wall", False)),
        ([3, 3, 0, 6], ("wall", True)),  # of equal ones the smaller number
        ([0, 2, 3, 5], ("chair", True)),
        ([0, 2, 4, 6], ("chair", False)),
        ([1, 0, 0, 5], ("other", False)),
        ([2, 0, 0, 4], ("wall", True)),
        ([5, 0, 0, 3], ("wall", False)),  # what cannot be is read, never merged otherwise
    ],
)
def test_the_most_votes_count_and_a_small_lead_is_unsure(votes: list[int], found: tuple[str | None, bool]) -> None:
    reading = reading_of_sums(WALL, np.array([votes, votes]))
    assert (reading.class_names, reading.unsure is not None and reading.unsure.tolist()) == (
        [found[0]] * 2,
        [found[1]] * 2,
    )


def test_the_newest_rows_are_read_up_to_eight_votes() -> None:
    def row(*votes: int) -> object:
        samples = np.array([votes])
        return packed_evidence(np.zeros(1, np.uint32), np.array([[1, 0]]), samples, CLASSED)

    history = cell_history({BASE: row(99, 0, 0, 99), Epoch(1): row(0, 5, 0, 5), Epoch(2): row(0, 0, 4, 4)})
    assert present(history, CLASSED, SensorModel()).samples.tolist() == [[0, 5, 4, 9]]
    few = cell_history({BASE: row(3, 0, 0, 3), Epoch(2): row(0, 0, 4, 4)})
    assert present(few, CLASSED, SensorModel()).samples.tolist() == [[3, 0, 4, 7]]


@pytest.mark.parametrize(
    "names", [("a", "a"), ("A",), ("",), ("other", "a"), (), tuple(f"c{n}" for n in range(CLASSES_MAX)), ("a b",)]
)
def test_a_list_that_cannot_be_is_refused(names: tuple[str, ...]) -> None:
    with pytest.raises(BadInputError) as refused:
        classes_channel(names)
    assert refused.value.kind == "bad_classes"


@pytest.mark.parametrize(
    "fields",
    [
        {"kind": "scalar", "classes": ("a", "other")},
        {"kind": "classes"},
        {"kind": "classes", "classes": ("a", "b")},
        {"kind": "classes", "classes": ("a", "other"), "step": 0.5},
        {"kind": "classes", "classes": ("a", "other"), "unit": "K"},
        {"kind": "classes", "classes": ("a", "other"), "zero": 1.0},
    ],
)
def test_a_channel_is_of_classes_with_a_list_alone(fields: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        Channel.model_validate({"name": "x", **fields})


def test_a_map_has_one_list_of_classes_and_others_are_written_without_one() -> None:
    with pytest.raises(ValidationError, match="one channel of classes"):
        Geometry(channels=(WALL, classes_channel(("a",), name="more")))
    assert "classes" not in COLOUR.model_dump(mode="json")
    assert Geometry.model_validate_json(CLASSED.model_dump_json()).digest() == CLASSED.digest()
    other = Geometry(voxel_edge_um=50_000, depth=3, channels=(classes_channel(("wall", "chair", "floor")),))
    assert other.digest() != CLASSED.digest()


def test_classes_have_colours_in_views_and_columns_in_files() -> None:
    evidence = sum_evidence([classed_evidence(seed, CLASSED) for seed in range(8)], CLASSED)
    parts = [voxels_of_evidence(CellKey(KEY), evidence, CLASSED, SensorModel(), occupied_only=False)] * 2
    voxels = joined_voxels(parts)
    reading = voxels.of_kind(ChannelKind.CLASSES)
    assert reading is not None and reading.unsure is not None
    view = view_of(evidence, CLASSED, SensorModel(), ViewStyle())
    assert {*map(tuple, view.colour.tolist())} <= {*map(tuple, class_colours(4).tolist())}
    assert len({*map(tuple, class_colours(CLASSES_MAX).tolist())}) == CLASSES_MAX
    head, _, body = ply_file(voxels).partition(b"end_header\n")
    assert b"comment class 2 chair\ncomment class 3 other\n" in head and b"property short class\n" in head
    assert len(body) % len(voxels) == 0
    assert b"classes_names.npy" in npz_file(voxels)
    assert reading.rows(np.array([0])).class_names == reading.class_names[:1]
