from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from cairn_calib.rig.image_files import write_grey16
from cairn_calib.rig.poses import inverse, transform_from_quaternion, transform_points
from cairn_fusion.importers import SourceLayout, detect_layout, import_apc_shelf, import_mm5, open_source
from cairn_fusion.recording.frame_folder import FrameFolderOptions, import_frames
from cairn_fusion.recording.images import write_colour
from cairn_fusion.recording.pose_files import PoseConvention
from cairn_fusion.recording.recording import Recording, open_recording
from cairn_fusion.recording.recording_format import Convention, RangeEncoding, ThermalEncoding
from cairn_fusion.recording.recording_writer import RecordingWriter
from cairn_map.errors import BadInputError

WIDTH, HEIGHT = 6, 4
T_MAP_CAMERA = transform_from_quaternion((1, 2, 3), (0.5, -0.5, 0.5, 0.5))
OPTIONS = FrameFolderOptions(
    depth="f/frame-{id}.depth.png",
    colour="f/frame-{id}.rgb.png",
    thermal="f/frame-{id}.t.png",
    pose="f/frame-{id}.pose.txt",
    intrinsics_file="K.txt",
    depth_units_per_m=1000,
    kelvin_per_count=0.1,
    kelvin_at_zero=100,
    frame_rate_hz=4,
    start_time_s=50,
)


def frames_in(root: Path, ids: list[str]) -> Path:
    """A folder that fits OPTIONS; the depth of frame n is n + 1 metres, its temperature 300 + n kelvin."""
    (root / "f").mkdir(parents=True)
    np.savetxt(root / "K.txt", [[5, 0, 2.5], [0, 5, 1.5], [0, 0, 1]])
    for n, frame in enumerate(ids):
        write_grey16(root / f"f/frame-{frame}.depth.png", np.full((HEIGHT, WIDTH), 1000 * (n + 1), np.uint16))
        write_grey16(root / f"f/frame-{frame}.t.png", np.full((HEIGHT, WIDTH), 2000 + 10 * n, np.uint16))
        write_colour(root / f"f/frame-{frame}.rgb.png", np.full((HEIGHT, WIDTH, 3), (n, 100, 200), np.uint8))
        np.savetxt(root / f"f/frame-{frame}.pose.txt", T_MAP_CAMERA, fmt="%.17g")
    return root


def changed(**fields: object) -> FrameFolderOptions:
    return FrameFolderOptions.model_validate(OPTIONS.model_dump() | fields)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return frames_in(tmp_path / "data", ["000002", "000010", "000011"])


def test_a_frame_becomes_a_scan_in_our_units(folder: Path) -> None:
    recording = import_frames(folder, OPTIONS)
    scan = recording.scan(1)
    np.testing.assert_allclose(scan.range_m * recording.rig["depth"].camera.rays()[..., 2], 2.0, rtol=1e-6)
    np.testing.assert_allclose(scan.thermal["thermal"], 301.0, rtol=1e-6)
    assert scan.colour["colour"][0, 0].tolist() == [1, 100, 200]
    np.testing.assert_allclose(scan.T_map_rig, T_MAP_CAMERA, atol=1e-12)
    assert scan.time_s == 50.25


def test_the_rig_is_one_camera_at_the_origin_under_three_names(folder: Path) -> None:
    rig = import_frames(folder, OPTIONS).rig
    assert list(rig.cameras) == ["depth", "colour", "thermal"]
    assert len({mounted.camera for mounted in rig.cameras.values()}) == 1
    assert (rig["colour"].camera.width, rig["colour"].camera.focal_px) == (WIDTH, (5.0, 5.0))
    assert all(np.array_equal(mounted.transform, np.eye(4)) for mounted in rig.cameras.values())


def test_frames_are_in_order_of_number_and_not_of_spelling(tmp_path: Path) -> None:
    recording = import_frames(frames_in(tmp_path / "d", ["2", "10", "9"]), OPTIONS)
    assert [entry.range_path.name.split(".")[0] for entry in recording.files] == ["frame-2", "frame-9", "frame-10"]


