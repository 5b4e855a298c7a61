"""Folders of clouds with poses: any form of the same sweeps gives the same cells, and they are those of the room."""

import os
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from tests.fixtures.fusion import cloud_forms
from tests.fixtures.fusion.cloud_forms import FORMS, HIGH_M, LOW_M, Write, beams, off_walls_m, on_grid, pose_of, seen
from tests.fixtures.fusion.pose_forms import kitti, words

from cairn_calib.rig.poses import Transform, inverse, quaternion_from_transform
from cairn_client.cli.robots.command import main
from cairn_client.folders.folder_status import folder_queue
from cairn_client.robot.robot import Robot
from cairn_fusion.recording.turned_source import AXES_UP, rotation_up
from cairn_map.codec.cell_code import encode_cell
from cairn_map.errors import BadInputError
from cairn_map.evidence.grid import voxels_in_cell

SILENT = "http://127.0.0.1:9/maps/lab"
"""URL at which nothing listens: a robot maps on without a link."""
VOXEL_M = 0.1
POSES = [pose_of(0.3 * n, 0.4 * n) for n in range(4)]
SWEEPS = [seen(T, beams(3000, seed=n)) for n, T in enumerate(POSES)]


def run(folder: Path, state: Path, *options: str) -> None:
    asked = ("--map", SILENT, "--state", str(state), "--voxel", str(VOXEL_M), "--name", "robot", *options)
    assert main(["replay", str(folder), *asked]) == 0


def replay(folder: Path, state: Path, *options: str) -> dict[int, bytes]:
    """The canonical cells that a replay leaves in the robot's folder."""
    run(folder, state, *options)
    with Robot(None, SILENT, directory=state, name="robot") as robot:
        return {
            int(key): encode_cell(key, cell, robot.replica.geometry).data for key, cell in robot.map.packed().items()
        }


