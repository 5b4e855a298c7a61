import json
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cairn_calib.rig.camera import Camera, camera_from_field_of_view
from cairn_calib.rig.image_files import write_grey16
from cairn_calib.rig.poses import transform_from_quaternion
from cairn_calib.rig.rig import Rig, Spectrum, mount_camera
from cairn_fusion.recording.images import write_colour
from cairn_fusion.recording.recording import Recording, ScanSource, open_recording
from cairn_fusion.recording.recording_format import Convention, RangeEncoding, ThermalEncoding, path_inside
from cairn_fusion.recording.recording_writer import RecordingWriter
from cairn_fusion.recording.scan import Scan
from cairn_map.errors import BadInputError, CairnError, ConflictError, DamagedDataError, NotFoundError

START_S = 1_700_000_000.0
TOF = camera_from_field_of_view(8, 6, horizontal_deg=60)
CCD = camera_from_field_of_view(10, 7, horizontal_deg=70)
RIG = Rig(
    name="head",
    cameras={
        "tof": mount_camera(Spectrum.RANGE, TOF, np.eye(4)),
        "left": mount_camera(Spectrum.COLOUR, CCD, np.eye(4)),
        "ir": mount_camera(Spectrum.THERMAL, TOF, np.eye(4)),
    },
)


def random_scan(seed: int, *, time_s: float | None = None) -> Scan:
    rng = np.random.default_rng(seed)
    q = rng.normal(size=4)
    range_m = rng.uniform(0.2, 12, (TOF.height, TOF.width)).astype(np.float32)
    kelvin = rng.uniform(250, 400, (TOF.height, TOF.width)).astype(np.float32)
    range_m[rng.random(range_m.shape) < 0.2] = np.nan
    kelvin[rng.random(kelvin.shape) < 0.1] = np.nan
    return Scan(
        time_s=START_S + seed / 3 if time_s is None else time_s,
        T_map_rig=transform_from_quaternion(rng.normal(size=3) * 1000, q / np.linalg.norm(q)),
        range_camera="tof",
        range_m=range_m,
        amplitude=rng.integers(0, 65535, range_m.shape, dtype=np.uint16),
        colour={"left": rng.integers(0, 255, (CCD.height, CCD.width, 3), dtype=np.uint8)},
        thermal={"ir": kelvin},
        scalars={"dose": float(rng.normal()), "gas.co": 0.5},
    )


def written(folder: Path, scans: Sequence[Scan], **options: object) -> Path:
    with RecordingWriter(folder, RIG, name="lab-1", **options) as recording:  # type: ignore[arg-type]
        for scan in scans:
            recording.add(scan)
    return folder


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A sound recording of three scans at START_S + 0, 1/3, 2/3."""
    return written(tmp_path / "lab", [random_scan(n) for n in range(3)])


def change_header(folder: Path, **fields: object) -> None:
    path = folder / "recording.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | fields))


def first_line_with(path: Path, relative: str) -> None:
    """The list's first entry, with another path."""
    head, entry, *rest = path.read_text().splitlines()
    path.write_text("\n".join([head, f"{entry.split()[0]} {relative}", *rest]) + "\n")


# --- writing and reading


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**31), convention=st.sampled_from(Convention))
def test_a_scan_reads_back_within_its_quantisation(
    tmp_path_factory: pytest.TempPathFactory, seed: int, convention: Convention
) -> None:
    scan = random_scan(seed)
    encoding = RangeEncoding(units_per_m=4000, convention=convention)
    path = written(tmp_path_factory.mktemp("r") / "lab", [scan], range_encoding=encoding)
    (read,) = open_recording(path)
    assert read.time_s == scan.time_s
    np.testing.assert_allclose(read.T_map_rig, scan.T_map_rig, atol=1e-9, rtol=0)
    half_unit_m = 0.5 / 4000 / TOF.rays()[..., 2].min() + 1e-6
    np.testing.assert_allclose(read.range_m, scan.range_m, atol=half_unit_m, rtol=0)
    np.testing.assert_allclose(read.thermal["ir"], scan.thermal["ir"], atol=0.005 + 1e-4, rtol=0)
    assert np.array_equal(read.colour["left"], scan.colour["left"])
    assert read.amplitude is not None and np.array_equal(read.amplitude, scan.amplitude)  # type: ignore[arg-type]
    assert read.scalars == scan.scalars


