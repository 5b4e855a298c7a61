"""Label images of bags: the votes of the recording that a bag was made of, in any coding; and what none may be."""

import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from tests.fixtures.fusion.bags import Messages, Timed, mapping_text, optical, png, recorded, write_bag
from tests.fixtures.fusion.scans import PINHOLE, random_scan

from cairn_calib.rig.rig import Rig, Spectrum, mount_camera
from cairn_fusion.mapping.measurement import Measurement
from cairn_fusion.recording.images import read_labels
from cairn_fusion.recording.recording import Recording, ScanSource, open_recording
from cairn_fusion.recording.recording_writer import RecordingWriter
from cairn_fusion.ros.bag_recording import BagRecording, open_bag_recording, survey
from cairn_fusion.ros.topic_mapping import mapping_from_yaml
from cairn_map.codec.cell_code import encode_cell
from cairn_map.errors import BadInputError, CairnError
from cairn_map.evidence.channels import classes_channel
from cairn_map.evidence.grid import Geometry

GEOMETRY = Geometry(voxel_edge_um=100_000, depth=4, channels=(classes_channel(("wall", "floor", "chair")),))
NAMES = {0: None, 1: "wall", 2: "floor", 250: "chair", 9: "other"}
RIG = Rig(
    name="eyes",
    cameras={
        "tof": mount_camera(Spectrum.RANGE, PINHOLE, np.eye(4)),
        "left": mount_camera(Spectrum.COLOUR, PINHOLE, np.eye(4)),
    },
)
Coding = Callable[[Messages, float, str, np.ndarray[Any, Any]], Any]


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """Three scans; labels of the range camera and of a colour camera, of 8 and of 16 bits."""
    folder = tmp_path_factory.mktemp("labels") / "room"
    with RecordingWriter(folder, RIG, name="room") as writer:
        for seed in (1, 2, 3):
            numbers = np.random.default_rng(seed).choice([0, 1, 1, 1, 2, 9, 250], (2, 30, 40))
            labels = {"tof": numbers[0].astype(np.uint8), "left": numbers[1].astype(np.uint16)}
            colour = {"left": np.full((30, 40, 3), 40 * seed, np.uint8)}
            writer.add(replace(random_scan(PINHOLE, seed), labels=labels, label_names=NAMES, colour=colour))
    return open_recording(folder)


def map_bytes(scans: ScanSource) -> dict[int, bytes]:
    one = Measurement(scans.rig, GEOMETRY)
    for scan in scans:
        one.add(scan)
    return {int(key): encode_cell(key, evidence, GEOMETRY).data for key, evidence in one.diff().items()}


def coded(source: Recording, code: Coding) -> Callable[[Messages], Iterator[Timed]]:
    """The recording's messages, with label images in another coding."""

    def messages(make: Messages) -> Iterator[Timed]:
        yield from (timed for timed in recorded(source, make) if not timed[1].endswith("labels"))
        for scan in source.files:
            for name, path in scan.labels.items():
                yield scan.time_s, f"/{name}/labels", code(make, scan.time_s, optical(name), read_labels(path))

    return messages


def opened(path: Path, source: Recording, **changes: object) -> BagRecording:
    return open_bag_recording(path, mapping_from_yaml(mapping_text(source, **changes), "bag.yaml"))


def as_32_bits(make: Messages, time_s: float, frame: str, numbers: np.ndarray[Any, Any]) -> Any:
    return make.image(time_s, frame, numbers.astype(np.int32), "32SC1", pad=8)


def as_png(make: Messages, time_s: float, frame: str, numbers: np.ndarray[Any, Any]) -> Any:
    return make.compressed(time_s, frame, "mono16; png compressed", png(numbers))


def as_it_is(make: Messages, time_s: float, frame: str, numbers: np.ndarray[Any, Any]) -> Any:
    return make.image(time_s, frame, numbers, "8UC1" if numbers.dtype == np.uint8 else "mono16")


@pytest.mark.parametrize("kind", ["bag", "mcap"])
@pytest.mark.parametrize("code", [as_it_is, as_32_bits, as_png])
def test_a_bag_has_the_votes_of_the_recording_it_was_made_of(
    kind: str, code: Coding, source: Recording, tmp_path: Path
) -> None:
    bag = opened(write_bag(tmp_path / "lab", kind, coded(source, code)), source)
    scan, expected = bag.scan(1), source.scan(1)
    assert (scan.label_names, scan.labels.keys()) == (expected.label_names, expected.labels.keys())
    for name, numbers in expected.labels.items():
        np.testing.assert_array_equal(scan.labels[name], numbers)
    assert map_bytes(bag) == map_bytes(source)


def test_a_camera_may_have_label_images_alone(source: Recording, tmp_path: Path) -> None:
    cameras = json.loads(mapping_text(source))["cameras"]
    del cameras["left"]["topic"]
    bag = opened(write_bag(tmp_path / "lab", "mcap", lambda make: recorded(source, make)), source, cameras=cameras)
    assert (bag.scan(0).labels.keys(), bag.scan(0).colour) == ({"tof", "left"}, {})
    assert map_bytes(bag) == map_bytes(source)


def test_label_images_that_are_far_in_time_are_of_no_scan(source: Recording, tmp_path: Path) -> None:
    def messages(make: Messages) -> Iterator[Timed]:
        for time_s, topic, message in recorded(source, make):
            late_s = 0.3 if topic == "/left/labels" else 0.0
            changed = make.header(time_s + late_s, "") if late_s else None
            if changed is not None:
                message.header = changed
            yield time_s, topic, message

    path = write_bag(tmp_path / "lab", "mcap", messages)
    assert opened(path, source, time_tolerance_s=0.2).scan(0).labels.keys() == {"tof"}
    assert opened(path, source, time_tolerance_s=0.4).scan(0).labels.keys() == {"tof", "left"}


