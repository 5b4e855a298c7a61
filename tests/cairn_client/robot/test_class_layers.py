"""A layer of classes, end to end: defined on the command line, counted from label images, folded, read and exported."""

import io
import json
from dataclasses import replace
from pathlib import Path

import httpx
import laspy
import numpy as np
import pytest
from tests.fixtures.client.live_server import LiveServer
from tests.fixtures.client.made import MAP
from tests.fixtures.client.robot_program import INTEGRATOR, RIG, scan_of
from tests.fixtures.commands import cairn
from tests.fixtures.fusion.bags import write_bag
from tests.fixtures.fusion.drive_mapping import LABELLED, mapping_text
from tests.fixtures.fusion.live_drive import drive, in_bag_order
from tests.fixtures.fusion.live_drive import labelled as labelled_drive

from cairn_client.folders.map_folder import open_layers, open_map
from cairn_client.http.api import MapApi
from cairn_client.robot.robot import Robot
from cairn_fusion.recording.recording_writer import RecordingWriter
from cairn_fusion.recording.scan import Scan
from cairn_map.errors import BadInputError, ConflictError
from cairn_map.evidence.channels import Channel, class_colours, classes_channel
from cairn_map.evidence.grid import Geometry
from cairn_map.wire.layer_messages import AddLayer

FORMS = ("npz", "ply", "pcd", "laz")
TABLE = {0: None, 3: "wall", 7: "other", 9: "chair"}


def labelled(seed: int, image: np.ndarray | None = None, **changes: object) -> Scan:
    """A scan of which the left half shows a wall, and the right a chair; its first pixel says nothing."""
    labels = np.full((3, 4), 3, np.uint8)
    labels[:, 2:] = 9
    labels[0, 0] = 0
    fields = {"labels": {"tof": labels if image is None else image}, "label_names": TABLE} | changes
    return replace(scan_of(seed), **fields)


def add_layer(server: LiveServer, folder: Path, *options: str) -> str:
    said = cairn("map", "layer", "add", server.map_url, "things", "--voxel", "0.05", *options, folder=folder)
    assert "\nclasses wall, chair, other\n" in said
    return f"{server.map_url}.things"


def test_labels_of_scans_become_classes_that_anyone_asks_for(server: LiveServer, tmp_path: Path) -> None:
    names = tmp_path / "classes.txt"
    names.write_text("# of the site\nwall\n\nchair\n", encoding="utf-8")
    url = add_layer(server, tmp_path, "--classes", str(names))
    with Robot(RIG, url, directory=tmp_path / "mole", name="mole", integrator=INTEGRATOR) as robot:
        for seed in (1, 1, 2):
            robot.observe(replace(labelled(seed), time_s=1.5e9 + 10 * seed))
            robot.commit()
        robot.sync(until_folded=True)
        own = robot.snapshot().class_at(robot.snapshot().occupied_in().centres_m)
    # The server's map says what the robot's does; unknown places have no class.
    points = open_map(url).occupied_in().centres_m
    found = open_map(url).class_at(points)
    assert found.class_names == own.class_names
    assert {"wall", "chair"} <= set(found.class_names)
    assert open_map(url).class_at([[90.0, 0, 0]]).class_names == [None]
    # Of the map's layers the one with classes answers.
    assert open_layers(server.map_url).class_at(points).class_names == found.class_names

    texts = [",".join(map(str, point)) for point in points[:3].tolist()]
    said = json.loads(cairn("map", "query", url, "points", *texts, "--json", folder=tmp_path))
    readings = [each["readings"]["classes"] for each in said]
    assert [each and each["class"] for each in readings] == found.class_names[:3]
    assert [each and each["unsure"] for each in readings] == found.unsure[:3].tolist()