def test_a_second_writing_of_what_was_read_is_byte_equal(folder: Path, tmp_path: Path) -> None:
    again = written(tmp_path / "again", list(open_recording(folder)))
    files = sorted(path.relative_to(folder) for path in folder.rglob("*") if path.is_file())
    assert files == sorted(path.relative_to(again) for path in again.rglob("*") if path.is_file())
    for name in set(files) - {Path("trajectory.txt")}:  # a quaternion may differ in its last digit
        assert (folder / name).read_bytes() == (again / name).read_bytes(), name


def test_the_bodys_pose_comes_back_and_old_recordings_have_none(folder: Path, tmp_path: Path) -> None:
    assert not (folder / "trajectory.body.txt").exists()
    assert all(scan.T_map_body is None for scan in open_recording(folder))
    bodies = [transform_from_quaternion((n, 2.0, 3.0), (0, 0, 0.6, 0.8)) for n in range(3)]
    scans = [replace(random_scan(n), T_map_body=T) for n, T in enumerate(bodies)]
    path = written(tmp_path / "body", scans)
    for read, T in zip(open_recording(path), bodies, strict=True):
        assert read.T_map_body is not None
        np.testing.assert_allclose(read.T_map_body, T, atol=1e-9)
    (path / "trajectory.body.txt").write_text(f"{scans[0].time_s!r} 0 0 0 0 0 0 1\n")
    with pytest.raises(BadInputError, match="body"):
        open_recording(path)


@pytest.mark.parametrize("first", [None, np.eye(4)])
def test_only_some_scans_with_a_bodys_pose_are_refused(tmp_path: Path, first: object) -> None:
    scans = [replace(random_scan(0), T_map_body=first), random_scan(1)]  # type: ignore[arg-type]
    scans[1] = replace(scans[1], T_map_body=np.eye(4) if first is None else None)
    with pytest.raises(BadInputError, match="body"):
        written(tmp_path / "some", scans)


def test_a_camera_may_be_called_body(tmp_path: Path) -> None:
    rig = Rig(name="head", cameras={"body": mount_camera(Spectrum.RANGE, TOF, np.eye(4))})
    scan = replace(random_scan(0), range_camera="body", colour={}, thermal={}, T_map_body=np.eye(4))
    with RecordingWriter(tmp_path / "r", rig, name="r") as recording:
        recording.add(scan)
    (read,) = open_recording(tmp_path / "r")
    assert read.range_camera == "body" and read.T_map_body is not None


def test_a_recording_is_a_scan_source(folder: Path) -> None:
    source: ScanSource = open_recording(folder)
    assert (source.name, source.rig, len(source), len(list(source))) == ("lab-1", RIG, 3, 3)


def test_images_are_read_only_when_asked_for(folder: Path) -> None:
    recording = open_recording(folder)
    (folder / "images/left/000002.png").unlink()
    assert recording.scan(1).time_s == START_S + 1 / 3
    with pytest.raises(BadInputError) as caught:
        recording.scan(2)
    assert caught.value.kind == "missing_image"


@pytest.mark.parametrize("index", [-1, 3])
def test_a_scan_that_is_not_there_is_not_found(folder: Path, index: int) -> None:
    with pytest.raises(NotFoundError):
        open_recording(folder).scan(index)


def test_a_recording_without_scans_is_empty(tmp_path: Path) -> None:
    recording = open_recording(written(tmp_path / "lab", []))
    assert (len(recording), list(recording.measurements())) == (0, [])


def test_a_scan_without_colour_reads_back_without(tmp_path: Path) -> None:
    bare = Scan(time_s=START_S, T_map_rig=np.eye(4), range_camera="tof", range_m=random_scan(0).range_m)
    first, second = open_recording(written(tmp_path / "lab", [bare, random_scan(1)]))
    assert (dict(first.colour), dict(first.thermal), first.amplitude, dict(first.scalars)) == ({}, {}, None, {})
    assert set(second.colour) == {"left"}


def test_the_note_and_encodings_come_back(tmp_path: Path) -> None:
    thermal = ThermalEncoding(kelvin_per_count=1 / 64, kelvin_at_zero=100)
    recording = open_recording(written(tmp_path / "r", [random_scan(0)], note="warm day", thermal_encoding=thermal))
    assert (recording.note, dict(recording.thermal_encodings)) == ("warm day", {"ir": thermal})


# --- measurements


def test_each_scan_is_its_own_measurement_unless_told(folder: Path) -> None:
    assert list(open_recording(folder).measurements()) == [range(0, 1), range(1, 2), range(2, 3)]