def voxels(state: Path) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Centres of the occupied and of the free voxels, metres."""
    with Robot(None, SILENT, directory=state, name="robot") as robot:
        geometry = robot.replica.geometry
        parts = [
            (voxels_in_cell(cell.voxels, key, geometry), cell.counts[:, 0] > 0)
            for key, cell in robot.map.packed().items()
        ]
    centres = (np.concatenate([part for part, _ in parts]).astype(np.float64) + 0.5) * np.float64(VOXEL_M)
    hit = np.concatenate([hits for _, hits in parts])
    return centres[hit], centres[~hit]


def written(folder: Path, write: Write) -> Path:
    folder.mkdir()
    for n, points in enumerate(SWEEPS):
        write(folder / f"{n:06d}", points)
    return folder


@pytest.fixture(scope="module")
def expected(tmp_path_factory: pytest.TempPathFactory) -> dict[int, bytes]:
    root = written(tmp_path_factory.mktemp("expected") / "clouds", cloud_forms.pcd_binary)
    return replay(root, root / "state", *kitti(root, POSES), "--poses-of", "rig")


@pytest.mark.parametrize("write", FORMS, ids=lambda form: form.__name__)
def test_every_form_of_the_same_sweeps_gives_the_same_cells(
    write: Write, expected: dict[int, bytes], tmp_path: Path
) -> None:
    root = written(tmp_path / "clouds", write)
    poses = kitti(tmp_path, POSES)
    assert replay(root, tmp_path / "state", *poses, "--poses-of", "rig") == expected


def test_the_cells_are_those_of_the_room(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root = written(tmp_path / "clouds", cloud_forms.kitti_bin)
    replay(root, tmp_path / "state", *kitti(tmp_path, POSES), "--poses-of", "rig")
    occupied, free = voxels(tmp_path / "state")
    assert off_walls_m(occupied).max() <= VOXEL_M
    assert len(occupied) > 3000
    # Free space is inside, and nothing else.
    inside = ((free > LOW_M - VOXEL_M) & (free < HIGH_M + VOXEL_M)).all(axis=1)
    assert inside.all()
    assert len(free) > 20_000
    said = capsys.readouterr().out
    assert "100.0% of 12000 pixels are mapped" in said
    assert "doubt" not in said


def test_poses_of_a_camera_and_the_place_of_the_lidar_on_it_give_the_same_cells(
    expected: dict[int, bytes], tmp_path: Path
) -> None:
    """As KITTI publishes: poses of the left camera, and Tr, the lidar in its frame."""
    T_camera_lidar = np.array([[0, -1, 0, 0.25], [0, 0, -1, -0.5], [1, 0, 0, 0.125], [0, 0, 0, 1.0]])
    root = written(tmp_path / "clouds", cloud_forms.kitti_bin)
    poses = kitti(tmp_path, [T @ inverse(T_camera_lidar) for T in POSES])
    with pytest.raises(BadInputError, match="--poses-of rig or a camera of"):
        replay(root, tmp_path / "refused", *poses)
    (tmp_path / "Tr.txt").write_text(words(T_camera_lidar[:3]))
    assert replay(root, tmp_path / "state", *poses, "--T-body-sensor", str(tmp_path / "Tr.txt")) == expected


# --- times of points

RATE_HZ, SWEEP_S, START_S = 10.0, 0.1, 1_600_000_000.0


def moving(time_s: float) -> Transform:
    """A sensor that drives 2 m/s and turns 1 rad/s."""
    return pose_of(2.0 * time_s - 1.5, time_s)


def write_skewed(root: Path, field: str, dtype: str, unit_s: float, start_s: float) -> tuple[str, ...]:
    """Sweeps of which each point was seen at a time of its own."""
    root.mkdir()
    for n in range(6):
        rays, begin_s = beams(2000, seed=n), n / RATE_HZ
        offsets_s = np.sort(np.random.default_rng(n).integers(0, 100, len(rays))) / 1000
        steps, starts = np.unique(offsets_s, return_index=True)
        parts = [
            seen(moving(begin_s + step_s), part)
            for step_s, part in zip(steps.tolist(), np.split(rays, starts[1:]), strict=True)
        ]
        times = ((offsets_s + (start_s and start_s + begin_s)) / unit_s).round(6).astype(dtype)
        cloud_forms.pcd_with_times(root / f"{START_S + begin_s:.6f}", np.concatenate(parts), times, field)
    rows = []
    for n in range(80):
        T = moving(n / 100)
        rows.append([START_S + n / 100, *T[:3, 3], *quaternion_from_transform(T)])
    (root / "tum.txt").write_text("".join(f"{words(row)}\n" for row in rows))
    return ("--poses", str(root / "tum.txt"))


@pytest.mark.parametrize(
    ("field", "dtype", "unit_s", "start_s"),
    [
        ("time", "<f4", 1.0, 0.0),
        ("t", "<u4", 1e-9, 0.0),
        ("offset_time", "<u4", 1e-6, 0.0),
        ("timestamp", "<f8", 1.0, START_S),
        ("timestamp", "<u8", 1e-9, START_S),
    ],
)
def test_points_are_moved_by_their_times_in_any_unit(
    field: str, dtype: str, unit_s: float, start_s: float, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    poses = write_skewed(tmp_path / "moved", field, dtype, unit_s, start_s)
    replay(tmp_path / "moved", tmp_path / "state", *poses)
    occupied, _ = voxels(tmp_path / "state")
    # Points are moved in steps of a millisecond, which rounds them by 2 mm and 1 mrad: 5 mm of 4 m.
    assert off_walls_m(occupied).max() <= VOXEL_M + 0.01
    assert f"points have times (field {field}, " in capsys.readouterr().out
    run(tmp_path / "moved", tmp_path / "as-they-are", *poses, "--deskewed")
    as_they_are, _ = voxels(tmp_path / "as-they-are")
    # With another name the field says nothing, and the walls are smeared.
    poses = write_skewed(tmp_path / "skewed", "curvature", dtype, unit_s, start_s)
    replay(tmp_path / "skewed", tmp_path / "other", *poses)
    smeared, _ = voxels(tmp_path / "other")
    assert (off_walls_m(smeared) > VOXEL_M + 0.01).mean() > 0.2
    assert np.array_equal(smeared, as_they_are)


def test_times_of_no_sweep_are_refused(tmp_path: Path) -> None:
    poses = write_skewed(tmp_path / "clouds", "t", "<u4", 1e-9, 0.0)
    first = min((tmp_path / "clouds").glob("*.pcd"))
    points = on_grid(np.ones((2000, 3)))
    cloud_forms.pcd_with_times(first.with_name(first.stem), points, np.linspace(0, 5e10, 2000).astype("<u8"), "t")
    with pytest.raises(BadInputError, match="the field t spans 5e\\+10: in no unit"):
        replay(tmp_path / "clouds", tmp_path / "state", *poses)


# --- what is not a folder of clouds with poses


def test_clouds_without_poses_one_cloud_and_the_folder_above_say_the_way_out(tmp_path: Path) -> None:
    root = written(tmp_path / "velodyne", cloud_forms.kitti_bin)
    for path, match in (
        (root, "holds 4 clouds of points, 000000.bin the first, and no poses: give --poses FILE"),
        (root / "000000.bin", "is one cloud of points: give the folder it is in"),
        (tmp_path, "velodyne holds clouds of points: give that folder"),
    ):
        with pytest.raises(BadInputError, match=match):
            replay(path, tmp_path / "state")


def test_a_cloud_in_millimetres_is_refused_and_one_that_is_cut_off_named(tmp_path: Path) -> None:
    root = written(tmp_path / "clouds", cloud_forms.kitti_bin)
    poses = (*kitti(tmp_path, POSES), "--poses-of", "rig")
    cloud_forms.kitti_bin(root / "000002", SWEEPS[2] * 1000)
    with pytest.raises(BadInputError, match="millimetres"):
        replay(root, tmp_path / "1", *poses)
    (root / "000002.bin").write_bytes((root / "000001.bin").read_bytes()[:-7])
    with pytest.raises(BadInputError, match=r"000002.bin: 47993 bytes are no points of 4 float32 values"):
        replay(root, tmp_path / "2", *poses)


@pytest.mark.skipif("CAIRN_TEST_DATA" not in os.environ, reason="CAIRN_TEST_DATA names no folder of recordings")
def test_real_clouds_with_their_published_poses_agree(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The two clouds of a car that libpointmatcher publishes, with cloud-to-world poses of its list."""
    source = Path(os.environ["CAIRN_TEST_DATA"]) / "lpm_lidar"
    root = tmp_path / "car"
    root.mkdir()
    for name in ("car_cloud400", "car_cloud401"):
        (root / f"{name[-3:]}.csv").write_bytes((source / f"{name}.csv").read_bytes())
    rows = [line.split(",")[1:] for line in (source / "carCloudList.csv").read_text().splitlines()[1:] if line]
    (tmp_path / "poses.txt").write_text("".join(" ".join(row) + "\n" for row in rows))
    asked = ("--poses", str(tmp_path / "poses.txt"), "--poses-of", "rig", "--first-frame", "400")
    run(root, tmp_path / "state", *asked)
    occupied, free = voxels(tmp_path / "state")
    assert len(occupied) > 5000
    assert len(free) > 50_000
    assert "doubt" not in capsys.readouterr().out


