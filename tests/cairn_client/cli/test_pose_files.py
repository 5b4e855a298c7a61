"""Poses of every published form: the same scans give the same cells, and spoilt poses are refused or counted."""

import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from tests.fixtures.fusion import pose_forms
from tests.fixtures.fusion.bags import ALL_CHANNELS, mapping_text, poses_of, recorded, small_recording, write_bag
from tests.fixtures.fusion.pose_forms import FORMS, Writer, image_name, words

from cairn_calib.rig.camera import Camera
from cairn_calib.rig.poses import Transform, quaternion_from_transform
from cairn_client.cli.robots.command import main
from cairn_client.robot.robot import Robot
from cairn_fusion.recording.images import write_colour
from cairn_fusion.recording.recording import Recording
from cairn_map.codec.cell_code import encode_cell
from cairn_map.errors import BadInputError

SILENT = "http://127.0.0.1:9/maps/lab"
"""URL at which nothing listens: a robot maps on without a link."""
FRAMES = 4


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    return small_recording(tmp_path_factory.mktemp("recording") / "room")


@pytest.fixture
def folder(source: Recording, tmp_path: Path) -> Path:
    """The range images as frames of a folder."""
    root = tmp_path / "frames"
    root.mkdir()
    for n, entry in enumerate(source.files):
        shutil.copy(entry.range_path, root / f"{image_name(n)}.png")
    return root


def truth(source: Recording) -> list[Transform]:
    """`T_map_camera` of each frame."""
    return [entry.T_map_rig @ source.rig[entry.range_camera].transform for entry in source.files]


def frame_options(source: Recording) -> tuple[str, ...]:
    name = source.files[0].range_camera
    camera, encoding = source.rig[name].camera, source.range_encodings[name]
    assert isinstance(camera, Camera)
    numbers = ",".join(f"{value!r}" for value in (*camera.focal_px, *camera.centre_px))
    return (
        *("--depth", "{id}.png", f"--intrinsics={numbers}"),
        f"--distortion={','.join(map(repr, camera.distortion))}",
        *("--depth-units", repr(encoding.units_per_m), "--depth-convention", encoding.convention.value),
    )


def replay(recording: Path, state: Path, *options: str) -> dict[int, bytes]:
    """The canonical cells that a replay leaves in the robot's folder."""
    voxel = str(ALL_CHANNELS.voxel_edge_m)
    asked = ("--map", SILENT, "--state", str(state), "--voxel", voxel, "--name", "robot", *options)
    assert main(["replay", str(recording), *asked]) == 0
    with Robot(None, SILENT, directory=state, name="robot") as robot:
        return {
            int(key): encode_cell(key, cell, robot.replica.geometry).data for key, cell in robot.map.packed().items()
        }


@pytest.fixture(scope="module")
def expected(source: Recording, tmp_path_factory: pytest.TempPathFactory) -> dict[int, bytes]:
    """The cells of the frames with poses in KITTI's form."""
    root = tmp_path_factory.mktemp("expected")
    for n, entry in enumerate(source.files):
        shutil.copy(entry.range_path, root / f"{image_name(n)}.png")
    cells = replay(root, root / "state", *frame_options(source), *pose_forms.kitti(root, truth(source)))
    assert cells
    return cells


@pytest.mark.parametrize("write", FORMS, ids=lambda form: form.__name__)
def test_every_form_of_the_same_poses_gives_the_same_cells(
    write: Writer, source: Recording, folder: Path, expected: dict[int, bytes], tmp_path: Path
) -> None:
    options = write(folder, truth(source))
    assert replay(folder, tmp_path / "state", *frame_options(source), *options) == expected