def broken(change: Callable[[np.ndarray[Any, Any]], None], dtype: type[np.generic], encoding: str) -> Coding:
    def code(make: Messages, time_s: float, frame: str, numbers: np.ndarray[Any, Any]) -> Any:
        numbers = numbers.astype(dtype)
        change(numbers)
        return make.image(time_s, frame, numbers, encoding)

    return code


def marked(value: int) -> Callable[[np.ndarray[Any, Any]], None]:
    return lambda numbers: numbers.__setitem__((3, 5), value)


def as_picture(make: Messages, time_s: float, frame: str, numbers: np.ndarray[Any, Any]) -> Any:
    data = bytes(cv2.imencode(".jpg", numbers.astype(np.uint8))[1])
    return make.compressed(time_s, frame, "mono8; jpeg compressed", data)


def as_colours(make: Messages, time_s: float, frame: str, numbers: np.ndarray[Any, Any]) -> Any:
    return make.image(time_s, frame, np.zeros((*numbers.shape, 3), np.uint8), "rgb8")


def as_a_part(make: Messages, time_s: float, frame: str, numbers: np.ndarray[Any, Any]) -> Any:
    return make.image(time_s, frame, numbers[:8].astype(np.uint8), "mono8")


@pytest.mark.parametrize(
    ("code", "kind", "words"),
    [
        (broken(marked(77), np.uint8, "mono8"), "unknown_label", "77"),
        (broken(marked(-1), np.int32, "32SC1"), "unknown_label", "-1"),
        (broken(marked(1 << 16), np.int32, "32SC1"), "unknown_label", "65536"),
        (as_picture, "image_type", "one channel of 8 or 16 bits"),
        (as_colours, "unknown_encoding", "read are 8UC1"),
        (as_a_part, "image_size", "label image of"),
    ],
)
def test_images_that_are_no_labels_are_refused(
    code: Coding, kind: str, words: str, source: Recording, tmp_path: Path
) -> None:
    bag = opened(write_bag(tmp_path / "lab", "mcap", coded(source, code)), source)
    with pytest.raises(CairnError, match=words) as refused:
        bag.scan(0)
    assert refused.value.kind == kind


def without_names(mapping: dict[str, Any]) -> None:
    del mapping["label_names"]


def without_topics(mapping: dict[str, Any]) -> None:
    for camera in mapping["cameras"].values():
        del camera["labels"]


def with_names(**names: object) -> Callable[[dict[str, Any]], None]:
    return lambda mapping: mapping["label_names"].update({key.removeprefix("n"): name for key, name in names.items()})


def without_ranges(mapping: dict[str, Any]) -> None:
    del mapping["cameras"]["tof"]["topic"]


def of_a_lidar(mapping: dict[str, Any]) -> None:
    mapping["cameras"]["tof"] = {"spectrum": "range", "topic": "/p", "labels": "/l", "lidar": {"kind": "cloud"}}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (without_names, "camera tof has labels: name their numbers"),
        (without_topics, "no camera has a topic of labels"),
        (with_names(n65536="wall"), "whole ones from 0 to 65535, got '65536'"),
        (with_names(n007="wall"), "got '007'"),
        (with_names(n7="Wall"), "label_names.7"),
        (with_names(n7=7), "label_names.7"),
        (without_ranges, "only a camera of labels, and of no ranges"),
        (of_a_lidar, "neither amplitude nor labels"),
    ],
)
def test_a_topics_file_whose_labels_cannot_be_is_refused(
    change: Callable[[dict[str, Any]], None], words: str, source: Recording
) -> None:
    mapping = json.loads(mapping_text(source))
    change(mapping)
    with pytest.raises(BadInputError, match=words) as refused:
        mapping_from_yaml(json.dumps(mapping), "bag.yaml")
    assert refused.value.kind == "bad_mapping"


def test_numbers_of_a_table_are_yaml_s_or_json_s_and_stand_once(source: Recording) -> None:
    text = mapping_text(source, label_names={})
    table = text.replace('"label_names": {}', '"label_names": {0: null, 7: wall, 11: other}')
    assert mapping_from_yaml(table, "bag.yaml").label_names == {0: None, 7: "wall", 11: "other"}
    for names in ("7: wall, '7': chair", "7: wall, 7: chair", "true: wall", "1.5: wall"):
        with pytest.raises(BadInputError, match=r"twice|whole ones|duplicate"):
            mapping_from_yaml(text.replace('"label_names": {}', f'"label_names": {{{names}}}'), "bag.yaml")


def test_a_proposal_names_topics_of_labels_in_comments(source: Recording, tmp_path: Path) -> None:
    proposal = survey(write_bag(tmp_path / "lab", "mcap", lambda make: recorded(source, make))).proposal
    assert not [question for question in proposal.questions if "labels" in question]
    text = proposal.text
    assert "    # labels: /tof/labels  # " in text and "    # labels: /left/labels  # " in text
    text = text.replace("    # labels:", "    labels:").replace("# label_names:", "label_names:")
    mapping = mapping_from_yaml(text, "bag.yaml")
    assert {camera.labels for camera in mapping.cameras.values()} == {"/tof/labels", "/left/labels"}
    assert mapping.label_names == {0: None, 1: "wall", 2: "floor"}