def test_map_to_camera_is_the_inverse_of_camera_to_map(folder: Path) -> None:
    recording = import_frames(folder, changed(pose_convention=PoseConvention.MAP_TO_CAMERA))
    np.testing.assert_allclose(recording.scan(0).T_map_rig, inverse(T_MAP_CAMERA), atol=1e-12)


def test_depth_along_the_beam_is_taken_as_it_is(folder: Path) -> None:
    recording = import_frames(folder, changed(depth_convention=Convention.RANGE, depth_units_per_m=500))
    np.testing.assert_allclose(recording.scan(0).range_m, 2.0)


def test_one_pose_file_may_serve_all_frames(folder: Path) -> None:
    np.savetxt(folder / "pose.txt", T_MAP_CAMERA[:3], delimiter=",")  # 3x4, as KITTI has it
    recording = import_frames(folder, changed(pose="pose.txt"))
    assert all(np.allclose(scan.T_map_rig, T_MAP_CAMERA) for scan in recording)


def test_intrinsics_may_be_given_as_numbers(folder: Path) -> None:
    recording = import_frames(folder, changed(intrinsics_file=None, focal_px=(7, 8), centre_px=(2, 1)))
    assert recording.rig["depth"].camera.centre_px == (2.0, 1.0)


def test_chosen_frames_keep_their_times(folder: Path) -> None:
    recording = import_frames(folder, OPTIONS, frames=["000011", "000010"])
    assert [scan.time_s for scan in recording] == [50.25, 50.5]


@pytest.mark.parametrize("chosen", [["000010", "7"], []])
def test_frames_that_are_not_there_cannot_be_chosen(folder: Path, chosen: list[str]) -> None:
    with pytest.raises(BadInputError) as caught:
        import_frames(folder, OPTIONS, frames=chosen)
    assert caught.value.kind == "unknown_frame"


def test_scans_are_grouped_by_count(folder: Path) -> None:
    assert list(import_frames(folder, OPTIONS, scans_per_measurement=2).measurements()) == [range(0, 2), range(2, 3)]


def test_an_id_may_be_a_folder_and_stand_twice(tmp_path: Path) -> None:
    for name in ("7", "8"):
        (tmp_path / name).mkdir()
        write_grey16(tmp_path / name / f"d{name}.png", np.ones((HEIGHT, WIDTH), np.uint16))
    write_grey16(tmp_path / "7" / "d8.png", np.ones((HEIGHT, WIDTH), np.uint16))
    np.savetxt(tmp_path / "pose.txt", np.eye(4))
    options = FrameFolderOptions(depth="./{id}/d{id}.png", pose="pose.txt", focal_px=(5, 5), centre_px=(2, 2))
    recording = import_frames(tmp_path, options)
    assert [entry.range_path.parent.name for entry in recording.files] == ["7", "8"]
    assert list(recording.rig.cameras) == ["depth"]


def test_glob_characters_in_a_pattern_mean_themselves(tmp_path: Path) -> None:
    write_grey16(tmp_path / "[d]7.png", np.ones((HEIGHT, WIDTH), np.uint16))
    write_grey16(tmp_path / "d8.png", np.ones((HEIGHT, WIDTH), np.uint16))
    np.savetxt(tmp_path / "pose.txt", np.eye(4))
    options = FrameFolderOptions(depth="[d]{id}.png", pose="pose.txt", focal_px=(5, 5), centre_px=(2, 2))
    assert len(import_frames(tmp_path, options)) == 1


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("f/frame-000010.rgb.png", "missing_image"),
        ("f/frame-000010.t.png", "missing_image"),
        ("f/frame-000010.pose.txt", "missing_file"),
        ("K.txt", "missing_file"),
    ],
)
def test_a_frame_that_lacks_a_file_is_refused(folder: Path, name: str, kind: str) -> None:
    (folder / name).unlink()
    with pytest.raises(BadInputError, match=Path(name).name) as caught:
        import_frames(folder, OPTIONS)
    assert caught.value.kind == kind


