"""Messages of maps, read by the definitions that go with them, and by this project's own reader of bags."""

from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from tests.fixtures.fusion.cdr_reader import read_message
from tests.fixtures.map.made import SMALL
from tests.fixtures.map.marks import mark
from tests.fixtures.map.worlds import random_map

from cairn_client.publish.mcap_file import McapFile
from cairn_fusion.ros import map_messages
from cairn_fusion.ros.bag import Wire
from cairn_fusion.ros.map_messages import HotSpot, MapMessage, RobotPose
from cairn_fusion.ros.mcap_bag import McapBag
from cairn_fusion.ros.messages import read_transforms
from cairn_fusion.ros.point_clouds import read_points
from cairn_map.errors import BadInputError, DamagedDataError, UnreachableError
from cairn_map.queries.floor_grid import FloorGrid
from cairn_map.queries.map_snapshot import snapshot_of

NOW_NS = 1_795_824_000_250_000_000
STAMP = {"sec": 1_795_824_000, "nanosec": 250_000_000}
MOLE = RobotPose(1_795_823_999.5, (1.0, -2.0, 0.25), (0.0, 0.0, 0.6, 0.8))


def floor(values: np.ndarray[tuple[int, int], np.dtype[np.int8]]) -> FloorGrid:
    return FloorGrid(values, (-5.12, 0.64), 0.04, 3.2)


def fields_of(message: MapMessage) -> dict[str, object]:
    return read_message(map_messages.definition_of(message.type_name), message.type_name, message.data)


def all_messages() -> list[MapMessage]:
    voxels = snapshot_of(random_map(1, SMALL)).occupied_in()
    return [
        map_messages.grid_message("/map", floor(np.array([[0, 100, -1]], np.int8)), "map", NOW_NS),
        map_messages.cloud_message("/cairn/points", voxels, "map", NOW_NS),
        map_messages.transforms_message("/tf", {"mole": MOLE}, "map", NOW_NS),
        map_messages.path_message("/cairn/robots/mole/path", [MOLE, MOLE], "map", NOW_NS),
        map_messages.hot_spots_message("/cairn/hot_spots", [HotSpot((1.0, 2.0, 0.5), 353.15)], "map", NOW_NS),
        map_messages.marks_message("/cairn/marks", [mark()], "map", NOW_NS),
        map_messages.octomap_message("/cairn/octomap", TREE, 0.04, "map", NOW_NS),
    ]


TREE = b"# Octomap OcTree binary file\n# (feel free)\nid OcTree\nsize 1\nres 0.04\ndata\n\x01\x02\xff"


def test_a_grid_is_an_occupancy_grid_with_the_row_of_the_lowest_y_first() -> None:
    values = np.random.default_rng(1).choice(np.array([0, 100, -1], np.int8), (5, 3))
    found = fields_of(map_messages.grid_message("/map", floor(values), "lab", NOW_NS))
    assert found["header"] == {"stamp": STAMP, "frame_id": "lab"}
    info: dict[str, object] = found["info"]  # type: ignore[assignment]
    assert (info["width"], info["height"], info["map_load_time"]) == (3, 5, STAMP)
    assert info["resolution"] == pytest.approx(0.04)
    assert info["origin"] == {
        "position": {"x": -5.12, "y": 0.64, "z": 3.2},
        "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
    }
    np.testing.assert_array_equal(found["data"], values.ravel())


def test_a_cloud_holds_each_voxel_with_its_readings() -> None:
    voxels = snapshot_of(random_map(1, SMALL)).occupied_in()
    message = map_messages.cloud_message("/cairn/points", voxels, "map", NOW_NS)
    points = read_points(message.data, Wire.CDR)
    assert (points.width, points.height, points.header.frame) == (len(voxels), 1, "map")
    place = np.stack([points.column(name) for name in "xyz"], axis=1)
    np.testing.assert_array_equal(place, voxels.centres_m.astype(np.float32))
    np.testing.assert_array_equal(points.column("probability"), voxels.probability.astype(np.float32))
    celsius = voxels.readings["temperature"].mean - 273.15
    np.testing.assert_array_equal(points.column("temperature"), celsius.astype(np.float32))
    packed = np.ascontiguousarray(points.column("rgb")).view(np.uint32)
    colour = voxels.readings["colour"]
    seen = colour.weight > 0
    shades = np.stack([packed >> 16 & 255, packed >> 8 & 255, packed & 255], axis=1)
    np.testing.assert_array_equal(shades[seen], np.clip(np.rint(colour.mean[seen]), 0, 255))
    assert seen.any() and (packed[~seen] == 0x808080).all()
    assert fields_of(message)["point_step"] == 24


def test_a_cloud_of_nothing_is_one_without_points() -> None:
    nothing = snapshot_of(random_map(1, SMALL)).occupied_in([[100, 100, 100], [101, 101, 101]])
    points = read_points(map_messages.cloud_message("/cairn/points", nothing, "map", NOW_NS).data, Wire.CDR)
    assert (points.width, len(points.data)) == (0, 0)


