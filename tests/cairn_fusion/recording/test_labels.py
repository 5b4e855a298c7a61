"""Label images in recordings: written, read, and refused where they or their table cannot be."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from tests.fixtures.fusion.scans import PINHOLE, random_scan, rig_of

from cairn_fusion.recording.recording import open_recording
from cairn_fusion.recording.recording_format import repeated
from cairn_fusion.recording.recording_writer import RecordingWriter
from cairn_map.errors import BadInputError, CairnError, DamagedDataError

NAMES = {0: None, 1: "wall", 300: "chair"}
FIRST = "images/tof.labels/000000.png"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two scans with labels of 16 and of 8 bits, and one without."""
    with RecordingWriter(tmp_path / "labelled", rig_of(PINHOLE), name="labelled") as recording:
        for seed, dtype, top in ((1, np.uint16, 300), (2, np.uint8, 1)):
            labels = np.full((30, 40), top, dtype)
            labels[:5] = 0
            recording.add(replace(random_scan(PINHOLE, seed), labels={"tof": labels}, label_names=NAMES))
        recording.add(random_scan(PINHOLE, 3))
    return tmp_path / "labelled"


def changed(folder: Path, table: object) -> None:
    header = json.loads((folder / "recording.json").read_text())
    (folder / "recording.json").write_text(json.dumps(header | {"labels": table}))


def test_labels_come_back_as_they_were_written(folder: Path) -> None:
    first, second, third = open_recording(folder)
    assert (first.labels["tof"].dtype, second.labels["tof"].dtype, third.labels) == (np.uint16, np.uint8, {})
    assert {*np.unique(first.labels["tof"]).tolist()} == {0, 300}
    assert first.label_names == second.label_names == NAMES
    assert json.loads((folder / "recording.json").read_text())["labels"] == {
        "tof": {"0": None, "1": "wall", "300": "chair"}
    }


def test_a_recording_without_labels_says_nothing_of_them(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "plain", rig_of(PINHOLE), name="plain") as recording:
        recording.add(random_scan(PINHOLE, 1))
    assert "labels" not in json.loads((tmp_path / "plain" / "recording.json").read_text())


@pytest.mark.parametrize(
    "table",
    [
        {"tof": {}},
        {"tof": {"1": "Wall"}},
        {"tof": {"01": "wall"}},
        {"tof": {"70000": "wall"}},
        {"tof": {"-1": "wall"}},
        {"tof": {"1": 2}},
        {"tof": ["wall"]},
        {"absent": {"0": None}},
        {"../tof": {"0": None}},
    ],
)
def test_a_table_that_cannot_be_is_refused_when_opened(folder: Path, table: object) -> None:
    changed(folder, table)
    with pytest.raises(CairnError):
        open_recording(folder)


@pytest.mark.parametrize("table", [{1: "Wall"}, {1: ["wall"]}, {1: "a" * 33}, {"1": "wall"}, {True: "floor"}])
def test_a_table_that_could_not_be_opened_is_not_written(tmp_path: Path, table: dict[int, str | None]) -> None:
    labels = {"tof": np.ones((30, 40), np.uint8)}
    with RecordingWriter(tmp_path / "bad", rig_of(PINHOLE), name="bad") as recording:
        with pytest.raises(BadInputError) as refused:
            recording.add(replace(random_scan(PINHOLE, 1), labels=labels, label_names=table))
        assert refused.value.kind == "bad_labels"
        assert not (tmp_path / "bad" / "images").exists()
    assert len(open_recording(tmp_path / "bad")) == 0


def test_a_table_too_large_for_the_header_is_refused_before_the_first_image(tmp_path: Path) -> None:
    labels = {"tof": np.ones((30, 40), np.uint8)}
    names = dict.fromkeys(range(1 << 15), "a" * 32)
    with RecordingWriter(tmp_path / "large", rig_of(PINHOLE), name="large") as recording:
        with pytest.raises(BadInputError, match="leave out the numbers") as refused:
            recording.add(replace(random_scan(PINHOLE, 1), labels=labels, label_names=names))
        assert refused.value.kind == "bad_labels"
        assert not (tmp_path / "large" / "images").exists()
        recording.add(replace(random_scan(PINHOLE, 1), labels=labels, label_names=NAMES))
    assert open_recording(tmp_path / "large").scan(0).label_names == NAMES


def test_keys_of_a_table_are_not_compared_each_with_each() -> None:
    compared = []

    class Key(str):
        __slots__ = ()
        __hash__ = str.__hash__

        def __eq__(self, other: object) -> bool:
            compared.append(self)
            return str.__eq__(self, other)

    keys = [Key(number) for number in range(1000)]
    assert repeated(keys) == []
    assert repeated([*keys, Key(7), Key(7)]) == ["7"]
    assert len(compared) < 4 * len(keys)


def test_a_number_that_stands_twice_in_the_table_is_refused(folder: Path) -> None:
    path = folder / "recording.json"
    path.write_text(path.read_text().replace('"1": "wall"', '"1": "wall", "1": "chair"'))
    with pytest.raises(BadInputError, match="stands twice"):
        open_recording(folder)


def test_a_label_that_the_table_lacks_is_refused_when_read(folder: Path) -> None:
    changed(folder, {"tof": {"0": None, "1": "wall"}})
    recording = open_recording(folder)
    with pytest.raises(BadInputError) as refused:
        recording.scan(0)
    assert refused.value.kind == "unknown_label"
    assert recording.scan(1).labels


@pytest.mark.parametrize(
    ("image", "kind"),
    [
        (np.zeros((30, 40, 3), np.uint8), "image_type"),
        (np.zeros((40, 30), np.uint8), "image_size"),
        (np.zeros((40, 30), np.uint16), "image_size"),
    ],
)
def test_pictures_of_labels_and_other_rasters_are_refused(folder: Path, image: np.ndarray, kind: str) -> None:
    cv2.imwrite(str(folder / FIRST), image)
    with pytest.raises(BadInputError) as refused:
        open_recording(folder).scan(0)
    assert refused.value.kind == kind


def test_a_damaged_label_image_is_damaged_data(folder: Path) -> None:
    data = (folder / FIRST).read_bytes()
    (folder / FIRST).write_bytes(data[: len(data) // 2])
    with pytest.raises(DamagedDataError):
        open_recording(folder).scan(0)


def test_scans_of_one_recording_share_one_table(tmp_path: Path) -> None:
    labels = {"tof": np.zeros((30, 40), np.uint8)}
    with RecordingWriter(tmp_path / "two", rig_of(PINHOLE), name="two") as recording:
        recording.add(replace(random_scan(PINHOLE, 1), labels=labels, label_names=NAMES))
        with pytest.raises(BadInputError, match="one table"):
            recording.add(replace(random_scan(PINHOLE, 2), labels=labels, label_names={0: "wall"}))
        recording.add(replace(random_scan(PINHOLE, 3), labels=labels, label_names=NAMES))
    assert len(open_recording(tmp_path / "two")) == 2