def test_a_pattern_that_fits_nothing_is_refused(folder: Path) -> None:
    with pytest.raises(BadInputError) as caught:
        import_frames(folder, changed(depth="f/{id}.exr"))
    assert caught.value.kind == "no_frames"


@pytest.mark.parametrize("pattern", ["../data/f/frame-{id}.depth.png", "/{id}.png"])
def test_a_pattern_does_not_leave_the_folder(folder: Path, pattern: str) -> None:
    with pytest.raises(BadInputError) as caught:
        import_frames(folder, changed(depth=pattern))
    assert caught.value.kind == "unsafe_path"


def test_an_image_that_links_to_the_outside_is_refused(folder: Path) -> None:
    image = folder / "f/frame-000010.rgb.png"
    image.rename(folder.parent / "secret.png")
    image.symlink_to(folder.parent / "secret.png")
    with pytest.raises(BadInputError) as caught:
        import_frames(folder, OPTIONS)
    assert caught.value.kind == "unsafe_path"


def test_an_image_of_another_raster_is_not_registered(folder: Path) -> None:
    write_colour(folder / "f/frame-000002.rgb.png", np.zeros((8, 12, 3), np.uint8))
    with pytest.raises(BadInputError, match="must be 6 x 4 pixels, got 12 x 8"):
        import_frames(folder, OPTIONS).scan(0)


@pytest.mark.parametrize(
    ("frames", "expected"),
    [
        (["2-9"], ["2", "9"]),
        (["9-10", "2"], ["2", "9", "10"]),
        (["10-10"], ["10"]),
        (["0-999999999999999999"], ["2", "9", "10"]),
        (["3-4"], ["3-4"]),
        (["a"], ["a"]),
    ],
)
def test_frames_are_chosen_by_id_and_by_range(tmp_path: Path, frames: list[str], expected: list[str]) -> None:
    folder = frames_in(tmp_path / "d", ["2", "10", "9", "3-4", "a"])
    chosen = import_frames(folder, OPTIONS, frames=frames)
    assert [entry.range_path.name.removeprefix("frame-").split(".")[0] for entry in chosen.files] == expected
    everything = import_frames(folder, OPTIONS)
    times = {entry.range_path: entry.time_s for entry in everything.files}
    assert [entry.time_s for entry in chosen.files] == [times[entry.range_path] for entry in chosen.files]


@pytest.mark.parametrize("frames", [[], ["5-8"], ["10-9"], ["2", "b"], ["2-"], ["-2"]])
def test_a_choice_of_no_frame_is_refused(tmp_path: Path, frames: list[str]) -> None:
    with pytest.raises(BadInputError) as refused:
        import_frames(frames_in(tmp_path / "d", ["2", "10"]), OPTIONS, frames=frames)
    assert refused.value.kind == "unknown_frame"
    assert "2 frames, 2 to 10" in refused.value.message


def test_a_file_that_is_no_bag_is_not_called_a_folder_that_is_missing(tmp_path: Path) -> None:
    (tmp_path / "scan.pcd").write_text("VERSION 0.7")
    with pytest.raises(BadInputError, match=r"scan\.pcd is one cloud of points") as refused:
        detect_layout(tmp_path / "scan.pcd")
    assert refused.value.kind == "unknown_layout"