def test_measurements_come_back_as_they_were_ended(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "lab", RIG, name="lab") as recording:
        recording.end_measurement()  # nothing yet: nothing ends
        for n in range(5):
            recording.add(random_scan(n))
            if n in (1, 2):
                recording.end_measurement()
    assert list(open_recording(tmp_path / "lab").measurements()) == [range(0, 2), range(2, 3), range(3, 5)]


def test_the_reader_may_group_by_count(folder: Path) -> None:
    assert list(open_recording(folder, scans_per_measurement=2).measurements()) == [range(0, 2), range(2, 3)]


def test_a_group_of_no_scans_is_refused(folder: Path) -> None:
    with pytest.raises(BadInputError) as caught:
        open_recording(folder, scans_per_measurement=0)
    assert caught.value.kind == "bad_measurement"


@pytest.mark.parametrize(
    "intervals",
    [
        [(0.0, 0.4)],  # leaves a scan out at the end
        [(0.2, 0.8)],  # and at the start
        [(0.0, 0.1), (0.2, 0.3), (0.3, 0.8)],  # holds none
        [(0.0, 0.4), (0.0, 0.8)],  # overlaps
        [(0.8, 0.0)],
    ],
)
def test_measurements_that_do_not_divide_the_scans_are_refused(
    folder: Path, intervals: list[tuple[float, float]]
) -> None:
    text = "".join(f"{START_S + first!r} {START_S + last!r}\n" for first, last in intervals)
    (folder / "measurements.txt").write_text(text)
    with pytest.raises(BadInputError, match=r"measurements\.txt") as caught:
        open_recording(folder)
    assert caught.value.kind == "bad_recording"


# --- finding images and poses in time


def hand_made(folder: Path, **header: object) -> Path:
    """Range images at 0, 1, 2 s; colour at 0.1 and 1.5 s; poses at 0 and 2 s, 4 m apart."""
    (folder / "images").mkdir(parents=True)
    for n in range(3):
        write_grey16(folder / f"images/r {n}.png", np.full((TOF.height, TOF.width), 1000 + n, np.uint16))
    for n in range(2):
        write_colour(folder / f"images/c{n}.png", np.full((CCD.height, CCD.width, 3), n, np.uint8))
    (folder / "rig.json").write_bytes(RIG.to_json())
    (folder / "tof.txt").write_text("".join(f"{n} images/r {n}.png\n" for n in range(3)))
    (folder / "left.txt").write_text("0.1\timages/c0.png\n1.5 images/c1.png\n")
    (folder / "trajectory.txt").write_text("0 0 0 0 0 0 0 1\n2 4 0 0 0 0 0 1\n")
    fields = {"format": "cairn-recording", "version": 1, "name": "h", "range": {"tof": {}}, "colour": ["left"]}
    (folder / "recording.json").write_text(json.dumps(fields | header))
    return folder


def colours(recording: Recording) -> list[int | None]:
    return [int(scan.colour["left"][0, 0, 0]) if scan.colour else None for scan in recording]


def test_images_go_to_the_scan_nearest_in_time_within_the_gap(tmp_path: Path) -> None:
    recording = open_recording(hand_made(tmp_path / "h", max_gap_s=0.2, max_pose_gap_s=2))
    assert colours(recording) == [0, None, None]


def test_an_image_may_serve_two_scans(tmp_path: Path) -> None:
    assert colours(open_recording(hand_made(tmp_path / "h", max_gap_s=0.5, max_pose_gap_s=2))) == [0, 1, 1]


def test_without_a_gap_only_equal_times_match(tmp_path: Path) -> None:
    assert colours(open_recording(hand_made(tmp_path / "h", max_pose_gap_s=2))) == [None, None, None]


def test_a_pose_between_two_others_is_interpolated(tmp_path: Path) -> None:
    recording = open_recording(hand_made(tmp_path / "h", max_pose_gap_s=2))
    np.testing.assert_allclose([scan.T_map_rig[0, 3] for scan in recording], [0, 2, 4])


def test_a_scan_without_a_pose_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadInputError) as caught:
        open_recording(hand_made(tmp_path / "h", max_pose_gap_s=1.9))
    assert caught.value.kind == "no_pose"


