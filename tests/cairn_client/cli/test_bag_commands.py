import json
from pathlib import Path

import pytest
from tests.fixtures.fusion.bags import ALL_CHANNELS, mapping_text, recorded, small_recording, write_bag

from cairn_client.cli.robots.command import main
from cairn_client.robot.robot import Robot
from cairn_fusion.recording.recording import Recording
from cairn_map.codec.cell_code import encode_cell
from cairn_map.errors import BadInputError, ConflictError

NOBODY = "http://127.0.0.1:9/maps/lab"
"""URL at which nothing listens: a robot maps on without a link."""


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    return small_recording(tmp_path_factory.mktemp("recording") / "room")


@pytest.fixture
def bag(source: Recording, tmp_path: Path) -> Path:
    return write_bag(tmp_path / "lab", "ros1.mcap", lambda make: recorded(source, make))


def replayed(recording: Path, state: Path, *options: str) -> dict[int, bytes]:
    """The canonical cells that a replay leaves in the robot's folder."""
    voxel = str(ALL_CHANNELS.voxel_edge_m)
    assert main(["replay", str(recording), "--map", NOBODY, "--state", str(state), "--voxel", voxel, *options]) == 0
    name = "bagged" if options else "room"
    with Robot(None, NOBODY, directory=state, name=name) as robot:
        return {
            int(key): encode_cell(key, cell, robot.replica.geometry).data for key, cell in robot.map.packed().items()
        }


def test_a_replayed_bag_leaves_the_cells_of_the_replayed_recording(
    source: Recording, bag: Path, tmp_path: Path
) -> None:
    folder = source.files[0].range_path.parents[2]
    topics = tmp_path / "bag.yaml"
    topics.write_text(mapping_text(source))
    from_bag = replayed(bag, tmp_path / "bag-robot", "--topics", str(topics))
    assert from_bag
    assert from_bag == replayed(folder, tmp_path / "folder-robot")


def test_inspect_lists_topics_and_writes_what_replay_takes(
    bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    topics = tmp_path / "bag.yaml"
    assert main(["inspect", str(bag), "--output", str(topics)]) == 0
    shown, asked = capsys.readouterr()
    assert "/tof/depth" in shown
    assert "16UC1, 176 x 144, tof_optical_frame" in shown
    assert "odom ~> base_link -> tof_optical_frame" in shown
    assert "to decide: camera thermal: how many kelvin" in asked
    with pytest.raises(ConflictError, match="--force"):
        main(["inspect", str(bag), "--output", str(topics)])
    options = "--topics", str(topics), "--name", "bagged"
    with pytest.raises(BadInputError, match="how many kelvin one count is") as caught:
        replayed(bag, tmp_path / "robot", *options)
    assert caught.value.kind == "undecided"
    decided = [line for line in topics.read_text().splitlines() if "DECIDE" not in line]
    topics.write_text("\n".join(decided))
    assert replayed(bag, tmp_path / "robot", *options)


def test_inspect_in_json_has_the_proposal_too(bag: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["inspect", str(bag), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    (depth,) = [topic for topic in found["topics"] if topic["name"] == "/tof/depth"]
    assert (depth["count"], depth["wire"], depth["image_size"]) == (4, "ros1", [176, 144])
    assert depth["rate_hz"] == pytest.approx(2.0)
    assert {"frame": "base_link", "parent": "odom", "moves": True} in found["frames"]
    assert found["proposal"].startswith("# Which topics of lab.mcap are what")
    assert len(found["questions"]) == 2


def test_a_bag_without_topics_asks_and_topics_are_of_bags_only(source: Recording, bag: Path, tmp_path: Path) -> None:
    with pytest.raises(BadInputError) as caught:
        main(["replay", str(bag), "--map", NOBODY, "--state", str(tmp_path / "s"), "--voxel", "0.05"])
    assert caught.value.kind == "undecided"
    topics = tmp_path / "bag.yaml"
    topics.write_text(mapping_text(source))
    folder = source.files[0].range_path.parents[2]
    with pytest.raises(BadInputError, match="is no bag"):
        main(["replay", str(folder), "--map", NOBODY, "--topics", str(topics)])