# --- worlds that lie on their back


@pytest.mark.parametrize("up", [axis for axis in AXES_UP if axis != "z"])
def test_a_world_on_its_back_is_doubted_and_stands_up_when_it_is_told(
    up: str, expected: dict[int, bytes], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    T_map_world = rotation_up(up)
    assert np.linalg.det(T_map_world) == 1.0
    root = written(tmp_path / "clouds", cloud_forms.pcd_binary)
    poses = (*kitti(tmp_path, [inverse(T_map_world) @ T for T in POSES]), "--poses-of", "rig")
    lying = replay(root, tmp_path / "lying", *poses)
    assert lying != expected
    assert f"and the map takes z: give --up {up}, or --up z if z is right" in capsys.readouterr().out
    assert main(["inspect", str(root), *poses]) == 0
    assert f"up is probably {up}" in capsys.readouterr().out
    standing = replay(root, tmp_path / "standing", *poses, "--up", up)
    said = capsys.readouterr().out
    assert f"up is {up} of the poses' frame: it becomes the map's z" in said
    assert "doubt" not in said
    assert standing == expected
    (tmp_path / "T.txt").write_text(words(T_map_world))
    assert replay(root, tmp_path / "moved", *poses, "--T-map-world", str(tmp_path / "T.txt")) == expected
    (commit,) = folder_queue(tmp_path / "standing").commits
    assert commit.note == f"up is {up} of the poses' frame: it becomes the map's z"


def test_a_wall_ahead_is_no_floor(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A lidar that sees one wall alone: the wall faces x from behind, and the lidar is held towards z."""
    rays = beams(3000)
    ahead = [rays[(rays[:, 0] > 0.9)] * 4.0 / rays[rays[:, 0] > 0.9][:, :1] for _ in range(2)]
    root = tmp_path / "clouds"
    root.mkdir()
    for n, points in enumerate(ahead):
        cloud_forms.pcd_binary(root / f"{n:03d}", on_grid(points))
    poses = (*kitti(tmp_path, [np.eye(4)] * 2), "--poses-of", "rig")
    run(root, tmp_path / "state", *poses)
    assert "up is" not in capsys.readouterr().out
    assert main(["inspect", str(root), *poses]) == 0
    assert "up is probably" not in capsys.readouterr().out


def test_two_statements_of_up_are_refused(tmp_path: Path) -> None:
    root = written(tmp_path / "clouds", cloud_forms.pcd_binary)
    (tmp_path / "T.txt").write_text(words(np.eye(4)))
    poses = (*kitti(tmp_path, POSES), "--poses-of", "rig")
    with pytest.raises(BadInputError, match="--up and --T-map-world are two statements of the same"):
        replay(root, tmp_path / "state", *poses, "--up", "-y", "--T-map-world", str(tmp_path / "T.txt"))