def test_range_cameras_that_fire_together_make_a_scan_each(tmp_path: Path) -> None:
    folder = hand_made(tmp_path / "h", range={"back": {}, "tof": {}}, max_pose_gap_s=2)
    rig = Rig(name="two", cameras={**RIG.cameras, "back": RIG["tof"]})
    (folder / "rig.json").write_bytes(rig.to_json())
    (folder / "back.txt").write_text("1 images/r 0.png\n1.5 images/r 1.png\n")
    recording = open_recording(folder)
    assert [(scan.time_s, scan.range_camera) for scan in recording] == [
        (0.0, "tof"),
        (1.0, "back"),
        (1.0, "tof"),
        (1.5, "back"),
        (2.0, "tof"),
    ]


def test_z_depth_and_range_differ_away_from_the_axis(tmp_path: Path) -> None:
    encodings = [{"tof": {"units_per_m": 500, "convention": convention}} for convention in ("z", "range")]
    folders = [hand_made(tmp_path / str(n), range=e, max_pose_gap_s=2) for n, e in enumerate(encodings)]
    z, along = (open_recording(path).scan(0).range_m for path in folders)
    np.testing.assert_allclose(along, 2.0)
    np.testing.assert_allclose(z * TOF.rays()[..., 2], 2.0, rtol=1e-6)


# --- recordings that are wrong, or hostile


@pytest.mark.parametrize(
    "relative",
    [
        "../secret.png",
        "images/../../secret.png",
        "/etc/hostname",
        "images\\..\\x.png",
        "link/secret.png",
        "link.png",
        "a\x00b",
    ],
)
def test_no_path_leads_out_of_the_folder(folder: Path, relative: str) -> None:
    outside = folder.parent / "outside"
    outside.mkdir()
    write_grey16(outside / "secret.png", np.ones((TOF.height, TOF.width), np.uint16))
    (folder / "link").symlink_to(outside)
    (folder / "link.png").symlink_to(outside / "secret.png")
    first_line_with(folder / "tof.txt", relative)
    with pytest.raises(BadInputError, match=r"tof\.txt:2: ") as caught:
        open_recording(folder)
    assert caught.value.kind == "unsafe_path"


@pytest.mark.parametrize(
    "name", ["recording.json", "rig.json", "trajectory.txt", "tof.txt", "scalars.txt", "measurements.txt"]
)
def test_no_list_is_a_link_to_the_outside(folder: Path, name: str) -> None:
    secret = folder.parent / "secret"
    secret.write_text("the secret\n")
    (folder / name).unlink(missing_ok=True)
    (folder / name).symlink_to(secret)
    with pytest.raises(BadInputError) as caught:
        open_recording(folder)
    assert caught.value.kind == "unsafe_path"
    assert "the secret" not in caught.value.message


def test_a_loop_of_links_is_refused(folder: Path) -> None:
    (folder / "loop").symlink_to(folder / "loop")
    first_line_with(folder / "tof.txt", "loop/a.png")
    with pytest.raises(BadInputError):
        open_recording(folder)


def test_a_pipe_is_no_image_and_blocks_nobody(folder: Path) -> None:
    os.mkfifo(folder / "pipe")
    first_line_with(folder / "tof.txt", "pipe")
    with pytest.raises(BadInputError) as caught:
        open_recording(folder)
    assert caught.value.kind == "missing_image"


@pytest.mark.parametrize("relative", ["a" * 300, "a/" * 600 + "b", "é" * 200])
def test_a_path_too_long_for_a_file_system_is_refused(tmp_path: Path, relative: str) -> None:
    with pytest.raises(BadInputError) as caught:
        path_inside(tmp_path, relative)
    assert caught.value.kind == "unsafe_path"


def test_links_inside_the_folder_are_followed(folder: Path) -> None:
    (folder / "inner.png").symlink_to(folder / "images/tof/000000.png")
    first_line_with(folder / "tof.txt", "inner.png")
    assert len(list(open_recording(folder))) == 3


def test_a_missing_image_is_named_by_list_and_line(folder: Path) -> None:
    (folder / "images/left/000001.png").unlink()
    with pytest.raises(BadInputError, match=r"left\.txt:3: .*000001\.png is missing") as caught:
        open_recording(folder)
    assert caught.value.kind == "missing_image"


def test_a_damaged_image_is_damaged_data_that_names_the_file(folder: Path) -> None:
    path = folder / "images/ir/000001.png"
    path.write_bytes(path.read_bytes()[:-20])
    recording = open_recording(folder)
    recording.scan(0)
    with pytest.raises(DamagedDataError, match=r"ir/000001\.png"):
        recording.scan(1)


