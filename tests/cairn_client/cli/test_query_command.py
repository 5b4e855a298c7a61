"""`cairn map query` as a user types it: cells or a robot's state, words for people and JSON for programs."""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.fixtures.client.made import GEOMETRY, A, opened
from tests.fixtures.client.served_map import served_map

from cairn_client.cli.maps import query
from cairn_client.cli.maps.command import main
from cairn_client.folders.map_folder import open_map
from cairn_map.codec.cell_code import encode_cell
from cairn_map.epochs.epoch import Epoch
from cairn_map.epochs.history_map import HistoryMap
from cairn_map.epochs.layer import MapLayer
from cairn_map.errors import BadInputError, ConflictError, DamagedDataError
from cairn_map.evidence.evidence import Evidence, packed_evidence
from cairn_map.evidence.grid import cell_of_key
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_map.files.cell_folder import FolderHead, write_cell, write_head
from cairn_map.queries.map_snapshot import snapshot_of

Place = Path | str
# Voxels of 5 cm: 0 is at the origin, 7 is the upper corner of its 2^3 block.
HOT_K = 330.0


def evidence() -> Evidence:
    """Voxel (0, 0, 0) free, (1, 1, 1) occupied and hot, (0, 0, 1) occupied."""
    steps = int(GEOMETRY.channels[0].quantise(np.array([HOT_K]))[0])
    samples = np.array([[0, 0, 0], [0, 0, 0], [2 * steps, 2 * steps**2, 2]])
    counts = np.array([[0, 3], [4, 0], [2, 0]])
    return packed_evidence(np.array([0, 4, 7], np.uint32), counts, samples, GEOMETRY)