def test_a_pose_file_replaces_the_poses_of_a_recording_and_of_a_bag(
    source: Recording, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Neither has poses of its own any more; the poses of the rig, or of a camera, give the cells of the truth."""
    folder = source.files[0].range_path.parents[2]
    own = replay(folder, tmp_path / "own")
    rows = [[time_s, *pose] for time_s, pose in poses_of(source).items()]
    (tmp_path / "tum.txt").write_text("".join(f"{words(row)}\n" for row in rows))
    by_time = ("--poses", str(tmp_path / "tum.txt"))
    pose_forms.kitti(tmp_path, truth(source))
    by_number = ("--poses", str(tmp_path / "poses.txt"), "--poses-of", source.files[0].range_camera)
    shutil.copytree(folder, tmp_path / "bare")
    (tmp_path / "bare" / "trajectory.txt").unlink()
    bag = write_bag(tmp_path / "lab", "ros1.mcap", lambda make: recorded(source, make))
    (tmp_path / "bag.yaml").write_text(mapping_text(source, poses={"topic": "/no_such_topic"}))
    topics = ("--topics", str(tmp_path / "bag.yaml"))
    assert replay(tmp_path / "bare", tmp_path / "1", *by_time) == own
    assert replay(tmp_path / "bare", tmp_path / "2", *by_number) == own
    assert replay(bag, tmp_path / "3", *topics, *by_time) == own
    assert replay(bag, tmp_path / "4", *topics, *by_number) == own
    said = capsys.readouterr().out
    assert "poses: TUM (tum.txt), T_map_rig, 4 poses" in said
    assert "poses: KITTI (poses.txt), T_map_tof, opencv axes (x right, y down, z forward), 4 poses" in said
    with pytest.raises(BadInputError, match="--poses-of rig or a camera of"):
        replay(bag, tmp_path / "5", *topics, *by_number[:2])


# --- spoilt poses: each is refused; --skip-bad counts those that can be left out

Spoil = Callable[[list[Transform]], Sequence[Transform]]


def lines_of(options: Sequence[str]) -> tuple[Path, list[str]]:
    path = Path(options[1])
    return path, path.read_text().splitlines(keepends=True)


def refuse(source: Recording, folder: Path, options: Sequence[str], kind: str, match: str) -> None:
    with pytest.raises(BadInputError, match=match) as refused:
        replay(folder, folder / "refused", *frame_options(source), *options)
    assert refused.value.kind == kind


@pytest.mark.parametrize(
    ("write", "spoil", "kind", "match", "count"),
    [
        (pose_forms.tum, lambda rows: [*rows, rows[-1]], "bad_recording", "times must increase", "1 poses of tum"),
        (pose_forms.tum, lambda rows: [rows[0], rows[2], rows[1], *rows[3:]], "bad_recording", "tum.txt:3", "1 poses"),
        (pose_forms.tum, lambda rows: rows[:-1], "no_pose", "1 of 4 frames have no pose", "1 of 4 frames"),
        (pose_forms.tum, lambda rows: [*rows[:2], *rows[3:]], "no_pose", "000001", "1 of 4 frames"),
        (pose_forms.kitti, lambda rows: rows[:-1], "no_pose", "of the frames 0 to 2", "1 of 4 frames"),
        (
            pose_forms.kitti,
            lambda rows: [rows[0], "nan " * 12 + "\n", *rows[2:]],
            "bad_recording",
            "poses.txt:2",
            "1 p",
        ),
        (
            pose_forms.kitti,
            lambda rows: [*rows[:3], "1 0 0 99 0 1 0 0 0 0 1 0\n"],
            "pose_jump",
            "poses.txt:4: the pose jumps",
            "1 poses of poses.txt are left out",
        ),
        (
            pose_forms.kitti,
            lambda rows: [*rows[:3], "2 0 0 0 0 2 0 0 0 0 2 0\n"],
            "bad_transform",
            "R.T R is off by 3",
            "1 of 4 frames",
        ),
    ],
)
def test_bad_poses_are_refused_or_counted_with_their_place(
    write: Writer,
    spoil: Callable[[list[str]], list[str]],
    kind: str,
    match: str,
    count: str,
    source: Recording,
    folder: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    options = write(folder, truth(source))
    path, rows = lines_of(options)
    path.write_text("".join(spoil(rows)))
    refuse(source, folder, options, kind, match)
    # A duplicate is left out and every frame has its pose; in the other cases one frame goes with its pose.
    assert replay(folder, tmp_path / "state", *frame_options(source), *options, "--skip-bad")
    said = capsys.readouterr().out
    assert count in said
    assert "replayed 3 scans" in said or (count.startswith("1 poses of tum") and "replayed 4 scans" in said)


def test_poses_without_frames_and_doubtful_units_are_said(
    source: Recording, folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    poses = truth(source)
    options = pose_forms.kitti(folder, [*poses, poses[-1]])
    replay(folder, tmp_path / "state", *frame_options(source), *options, "--scale", "0.001")
    said = capsys.readouterr().out
    assert "1 of 5 poses of poses.txt have no frame, the first is" in said
    assert "doubt: the poses of poses.txt span" in said
    assert "0.001 m in a unit" in said


def test_units_that_are_wrong_are_refused_and_the_likely_one_is_named(source: Recording, folder: Path) -> None:
    poses = truth(source)
    far = [T.copy() for T in poses]
    for n, T in enumerate(far):
        T[:3, 3] = np.array((40.0 * n, 0, 0))  # 4 cm a frame, in millimetres
    refuse(source, folder, pose_forms.kitti(folder, far), "pose_jump", "millimetres need --scale 0.001")
    options = pose_forms.tum(folder, poses)
    path, rows = lines_of(options)
    for factor, kind, unit in ((1e3, "no_pose", "ms"), (1e6, "no_pose", "us"), (1e18, "bad_time_unit", "ns")):
        times = [f"{float(row.split()[0]) * factor:.17g} {row.partition(' ')[2]}" for row in rows[1:]]
        path.write_text("".join(times))
        refuse(source, folder, options, kind, f"--pose-time-unit {unit}")
    options = pose_forms.euroc(folder, poses)
    path, rows = lines_of(options)
    path.write_text("".join([rows[0], *(f"{n}{row[row.index(',') :]}" for n, row in enumerate(rows[1:]))]))
    refuse(source, folder, options, "bad_time_unit", "--pose-time-unit s")


def test_what_the_form_leaves_open_must_be_decided(source: Recording, folder: Path) -> None:
    poses = truth(source)
    refuse(source, folder, pose_forms.nerfstudio(folder, poses)[:2], "no_scale", "--scale METRES_PER_UNIT")
    refuse(source, folder, pose_forms.colmap(folder, poses)[:2], "no_scale", "--scale METRES_PER_UNIT")
    euroc = pose_forms.euroc(folder, poses)
    refuse(source, folder, (*euroc[:2], *euroc[4:]), "bad_option", "--T-body-sensor FILE")
    refuse(source, folder, pose_forms.tum(folder, poses)[:2], "no_pose", "give --frame-rate HZ")
    both = (*pose_forms.kitti(folder, poses), "--pose", "{id}.txt")
    refuse(source, folder, both, "bad_option", "two sources of the same poses")
    refuse(source, folder, ("--pose", "{id}.txt", "--scale", "2"), "bad_option", "give --poses FILE")


@pytest.mark.parametrize(
    ("text", "kind"),
    [
        ("", "unknown_poses"),
        ("1 2 3\n", "unknown_poses"),
        ("1,2,3,4,5,6,7,8\n", "unknown_poses"),
        ("{", "bad_recording"),
        ("{}", "unknown_poses"),
        ('{"frames": []}', "no_poses"),
        ('{"frames": [7]}', "bad_recording"),
        ('{"frames": [{"file_path": "a.png", "transform_matrix": [[1], 2]}]}', "bad_transform"),
        ('{"frames": [{"file_path": "a.png", "transform_matrix": [1' + "0" * 400 + "]}]}", "bad_transform"),
        ("[" * 100_000, "unknown_poses"),
        ('{"a":' + "[" * 100_000, "bad_recording"),
        ("1 0 0 0 0 1 0 0 0 0 1 0\n" + "1 " * 5000, "bad_recording"),
        ("0.5 " * 13, "bad_recording"),
        ("1" + "0" * 400 + " 0 0 0 0 0 0 1\n", "bad_recording"),
        ("1 1 0 0 0 0 0 0 one camera\n", "unknown_poses"),
    ],
)
def test_files_that_are_no_poses_are_refused(text: str, kind: str, source: Recording, folder: Path) -> None:
    (folder / "any.txt").write_text(text)
    refuse(source, folder, ("--poses", str(folder / "any.txt"), "--scale", "1"), kind, "any")


def test_rounded_rotations_are_said_for_pose_files_too(
    source: Recording, folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = pose_forms.kitti(folder, [np.round(T, 4) for T in truth(source)])
    replay(folder, tmp_path / "state", *frame_options(source), *options)
    assert "poses were no exact rotations" in capsys.readouterr().out


# --- layouts as publishers lay them out: folders by name, names that are times


@pytest.mark.parametrize(("depth", "colour", "name"), [("Depth", "RGB", "{n}"), ("depth", "color", "frame-{n:06d}")])
def test_folders_are_taken_by_their_names(
    depth: str, colour: str, name: str, source: Recording, expected: dict[int, bytes], tmp_path: Path
) -> None:
    root = tmp_path / "set"
    for n, entry in enumerate(source.files):
        for folder in (depth, colour):
            (root / folder).mkdir(parents=True, exist_ok=True)
            shutil.copy(entry.range_path, root / folder / f"{name.format(n=n)}.png")
        write_colour(root / colour / f"{name.format(n=n)}.png", grey_like(source, n))
    poses = pose_forms.kitti(tmp_path, truth(source))
    with pytest.raises(BadInputError, match=rf"{depth}/.*without intrinsics and poses: give --intrinsics"):
        replay(root, tmp_path / "refused", *poses)
    options = [word for word in frame_options(source) if word not in ("--depth", "{id}.png")]
    cells = replay(root, tmp_path / "state", *options, *poses)
    assert cells.keys() == expected.keys()
    with Robot(None, SILENT, directory=tmp_path / "state", name="robot") as robot:
        assert "colour" in {channel.name for channel in robot.replica.geometry.channels}


def test_images_whose_names_are_times_go_with_the_nearest_depth_image(
    source: Recording, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As TUM publishes RGB-D: two cameras, each with times of its own."""
    root = tmp_path / "tum"
    (root / "depth").mkdir(parents=True)
    (root / "rgb").mkdir()
    rows = []
    for n, (entry, T) in enumerate(zip(source.files, truth(source), strict=True)):
        time_s = 1305031102.16 + n / 30
        shutil.copy(entry.range_path, root / "depth" / f"{time_s:.6f}.png")
        if n != 2:
            write_colour(root / "rgb" / f"{time_s + 0.008:.6f}.png", grey_like(source, n))
        rows.append([round(time_s, 6), *T[:3, 3], *quaternion_from_transform(T)])
    (root / "groundtruth.txt").write_text("".join(f"{words(row)}\n" for row in rows))
    options = [word for word in frame_options(source) if word not in ("--depth", "{id}.png")]
    replay(root, tmp_path / "state", *options, "--poses", str(root / "groundtruth.txt"))
    said = capsys.readouterr().out
    assert "images: colour rgb/{id}.png, depth depth/{id}.png" in said
    assert "rgb/{id}.png: of each frame the image nearest in time, at most 0.02 s away; 1 of 4 frames have none" in said


def grey_like(source: Recording, n: int) -> npt.NDArray[np.uint8]:
    camera = source.rig[source.files[n].range_camera].camera
    return np.full((camera.height, camera.width, 3), 40 * n + 50, np.uint8)


# --- poses that are a source's own: taken as they are, and doubted


def with_own_poses(source: Recording, folder: Path, poses: Sequence[Transform]) -> tuple[str, ...]:
    for n, T in enumerate(poses):
        (folder / f"{image_name(n)}.pose.txt").write_text(words(T))
    return (*frame_options(source), "--pose", "{id}.pose.txt")


@pytest.mark.parametrize(
    ("change", "doubt"),
    [
        (lambda n, t: t + (60.0 if n == 2 else 0.0), "2 steps that no robot makes; the first: 1"),
        (lambda n, t: t + 4000.0 * n, "the poses span 2.078e+04 m in all"),
        (lambda n, t: t[:1] * 0 + 0.001 * n, "the poses span 0.005"),
        (lambda n, t: t, ""),
    ],
    ids=["jump", "far", "small", "sound"],
)
def test_own_poses_that_no_robot_has_are_doubted(
    change: Callable[[int, npt.NDArray[np.float64]], npt.NDArray[np.float64]],
    doubt: str,
    source: Recording,
    folder: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    poses = truth(source)
    for n, T in enumerate(poses):
        T[:3, 3] = change(n, T[:3, 3].copy())
    replay(folder, tmp_path / "state", *with_own_poses(source, folder, poses))
    said = [line for line in capsys.readouterr().out.splitlines() if line.startswith("doubt: ")]
    of_way = [line for line in said if "neighbouring" not in line and "points fall" not in line]
    assert any(doubt in line for line in of_way) if doubt else of_way == []


def test_ranges_of_another_unit_are_doubted(
    source: Recording, folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = list(with_own_poses(source, folder, truth(source)))
    options[options.index("--depth-units") + 1] = "1000000"
    replay(folder, tmp_path / "state", *options)
    assert "is their unit right (--depth-units of a folder of frames)?" in capsys.readouterr().out