def test_an_image_of_another_size_is_refused_by_name(folder: Path) -> None:
    write_grey16(folder / "images/tof/000000.png", np.ones((5, 5), np.uint16))
    with pytest.raises(BadInputError, match=r"tof/000000\.png must be 8 x 6 pixels, got 5 x 5"):
        open_recording(folder).scan(0)


@pytest.mark.parametrize("name", ["tof.txt", "left.txt", "trajectory.txt"])
def test_times_that_do_not_increase_are_named_by_line(folder: Path, name: str) -> None:
    head, *entries = (folder / name).read_text().splitlines()
    (folder / name).write_text("\n".join([head, *reversed(entries)]) + "\n")
    with pytest.raises(BadInputError, match=rf"{name}:3: times must increase"):
        open_recording(folder)


@pytest.mark.parametrize(
    ("name", "line"),
    [
        ("tof.txt", "nan images/tof/000000.png"),
        ("tof.txt", "soon images/tof/000000.png"),
        ("tof.txt", "5"),
        ("trajectory.txt", "1800000000 nan 0 0 0 0 0 1"),
        ("scalars.txt", "1800000000 dose nan"),
        ("scalars.txt", "1800000000 dose"),
        ("scalars.txt", "1800000000 ../x 1"),
        ("scalars.txt", "1 dose 1"),
        ("measurements.txt", "1 2 3"),
    ],
)
def test_a_bad_line_is_named_by_file_and_number(folder: Path, name: str, line: str) -> None:
    path = folder / name
    text = path.read_text() if path.exists() else ""
    path.write_text(f"{text}{line}\n")
    number = len(text.splitlines()) + 1
    with pytest.raises(BadInputError, match=rf"{name}:{number}: ") as caught:
        open_recording(folder)
    assert caught.value.kind == "bad_recording"


@pytest.mark.parametrize(
    "fields",
    [
        {"version": 2},
        {"format": "other"},
        {"name": "../x"},
        {"typo": 1},
        {"range": {"left": {}}},
        {"range": {"tof": {"units_per_m": 0}}},
        {"range": {"tof": {"convention": "radial"}}},
        {"colour": ["tof"]},
        {"amplitude": ["ir"]},
        {"range": {}},
        {"max_gap_s": -1},
    ],
)
def test_a_header_that_does_not_fit_is_refused(folder: Path, fields: dict[str, object]) -> None:
    change_header(folder, **fields)
    with pytest.raises(BadInputError, match=r"recording\.json") as caught:
        open_recording(folder)
    assert caught.value.kind == "bad_recording"


def test_a_header_that_names_an_unknown_camera_is_refused(folder: Path) -> None:
    change_header(folder, colour=["right"])
    with pytest.raises(BadInputError) as caught:
        open_recording(folder)
    assert caught.value.kind == "unknown_camera"


def test_a_recorded_camera_needs_its_list(folder: Path) -> None:
    (folder / "left.txt").unlink()
    with pytest.raises(BadInputError, match=r"left\.txt") as caught:
        open_recording(folder)
    assert caught.value.kind == "missing_file"


def test_a_folder_of_other_things_is_no_recording(tmp_path: Path) -> None:
    with pytest.raises(BadInputError) as caught:
        open_recording(tmp_path)
    assert caught.value.kind == "missing_file"


@settings(max_examples=60, deadline=None)
@given(name=st.sampled_from(["recording.json", "rig.json", "trajectory.txt", "tof.txt", "scalars.txt"]), data=st.data())
def test_damaged_text_raises_our_errors_or_reads(
    tmp_path_factory: pytest.TempPathFactory, name: str, data: st.DataObject
) -> None:
    path = written(tmp_path_factory.mktemp("d") / "lab", [random_scan(n) for n in range(2)]) / name
    raw = bytearray(path.read_bytes())
    for _ in range(3):
        raw[data.draw(st.integers(0, len(raw) - 1))] = data.draw(st.integers(0, 255))
    path.write_bytes(raw)
    try:
        list(open_recording(path.parent))
    except CairnError as exc:
        assert exc.message


# --- the writer


def test_a_half_written_recording_is_recognised(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError), RecordingWriter(tmp_path / "lab", RIG, name="lab") as recording:
        recording.add(random_scan(0))
        raise ZeroDivisionError
    with pytest.raises(BadInputError) as caught:
        open_recording(tmp_path / "lab")
    assert caught.value.kind == "unfinished_recording"


def test_a_recording_under_way_is_recognised_too(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "lab", RIG, name="lab") as recording:
        recording.add(random_scan(0))
        with pytest.raises(BadInputError, match="never finished"):
            open_recording(tmp_path / "lab")