def test_robots_are_frames_below_the_maps_at_the_time_of_their_poses() -> None:
    (edge,) = read_transforms(map_messages.transforms_message("/tf", {"mole": MOLE}, "lab", NOW_NS).data, Wire.CDR)
    assert (edge.parent, edge.child, edge.time_s) == ("lab", "mole", MOLE.time_s)
    np.testing.assert_array_equal(edge.pose, [*MOLE.t_map_rig, *MOLE.q_map_rig])
    path = fields_of(map_messages.path_message("/path", [MOLE], "lab", NOW_NS))
    (stamped,) = path["poses"]  # type: ignore[misc]
    assert stamped["pose"]["position"] == {"x": 1.0, "y": -2.0, "z": 0.25}  # type: ignore[index]
    assert stamped["pose"]["orientation"]["w"] == 0.8  # type: ignore[index]


def test_hot_spots_replace_those_of_before_and_say_their_temperature() -> None:
    spots = [HotSpot((1.0, 2.0, 0.5), 353.15), HotSpot((1.0, 2.0, 0.9), 293.15)]
    first, *markers = fields_of(map_messages.hot_spots_message("/hot", spots, "map", NOW_NS))["markers"]  # type: ignore[misc]
    assert first["action"] == 3  # DELETEALL
    assert len({marker["id"] for marker in markers}) == 4
    assert [marker["text"] for marker in markers] == ["", "80.0 °C", "", "20.0 °C"]
    assert [marker["pose"]["position"]["z"] for marker in markers[::2]] == [0.5, 0.9]
    assert all(marker["color"]["a"] > 0 and marker["scale"]["x"] > 0 for marker in markers)


def test_marks_are_boxes_or_spheres_with_their_names() -> None:
    marks = [mark("lamp"), mark("door", kind="door", extent_m=(0.8, 0.1, 0.0))]
    first, *markers = fields_of(map_messages.marks_message("/marks", marks, "map", NOW_NS))["markers"]  # type: ignore[misc]
    assert first["action"] == 3 and {marker["ns"] for marker in (first, *markers)} == {"marks"}
    assert [marker["type"] for marker in markers] == [2, 9, 1, 9]  # sphere, text, cube, text
    assert [marker["text"] for marker in markers[1::2]] == ["lamp (hot_spot)", "door (door)"]
    assert list(markers[2]["scale"].values()) == pytest.approx([0.8, 0.1, 0.01])
    assert list(markers[0]["pose"]["position"].values()) == pytest.approx([1.0, -2.0, 0.5])


def test_an_octree_is_its_file_without_the_head() -> None:
    found = fields_of(map_messages.octomap_message("/octomap", TREE, 0.04, "map", NOW_NS))
    assert (found["binary"], found["id"], found["resolution"]) == (True, "OcTree", 0.04)
    assert bytes(found["data"]) == b"\x01\x02\xff"  # type: ignore[arg-type]
    with pytest.raises(DamagedDataError, match="begins with its head"):
        map_messages.octomap_message("/octomap", b"<html>", 0.04, "map", NOW_NS)


def test_a_file_gives_every_message_back_to_two_readers(tmp_path: Path) -> None:
    path, sent = tmp_path / "lab.mcap", all_messages()
    with McapFile(path) as file:
        for message in sent:
            file.send(message)
            file.send(message)
        assert file.count == 2 * len(sent)
    bag = McapBag(path)
    assert {name: topic.count for name, topic in bag.topics.items()} == {message.topic: 2 for message in sent}
    found = {message.topic: bytes(message.data) for message in bag.messages(bag.topics)}
    bag.close()
    assert found == {message.topic: message.data for message in sent}
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        for schema, channel, record in reader.iter_messages():
            assert schema is not None
            assert (schema.encoding, channel.message_encoding, record.log_time) == ("ros2msg", "cdr", NOW_NS)
            assert read_message(schema.data.decode(), schema.name, record.data)


@pytest.mark.parametrize("ending", [None, KeyboardInterrupt])
def test_a_file_takes_the_place_of_another_once_it_is_whole(tmp_path: Path, ending: type[BaseException] | None) -> None:
    path = tmp_path / "lab.mcap"
    path.write_bytes(b"old")
    with suppress(KeyboardInterrupt), McapFile(path) as file:
        file.send(all_messages()[0])
        assert path.read_bytes() == b"old"
        if ending is not None:
            raise ending
    assert (file.path, count_in(path), list(tmp_path.iterdir())) == (path, 1, [path])


def test_an_error_leaves_what_came_next_to_the_file_that_was_there(tmp_path: Path) -> None:
    path = tmp_path / "lab.mcap"
    path.write_bytes(b"old")
    with pytest.raises(UnreachableError), McapFile(path) as file:
        file.send(all_messages()[0])
        raise UnreachableError("unreachable", "gone")
    assert (path.read_bytes(), file.path.name, count_in(file.path)) == (b"old", "lab.mcap.part", 1)


def test_a_file_without_a_message_is_none(tmp_path: Path) -> None:
    with pytest.raises(UnreachableError), McapFile(tmp_path / "lab.mcap"):
        raise UnreachableError("unreachable", "gone")
    assert not list(tmp_path.iterdir())


def count_in(path: Path) -> int:
    """Number of messages, by the file's index."""
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None and summary.statistics is not None
    return summary.statistics.message_count


@pytest.mark.parametrize("name", ["nowhere/lab.mcap", "."])
def test_a_file_that_cannot_be_written_is_said(tmp_path: Path, name: str) -> None:
    with pytest.raises(BadInputError, match="cannot write"):
        McapFile(tmp_path / name)