@pytest.mark.parametrize("name", ["drive.pcap", "drive.PCAPNG", "drive.osf"])
def test_raw_packets_are_told_with_the_tool_that_makes_points_of_them(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(b"\xd4\xc3\xb2\xa1")
    with pytest.raises(BadInputError, match="raw packets of a lidar: make points of them first"):
        detect_layout(tmp_path / name)


def test_rotations_that_are_off_by_rounding_are_mapped_and_told(folder: Path) -> None:
    for n, (frame, scale) in enumerate((("000002", 1 + 4e-4), ("000010", 1 + 1e-4))):
        rounded = T_MAP_CAMERA.copy()
        rounded[:3, :3] *= scale
        np.savetxt(folder / f"f/frame-{frame}.pose.txt", rounded, fmt="%.9g")
        recording = import_frames(folder, OPTIONS)
        np.testing.assert_allclose(recording.scan(n).T_map_rig, T_MAP_CAMERA, atol=1e-8)
    text = recording.rounding.text()
    assert text is not None
    assert text.startswith("2 of 3 poses")
    assert text.endswith("frame-000002.pose.txt")


@pytest.mark.parametrize(
    ("name", "text", "kind"),
    [
        ("K.txt", "5 0 2 0 5 2 0 0", "bad_intrinsics"),
        ("K.txt", "5 1 2 0 5 2 0 0 1", "bad_intrinsics"),
        ("K.txt", "-5 0 2 0 5 2 0 0 1", "bad_intrinsics"),
        ("K.txt", "five", "bad_matrix"),
        ("K.txt", "nan 0 2 0 5 2 0 0 1", "bad_matrix"),
        ("f/frame-000010.pose.txt", "1 2 3", "bad_transform"),
        ("f/frame-000010.pose.txt", "2 0 0 0 0 2 0 0 0 0 2 0", "bad_transform"),
        ("f/frame-000010.pose.txt", "inf " * 12, "bad_matrix"),
    ],
)
def test_a_matrix_that_is_none_is_refused_by_name(folder: Path, name: str, text: str, kind: str) -> None:
    (folder / name).write_text(text)
    with pytest.raises(BadInputError, match=Path(name).name) as caught:
        import_frames(folder, OPTIONS)
    assert caught.value.kind == kind


@pytest.mark.parametrize(
    "fields",
    [
        {"depth": "depth.png"},
        {"colour": "colour.png"},
        {"intrinsics_file": None},
        {"focal_px": (5, 5)},
        {"focal_px": (5, 5), "centre_px": (2, 2)},
        {"intrinsics_file": None, "focal_px": (0, 5), "centre_px": (2, 2)},
        {"depth_units_per_m": 0},
        {"frame_rate_hz": float("inf")},
        {"pose_convention": "camera"},
        {"typo": 1},
    ],
)
def test_options_that_contradict_themselves_are_refused(fields: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        changed(**fields)


# --- layouts


def test_an_unknown_folder_is_told_what_was_looked_for(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match=r"recording\.json; apc_shelf: K_color\.txt and .*K_approx\.txt") as caught:
        detect_layout(tmp_path)
    assert caught.value.kind == "unknown_layout"


def test_options_open_any_folder(folder: Path) -> None:
    assert len(open_source(folder, options=OPTIONS, scans_per_measurement=3).measurements()) == 1


def test_a_group_of_no_frames_is_refused(folder: Path) -> None:
    with pytest.raises(BadInputError):
        open_source(folder, options=OPTIONS, scans_per_measurement=0)


def test_an_unfinished_recording_is_told_apart_from_an_unknown_folder(tmp_path: Path) -> None:
    (tmp_path / "rig.json").write_text("{}")
    with pytest.raises(BadInputError) as caught:
        open_source(tmp_path)
    assert caught.value.kind == "unfinished_recording"


def rewritten(source: Recording, folder: Path) -> Recording:
    """The source as a recording of our own format, in the source's own units."""
    with RecordingWriter(
        folder,
        source.rig,
        name=source.name,
        note=source.note,
        range_encoding=source.range_encodings["depth"],
        thermal_encoding=source.thermal_encodings["thermal"],
    ) as recording:
        for scan in source:
            recording.add(scan)
    return open_recording(folder)


def test_an_imported_folder_can_be_written_as_a_recording_and_nothing_is_lost(folder: Path, tmp_path: Path) -> None:
    source = import_frames(folder, OPTIONS)
    copy = rewritten(source, tmp_path / "copy")
    assert detect_layout(tmp_path / "copy") is SourceLayout.RECORDING
    assert len(open_source(tmp_path / "copy")) == len(source)
    with pytest.raises(BadInputError):
        open_source(tmp_path / "copy", frames=["000002"])
    for ours, theirs in zip(copy, source, strict=True):
        assert np.array_equal(ours.range_m, theirs.range_m)
        assert np.array_equal(ours.thermal["thermal"], theirs.thermal["thermal"])
        assert np.array_equal(ours.colour["colour"], theirs.colour["colour"])


# --- real recordings


def points_in_map(recording: Recording, index: int) -> np.ndarray:
    scan = recording.scan(index)
    rays = recording.rig["depth"].camera.rays()
    return transform_points(scan.T_map_rig, rays * scan.range_m[..., None])


@pytest.mark.recording
def test_the_shelf_has_fifteen_scans_with_colour(test_data: Path) -> None:
    source = open_source(test_data / "apc_shelf_rgbd")
    assert detect_layout(test_data / "apc_shelf_rgbd") is SourceLayout.APC_SHELF
    assert (source.name, len(source), list(source.rig.cameras)) == ("apc_shelf", 15, ["depth", "colour"])
    for scan in source:
        seen = scan.range_m[np.isfinite(scan.range_m)]
        assert seen.size > 0.2 * scan.range_m.size
        assert 0.2 < np.median(seen) < 1.5


@pytest.mark.recording
def test_neighbouring_views_of_the_shelf_agree_in_the_map(test_data: Path) -> None:
    """Shows that units, pose direction and z-depth are right together; SOURCE.md has 4 mm, and 240 mm when inverted."""
    source = import_apc_shelf(test_data / "apc_shelf_rgbd")
    errors_m = []
    for first, second in ((0, 1), (6, 7), (10, 11)):
        camera = source.rig["depth"].camera
        scan = source.scan(second)
        p_camera = transform_points(inverse(scan.T_map_rig), points_in_map(source, first).reshape(-1, 3))
        p_camera = p_camera[np.isfinite(p_camera).all(axis=1)]
        pixels = camera.project(p_camera)
        inside = camera.contains(pixels)
        x, y = np.rint(pixels[inside]).astype(int).T
        expected_m = np.linalg.norm(p_camera[inside], axis=1)
        errors_m.append(np.nanmedian(np.abs(scan.range_m[y, x] - expected_m)))
    assert max(errors_m) < 0.008


@pytest.mark.recording
def test_the_turntable_of_mm5_lies_at_height_zero(test_data: Path) -> None:
    source = open_source(test_data / "mm5_rgbdt")
    assert detect_layout(test_data / "mm5_rgbdt") is SourceLayout.MM5
    assert (len(source), list(source.rig.cameras)) == (30, ["depth", "colour", "thermal"])
    points = points_in_map(source, 0)
    on_disc = np.hypot(points[..., 0], points[..., 1]) < 0.27  # its radius is 0.28 m; the table around lies 6 cm lower
    counts, edges_m = np.histogram(points[on_disc][:, 2], bins=np.arange(-0.305, 0.31, 0.01))
    assert abs(edges_m[counts.argmax()] + 0.005) < 0.015


@pytest.mark.recording
def test_the_hot_cups_of_mm5_are_hot_and_the_room_is_not(test_data: Path) -> None:
    source = import_mm5(test_data / "mm5_rgbdt", frames=["000098"])
    kelvin = source.scan(0).thermal["thermal"]
    assert len(source) == 1
    assert 283 < np.nanmedian(kelvin) < 292
    assert 310 < np.nanmax(kelvin) < 355
    assert "inferred" in source.note


@pytest.mark.recording
def test_real_frames_rewritten_as_a_recording_lose_nothing(test_data: Path, tmp_path: Path) -> None:
    source = import_mm5(test_data / "mm5_rgbdt", frames=["000098", "000099"])
    assert source.range_encodings["depth"] == RangeEncoding(units_per_m=1000, convention=Convention.Z)
    assert source.thermal_encodings["thermal"] == ThermalEncoding(kelvin_per_count=1 / 64)
    for ours, theirs in zip(rewritten(source, tmp_path / "copy"), source, strict=True):
        assert np.array_equal(ours.range_m, theirs.range_m, equal_nan=True)
        assert np.array_equal(ours.thermal["thermal"], theirs.thermal["thermal"])
        np.testing.assert_allclose(ours.T_map_rig, theirs.T_map_rig, atol=1e-9, rtol=0)