def test_a_recording_is_not_written_over_another(folder: Path) -> None:
    before = (folder / "recording.json").read_bytes()
    with pytest.raises(ConflictError) as caught:
        RecordingWriter(folder, RIG, name="lab")
    assert caught.value.kind == "recording_exists"
    assert (folder / "recording.json").read_bytes() == before


def test_nothing_is_added_after_the_end(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "lab", RIG, name="lab") as recording:
        recording.finish()
        with pytest.raises(ConflictError):
            recording.add(random_scan(0))
    assert len(open_recording(tmp_path / "lab")) == 0


@pytest.mark.parametrize("step_s", [0.0, -1.0])
def test_scans_are_written_in_order_of_time(tmp_path: Path, step_s: float) -> None:
    with RecordingWriter(tmp_path / "lab", RIG, name="lab") as recording:
        recording.add(random_scan(0))
        with pytest.raises(BadInputError, match="times must increase"):
            recording.add(random_scan(1, time_s=START_S + step_s))
    assert len(open_recording(tmp_path / "lab")) == 1


@pytest.mark.parametrize(
    ("range_m", "kelvin"), [(70.0, 300.0), (0.0, 300.0), (-1.0, 300.0), (np.inf, 300.0), (1.0, 700.0), (1.0, -5.0)]
)
def test_a_value_that_16_bits_cannot_hold_is_refused_and_leaves_no_line(
    tmp_path: Path, range_m: float, kelvin: float
) -> None:
    full = (TOF.height, TOF.width)
    scan = Scan(
        time_s=START_S,
        T_map_rig=np.eye(4),
        range_camera="tof",
        range_m=np.full(full, range_m, np.float32),
        thermal={"ir": np.full(full, 300.0, np.float32)},
    )
    scan.thermal["ir"][0, 0] = kelvin
    with RecordingWriter(tmp_path / "lab", RIG, name="lab") as recording:
        with pytest.raises(BadInputError) as caught:
            recording.add(scan)
        recording.add(random_scan(1))
    assert caught.value.kind == "bad_scan"
    assert len(list(open_recording(tmp_path / "lab"))) == 1


def test_a_range_below_half_a_unit_is_not_taken_for_none(tmp_path: Path) -> None:
    scan = Scan(
        time_s=0, T_map_rig=np.eye(4), range_camera="tof", range_m=np.full((TOF.height, TOF.width), 1e-5, np.float32)
    )
    (read,) = open_recording(written(tmp_path / "lab", [scan]))
    np.testing.assert_allclose(read.range_m, 0.001)


def test_a_reading_that_is_no_number_is_not_written(tmp_path: Path) -> None:
    scan = Scan(
        time_s=0, T_map_rig=np.eye(4), range_camera="tof", range_m=random_scan(0).range_m, scalars={"dose": np.nan}
    )
    with RecordingWriter(tmp_path / "lab", RIG, name="lab") as recording, pytest.raises(BadInputError):
        recording.add(scan)


@pytest.mark.parametrize("camera", ["a/b", "trajectory", "a.amplitude", "..", ""])
def test_a_camera_whose_name_is_no_file_name_cannot_be_recorded(tmp_path: Path, camera: str) -> None:
    rig = Rig(name="r", cameras={camera: mount_camera(Spectrum.RANGE, TOF, np.eye(4))})
    with pytest.raises(BadInputError):
        RecordingWriter(tmp_path / "lab", rig, name="lab")
    assert not (tmp_path / "lab").exists()


def test_a_distorted_camera_round_trips_z_depth(tmp_path: Path) -> None:
    camera = Camera(width=8, height=6, focal_px=(7, 7), centre_px=(3.5, 2.5), distortion=(-0.1, 0.01, 0.001, 0, 0))
    rig = Rig(name="r", cameras={"tof": mount_camera(Spectrum.RANGE, camera, np.eye(4))})
    range_m = np.linspace(0.5, 5, 48, dtype=np.float32).reshape(6, 8)
    encoding = RangeEncoding(units_per_m=10_000, convention=Convention.Z)
    with RecordingWriter(tmp_path / "lab", rig, name="lab", range_encoding=encoding) as recording:
        recording.add(Scan(time_s=0, T_map_rig=np.eye(4), range_camera="tof", range_m=range_m))
    np.testing.assert_allclose(open_recording(tmp_path / "lab").scan(0).range_m, range_m, atol=1e-4)