def test_a_layer_of_classes_is_drawn_saved_and_told_apart_by_old_clients(server: LiveServer, tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "labelled", RIG, name="labelled") as recording:
        for seed in (1, 2):
            recording.add(labelled(seed))
    url = add_layer(server, tmp_path, "--classes", "wall,chair")
    cairn("robot", "replay", "labelled", "--map", url, "--name", "mole", folder=tmp_path)
    snapshot = open_map(url)
    points = snapshot.occupied_in().centres_m
    found = snapshot.class_at(points)
    assert {"wall", "chair"} <= set(found.class_names)

    # Files: a column of numbers, and their names.
    cairn("map", "export", url, "--ply", "things.ply", "--npz", "things.npz", folder=tmp_path)
    assert b"comment class 1 chair\n" in (tmp_path / "things.ply").read_bytes()
    with np.load(tmp_path / "things.npz") as saved:
        names, numbers = saved["classes_names"], saved["classes_mean"]
        assert {names[int(number)] for number in numbers[~np.isnan(numbers)]} == {*found.class_names} - {None}
    # The server's own files of a part: the same, and in the colours of the classes.
    files = {form: httpx.get(f"{url}/main/export", params={"format": form}).content for form in FORMS}
    rows = np.load(io.BytesIO(files["npz"]))["points"]
    again = snapshot.class_at(np.stack([rows[axis] for axis in "xyz"], axis=1))
    assert np.array_equal(rows["class"], again.mean.astype(np.float32), equal_nan=True)
    assert again.unsure is not None and rows["unsure"].tolist() == again.unsure.tolist()
    drawn, is_known = np.stack([rows[name] for name in ("red", "green", "blue")], axis=1), again.weight > 0
    assert (drawn[is_known] == class_colours(3)[again.mean[is_known].astype(int)]).all()
    assert b"comment class 1 chair\n" in files["ply"] and b"# class 1 chair\n" in files["pcd"]
    laz = laspy.read(io.BytesIO(files["laz"]))
    assert np.array_equal(laz["class"], rows["class"], equal_nan=True)
    # A picture in their colours, and one voxel.
    eye, target = ((points[0] + step).tolist() for step in ([0.0, 0.0, 1.0], [0.0, 0.0, 0.0]))
    where = ("--from", ",".join(map(str, eye)), "--to", ",".join(map(str, target)), "--size", "32x24")
    cairn("map", "render", url, *where, "--layer", "colour", "-o", "view.png", "--npz", "view.npz", folder=tmp_path)
    with np.load(tmp_path / "view.npz") as saved:
        seen = saved["colour"].reshape(-1, 3)
    assert {*map(tuple, seen[~np.isnan(seen[:, 0])].astype(int).tolist())} <= {*map(tuple, class_colours(3).tolist())}
    at = ",".join(f"{value:.9f}" for value in points[0])
    (reading,) = httpx.get(f"{url}/main/voxels", params={"at": at}).json()["channels"]
    assert (reading.get("class_name"), reading["kind"]) == (found.class_names[0], "classes")

    # Clients that know no classes are not shown what they cannot read.
    for known, names in (("4", {MAP}), ("5", {MAP, f"{MAP}.things"})):
        headers = {"Cairn-Format": known}
        listed = httpx.get(f"{server.url}/maps", headers=headers).json()
        assert {each["name"] for each in listed} == names
        layers = httpx.get(f"{server.map_url}/layers", headers=headers).json()
        assert {each["map"] for each in layers} == names


def test_label_images_of_a_bag_become_classes(server: LiveServer, tmp_path: Path) -> None:
    url = add_layer(server, tmp_path, "--classes", "wall,chair")
    write_bag(tmp_path / "drive", "mcap", lambda make: in_bag_order(labelled_drive(make, drive(make, scans=3))))
    (tmp_path / "topics.yaml").write_text(mapping_text(**LABELLED))
    bag = ("drive/drive.mcap", "--topics", "topics.yaml")
    cairn("robot", "replay", *bag, "--map", url, "--name", "mole", folder=tmp_path)
    snapshot = open_map(url)
    found = snapshot.class_at(snapshot.occupied_in().centres_m)
    assert {"wall", "chair"} <= {*found.class_names} <= {"wall", "chair", None}


def test_a_retract_takes_the_votes_out_again(server: LiveServer, tmp_path: Path) -> None:
    url = add_layer(server, tmp_path, "--classes", "wall,chair")
    with Robot(RIG, url, directory=tmp_path / "mole", name="mole", integrator=INTEGRATOR) as robot:
        robot.observe(labelled(1))
        robot.commit()
        robot.sync(until_folded=True)
        (before,) = open_map(url).frozen.cells[:1]
        robot.observe(labelled(1, np.full((3, 4), 9, np.uint8)))
        second = robot.commit()
        robot.sync(until_folded=True)
        assert second is not None
        robot.retract(second)
        robot.sync(until_folded=True)
        assert open_map(url).frozen.cells[0].packed() == before.packed()


def test_labels_that_fit_nothing_are_refused_and_nothing_is_lost(server: LiveServer, tmp_path: Path) -> None:
    geometry = Geometry(voxel_edge_um=50_000, channels=(classes_channel(("wall", "chair")),))
    with Robot(RIG, server.map_url, directory=tmp_path / "mole", name="mole", geometry=geometry) as robot:
        robot.observe(labelled(1))
        for scan, kind in (
            (labelled(1, np.full((3, 4), 4, np.uint8)), "unknown_label"),
            (labelled(1, label_names=TABLE | {3: "wal"}), "unknown_class"),
            (labelled(1, np.zeros((4, 3), np.uint8)), "image_size"),
        ):
            with pytest.raises(BadInputError) as refused:
                robot.observe(scan)
            assert refused.value.kind == kind
        assert (commit := robot.commit()) is not None and len(commit.meta.scans) == 1


def test_classes_that_cannot_be_are_refused(server: LiveServer, tmp_path: Path) -> None:
    for names in ("wall,wall", "2nd", "other,wall", "", ",".join(f"c{n}" for n in range(64)), "no/such/file"):
        options = ("--voxel", "0.05", "--classes", names)
        said = cairn("map", "layer", "add", server.map_url, "things", *options, folder=tmp_path, code=1)
        assert "bad_classes" in said
    with MapApi(server.url) as api:
        assert [layer.name for layer in api.layers(MAP)] == ["evidence"]


def test_another_list_under_one_name_is_another_layer(server: LiveServer, tmp_path: Path) -> None:
    add_layer(server, tmp_path, "--classes", "wall,chair")

    def add(channel: Channel) -> None:
        geometry = Geometry(voxel_edge_um=50_000, channels=(channel,))
        with MapApi(server.url) as api:
            api.add_layer(MAP, AddLayer(name="things", geometry=geometry))

    add(classes_channel(("wall", "chair")))  # the same: no other layer
    with pytest.raises(ConflictError) as refused:
        add(classes_channel(("chair", "wall")))
    assert refused.value.kind == "other_layer"