@pytest.fixture(scope="module")
def url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The same map on a server."""
    with served_map(tmp_path_factory.mktemp("server"), {A: evidence()}, GEOMETRY, scans=4) as url:
        yield url


@pytest.fixture(params=["cells", "robot", "url"])
def folder(request: pytest.FixtureRequest, tmp_path: Path) -> Place:
    path = tmp_path / "lab"
    if request.param == "url":
        return str(request.getfixturevalue("url"))
    if request.param == "robot":
        replica = opened(path)
        replica.commit({A: evidence()})
        replica.close()
    else:
        write_head(path, FolderHead(geometry=GEOMETRY))
        write_cell(path, cell_of_key(A), encode_cell(A, evidence(), GEOMETRY).data)
    return path


def asked(capsys: pytest.CaptureFixture[str], folder: Place, *words: str) -> str:
    assert main(["query", str(folder), *words]) == 0
    return capsys.readouterr().out


def answered(capsys: pytest.CaptureFixture[str], folder: Place, *words: str) -> Any:
    return json.loads(asked(capsys, folder, *words, "--json"))


def test_points_tell_state_probability_and_readings(folder: Place, capsys: pytest.CaptureFixture[str]) -> None:
    points = ["0.01,0.01,0.01", "0.06,0.06,0.06", "-0.3,0,0"]
    free, hot, unknown = answered(capsys, folder, "points", *points)
    assert (free["state"], hot["state"], unknown["state"]) == ("free", "occupied", "unknown")
    assert hot["probability"] == pytest.approx(0.845, abs=0.001)
    assert hot["readings"]["temperature"]["mean"] == pytest.approx(HOT_K, abs=0.1)
    assert hot["readings"]["temperature"]["unit"] == "K"
    assert [hot["hits"], hot["misses"]] == [2, 0]
    assert unknown == {
        "point_m": [-0.3, 0, 0], "state": "unknown", "probability": None, "hits": 0, "misses": 0,
        "readings": {"temperature": None},
    }  # fmt: skip
    head, *lines = asked(capsys, folder, "points", *points).splitlines()
    assert "x m" in head
    assert "temperature" in head
    assert "occupied" in lines[1]
    assert lines[1].split()[3:7] == ["occupied", "0.84", "2", "0"]
    assert "56.9 C +- 1.0" in lines[1] or "56.8 C +- 1.0" in lines[1]
    assert lines[2].split() == ["-0.300", "0.000", "0.000", "unknown", "-", "-", "-", "-"]


def test_a_ray_tells_how_far_it_comes(folder: Place, capsys: pytest.CaptureFixture[str]) -> None:
    found = answered(capsys, folder, "ray", "0.02,0.02,-1", "0,0,1")
    place = pytest.approx([0.02, 0.02, 0.05])
    assert found == {"hit": True, "distance_m": pytest.approx(1.05), "voxel": [0, 0, 1], "point_m": place}
    said = "occupied after 1.050 m, at (0.020, 0.020, 0.050)\n"
    assert asked(capsys, folder, "ray", "0.02,0.02,-1", "0,0,2") == said
    assert asked(capsys, folder, "ray", "0,0,-1", "0,0,-1") == "nothing is in the way as far as the map goes\n"
    assert asked(capsys, folder, "ray", "0,0,-1", "0,0,1", "--range", "0.5") == "nothing is in the way within 0.5 m\n"


def test_the_nearest_occupied_and_unknown_voxels(folder: Place, capsys: pytest.CaptureFixture[str]) -> None:
    (found,) = answered(capsys, folder, "nearest", "0.025,0.025,-0.1")
    assert found["distance_m"] == pytest.approx(0.15)
    assert found["nearest_m"] == pytest.approx([0.025, 0.025, 0.05])
    (far,) = answered(capsys, folder, "nearest", "9,9,9")
    assert far["distance_m"] is far["nearest_m"] is None
    assert "none within 5 m" in asked(capsys, folder, "nearest", "9,9,9")
    assert "0.000 m to unknown space" in asked(capsys, folder, "nearest", "9,9,9", "--unknown")


def test_the_hottest_voxels_in_kelvin_for_programs_and_celsius_for_people(
    folder: Place, capsys: pytest.CaptureFixture[str]
) -> None:
    (found,) = answered(capsys, folder, "hottest")
    assert found["point_m"] == pytest.approx([0.075] * 3)
    assert found["mean"] == pytest.approx(HOT_K, abs=0.1)
    assert [found["hits"], found["misses"], found["weight"]] == [2, 0, 2]
    assert found["probability"] == pytest.approx(0.845, abs=0.001)
    assert found["sigma"] == pytest.approx(1.0, abs=0.01)
    head, line = asked(capsys, folder, "hottest").splitlines()
    assert head.split() == ["x", "m", "y", "m", "z", "m", "probability", "hits", "misses", "temperature"]
    assert line.split()[3:6] == ["0.84", "2", "0"]
    assert line.endswith(" C +- 1.0")
    elsewhere = asked(capsys, folder, "hottest", "--box", "-5,-5,-5,0,0,0")
    assert elsewhere == "no occupied voxel has a temperature\n"


def test_a_slice_is_drawn_for_people_and_listed_for_programs(folder: Place, capsys: pytest.CaptureFixture[str]) -> None:
    found = answered(capsys, folder, "slice", "0.01")
    assert found["values"][0][:2] == [1, 0]
    assert found["edge_m"] == 0.05
    assert found["origin_m"] == [0.025, 0.025]
    head, *rows = asked(capsys, folder, "slice", "0.06").splitlines()
    assert head == "x 0.00 to 0.40 m, y 0.00 to 0.40 m"
    assert rows[-1] == "##"
    assert "0.4 to 0.4" not in head
    assert "probability: 0.2" in asked(capsys, folder, "slice", "0.01", "--what", "probability")
    assert answered(capsys, folder, "slice", "0.01", "--what", "probability")["values"][0][1] is None


def test_a_height_map_tells_the_highest_surfaces(folder: Place, capsys: pytest.CaptureFixture[str]) -> None:
    found = answered(capsys, folder, "height", "--box=0,0,0,1,1,1")
    assert found["values"][0][0] == pytest.approx(0.1)
    assert found["values"][0][1] is None
    assert "height in m: 0.1 to 0.1 (2 of 64 values known" in asked(capsys, folder, "height")


@pytest.mark.slow
def test_a_robot_s_state_is_read_under_the_map_s_own_sensor_model(tmp_path: Path) -> None:
    replica = opened(tmp_path)
    replica.commit({A: evidence()})
    replica.state.note_model(SensorModel(p_occupied=0.9))
    with pytest.raises(ConflictError):
        open_map(tmp_path)
    replica.close()
    assert open_map(tmp_path).model.p_occupied == 0.9
    assert len(open_map(tmp_path).occupied_in()) == 1


def test_what_is_no_map_is_refused_and_named(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="cairn map export"):
        main(["query", str(tmp_path), "height"])
    write_head(tmp_path, FolderHead(geometry=GEOMETRY))
    (tmp_path / "0_0_0.cell").write_bytes(b"no cell")
    with pytest.raises(DamagedDataError, match=r"0_0_0\.cell"):
        main(["query", str(tmp_path), "height"])


@pytest.mark.parametrize(
    "words", [["points", "1,2"], ["ray", "0,0,0"], [], ["slice", "high"], ["height", "--box", "1,2"]]
)
def test_a_question_that_is_none_is_a_wrong_usage(tmp_path: Path, words: list[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["query", str(tmp_path), *words])
    assert ended.value.code == 2


def test_points_of_a_map_with_epochs_say_when_they_were_seen(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = HistoryMap(MapLayer(geometry=GEOMETRY, epoch_s=600))
    whole.merge({A: evidence()}, epoch=Epoch(3_000_000))
    monkeypatch.setattr(query, "open_map", lambda *_, **__: snapshot_of(whole))
    point, unknown = "0.06,0.06,0.06", "9,9,9"
    found = answered(capsys, "lab", "points", point, unknown)
    assert [it["seen_s"] for it in found] == [1.8e9, None]
    lines = asked(capsys, "lab", "points", point, unknown).splitlines()
    assert [line.split()[-1] for line in lines] == ["seen", "2027-01-15T08:00Z", "-"]


def test_readings_of_a_map_with_epochs_say_how_often_and_when_they_were_measured(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = HistoryMap(MapLayer(geometry=GEOMETRY, epoch_s=600))
    whole.merge({A: evidence()}, epoch=Epoch(3_000_000))
    without = replace(evidence(), sampled=np.empty(0, np.uint32), samples=np.empty((0, 3), np.int64))
    whole.merge({A: without}, epoch=Epoch(3_000_006))
    monkeypatch.setattr(query, "open_map", lambda *_, **__: snapshot_of(whole))
    (found,) = answered(capsys, "lab", "points", "0.06,0.06,0.06")
    assert found["seen_s"] == 1.8e9 + 3600
    warm = found["readings"]["temperature"]
    assert (warm["weight"], warm["measured_s"]) == (2, 1.8e9)
    shown = "(2 of 2027-01-15T08:00Z)"
    assert shown in asked(capsys, "lab", "points", "0.06,0.06,0.06")
    assert shown in asked(capsys, "lab", "hottest")
    assert answered(capsys, "lab", "hottest")[0]["measured_s"] == 1.8e9
