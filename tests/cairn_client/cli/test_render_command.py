"""A robot without a thermal camera sees the temperatures that another one measured: through a server, by any door."""

import shutil
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from tests.fixtures.client.live_server import LiveServer

from cairn_calib.rig.poses import inverse, transform_from_quaternion
from cairn_client.cli.maps.command import main
from cairn_client.cli.robots.telepresence import main as telepresence
from cairn_client.folders.map_folder import ages_of
from cairn_client.http.api import MapApi
from cairn_client.robot.robot import Robot
from cairn_fusion.image_fusion.surface import live_range
from cairn_fusion.recording.trajectory import trajectory_line
from cairn_fusion.recording.turned_source import rotation_up
from cairn_fusion.view.overlay import Live, OverlayMode, OverlayStyle, draw_overlay
from cairn_map.errors import BadInputError
from cairn_map.evidence.grid import geometry_for
from cairn_map.render.camera_rays import CameraRays
from cairn_map.render.map_picture import layer_values
from cairn_map.render.map_render import MapRenderer
from cairn_map.render.render_picture import ZERO_CELSIUS_K, Layer
from cairn_map.wire.messages import CreateMap
from cairn_sim.robots.record import Plan, scans_of, shots_of
from cairn_sim.robots.robots import ROBOTS
from cairn_sim.scene.scene_file import load_scene
from cairn_sim.sim_command import main as sim

SCANS = 12
CAMERA = "colour"


@dataclass(frozen=True)
class World:
    """A server with what a robot with thermal cameras saw, and another robot's state and recording."""

    url: str
    state: Path
    recording: Path


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    folder = tmp_path_factory.mktemp("telepresence")
    server = LiveServer(folder / "server")
    try:
        url = f"{server.url}/maps/room"
        with MapApi(server.url) as api:
            api.create_map("room", CreateMap(geometry=geometry_for(voxel_edge_m=0.08)))
        plan = Plan(scene=load_scene("small-room"), robot=ROBOTS["orpheus"], path="west", scale=0.1, truth="none")
        rig = plan.robot.rig_of(plan.scale)
        with Robot(rig, url, directory=folder / "orpheus", name="orpheus") as robot:
            for _, scan, _ in scans_of(plan, shots_of(plan)[1 : 3 * SCANS : 3], rig):
                robot.observe(scan)
            robot.commit()
            robot.sync()
        words = ("record", "small-room", str(folder / "hand"), "--robot", "handheld", "--path", "west")
        assert sim([*words, "--scale", "0.2", "--truth", "none", "--stops", "0:1"]) == 0
        yield World(url, folder / "hand-state", folder / "hand")
    finally:
        server.stop()


def test_a_robot_without_a_thermal_camera_shows_what_another_measured(world: World) -> None:
    plan = Plan(scene=load_scene("small-room"), robot=ROBOTS["handheld"], path="west", scale=0.2, truth="none")
    rig = plan.robot.rig_of(plan.scale)
    assert not [name for name in rig.cameras if "thermal" in name]
    (_, scan, _), *_ = scans_of(plan, shots_of(plan)[:1], rig)
    with Robot(rig, world.url, directory=world.state, name="hand", stay=True) as robot:
        robot.sync()
        snapshot = robot.snapshot()
    live = Live(
        rgb=scan.colour[CAMERA],
        range_m=live_range(scan, rig, camera=CAMERA),
        sight=CameraRays(rig[CAMERA].camera.rays()),
        T_map_camera=scan.T_map_rig @ rig[CAMERA].transform,
    )
    drawn = draw_overlay(MapRenderer(), snapshot, live, OverlayStyle())
    visible = drawn.front_modes == OverlayMode.VISIBLE
    celsius = drawn.values[visible]
    assert visible.mean() > 0.3
    assert np.isfinite(celsius).mean() > 0.5
    assert 10 < np.nanmedian(celsius) < 40
    assert (drawn.picture != live.rgb)[visible].any()


def rendered(path: Path) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
    image = cv2.imread(str(path))
    assert image is not None
    return np.asarray(image, np.uint8)


def test_the_command_draws_the_same_from_a_server_and_from_a_folder(
    world: World, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cells, view = tmp_path / "cells", ["--from", "0.5,0.5,1.2", "--to", "3,2,0.5", "--size", "80x60"]
    assert main(["export", world.url, "--cells", str(cells)]) == 0
    for name, source in (("server", world.url), ("folder", str(cells))):
        words = ["-o", str(tmp_path / f"{name}.png"), "--npz", str(tmp_path / f"{name}.npz")]
        assert main(["render", source, *view, *words]) == 0
    assert "on the map" in capsys.readouterr().out
    assert np.array_equal(rendered(tmp_path / "server.png"), rendered(tmp_path / "folder.png"))
    told = [dict(np.load(tmp_path / f"{name}.npz")) for name in ("server", "folder")]
    assert told[0].keys() == told[1].keys() == {"range_m", "depth_m", "temperature_k"}
    for name, values in told[0].items():
        assert np.array_equal(values, told[1][name], equal_nan=True)
    assert 280 < np.nanmedian(told[0]["temperature_k"]) < ZERO_CELSIUS_K + 60


def test_the_command_draws_over_a_recorded_image(
    world: World, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cells, picture = tmp_path / "cells", tmp_path / "overlay.png"
    main(["export", world.url, "--cells", str(cells)])
    capsys.readouterr()
    words = ["render", str(cells), "--over", str(world.recording), "-o", str(picture)]
    assert main([*words, "--npz", str(tmp_path / "overlay.npz")]) == 0
    out = capsys.readouterr().out
    assert "temperature over colour, scan 0: visible" in out
    told = np.load(tmp_path / "overlay.npz")
    assert (told["modes"] == OverlayMode.VISIBLE).mean() > 0.3
    assert rendered(picture).shape[0] > told["modes"].shape[0]
    assert main([*words, "--sigma", "2,20"]) == 0
    assert "withheld, the pose is uncertain" in capsys.readouterr().out
    wide = ",".join(["0.25" if n in (0, 2, 5) else "0" for n in range(21)])  # 0.5 rad about each axis
    assert main([*words, "--covariance", wide]) == 0
    assert "withheld" in capsys.readouterr().out


def test_over_and_telepresence_take_what_replay_takes(world: World, tmp_path: Path) -> None:
    """A recording whose poses are a file of a published form, in a world on its back."""
    cells, bare = tmp_path / "cells", tmp_path / "bare"
    main(["export", world.url, "--cells", str(cells)])
    shutil.copytree(world.recording, bare)
    rows = [line.split() for line in (bare / "trajectory.txt").read_text().splitlines() if not line.startswith("#")]
    (bare / "trajectory.txt").unlink()
    T_world_map = inverse(rotation_up("-y"))
    with (tmp_path / "tum.txt").open("w") as file:
        for time_s, *pose in rows:
            T = T_world_map @ transform_from_quaternion([float(w) for w in pose[:3]], [float(w) for w in pose[3:]])
            file.write(trajectory_line(float(time_s), T))
    options = ["--poses", str(tmp_path / "tum.txt"), "--up", "-y"]
    pictures = [tmp_path / f"{name}.png" for name in ("own", "over", "live")]
    assert main(["render", str(cells), "--over", str(world.recording), "-o", str(pictures[0])]) == 0
    assert main(["render", str(cells), "--over", str(bare), *options, "-o", str(pictures[1])]) == 0
    asked = [str(bare), "--map", str(cells), "--mode", "map", "--scale", "10:50", "--scan", "0"]
    assert telepresence([*asked, *options, "--output", str(pictures[2])]) == 0
    own = rendered(pictures[0])
    # Poses that were turned and turned back differ in their last bit, which may move single pixels of an edge.
    assert all((rendered(one) != own).any(axis=2).mean() < 1e-3 for one in pictures[1:])
    with pytest.raises(BadInputError, match="--up is about a recording: give --over RECORDING"):
        main(["render", str(cells), "--from", "0,0,1", "--to", "1,1,1", "--up", "-y", "-o", str(pictures[0])])


@pytest.mark.slow
def test_telepresence_draws_the_map_over_the_image_too(world: World, tmp_path: Path) -> None:
    """As `cairn map render --over` does; heat on colour takes the map for its mirrors."""
    cells, pictures, one = tmp_path / "cells", tmp_path / "pictures", tmp_path / "one.png"
    main(["export", world.url, "--cells", str(cells)])
    asked = [str(world.recording), "--map", str(cells)]
    assert telepresence([*asked, "--mode", "map", "--scale", "10:50", "--output", str(pictures)]) == 0
    assert main(["render", str(cells), "--over", str(world.recording), "-o", str(one)]) == 0
    drawn = sorted(pictures.iterdir())
    assert len(drawn) == 1 and np.array_equal(rendered(drawn[0]), rendered(one))
    exact = rendered(one)
    for sigma, least in (("0.01,0.5", 0.01), ("2,20", 0.3)):
        live = tmp_path / "live.png"
        assert telepresence([*asked, "--mode", "map", "--scan", "0", "--sigma", sigma, "--output", str(live)]) == 0
        over = ["--over", str(world.recording), "--sigma", sigma, "-o", str(one)]
        assert main(["render", str(cells), *over]) == 0
        assert np.array_equal(rendered(live), rendered(one))
        assert (rendered(one) != exact).any(axis=2).mean() > least
    assert telepresence([*asked, "--output", str(one)]) == 0
    for more, kind in (
        (asked[:1], "nothing_asked"),
        ([*asked, "--layer", "age"], "no_age"),
        ([*asked[:2], world.url], "bad_option"),
        ([*asked, "--covariance", "1,2"], "bad_pose"),
    ):
        with pytest.raises(BadInputError) as caught:
            telepresence([*more, "--mode", "map", "--output", str(one)])
        assert caught.value.kind == kind
    with pytest.raises(BadInputError, match="--mode map"):
        telepresence([*asked, "--sigma", "0.1,1", "--output", str(one)])


def test_a_robots_own_map_has_the_ages_of_its_own_commits(tmp_path: Path) -> None:
    """Offline, two measurements an hour apart; what was taken out again has no age, and an old thing is fainter."""
    plan = Plan(scene=load_scene("small-room"), robot=ROBOTS["orpheus"], path="west", scale=0.1, truth="none")
    rig, grid = plan.robot.rig_of(plan.scale), geometry_for(voxel_edge_m=0.08)
    state, nowhere = tmp_path / "state", "http://127.0.0.1:9/maps/room"
    shots = shots_of(plan)[1 : 3 * SCANS : 3]
    scans = [scan for _, scan, _ in scans_of(plan, shots, rig)]
    with Robot(rig, nowhere, directory=state, name="orpheus", geometry=grid) as robot:
        assert ages_of(robot.replica) is None
        for late_s, part in ((0.0, scans[:2]), (3600.0, scans[6:8]), (9000.0, scans[8:9])):
            for scan in part:
                robot.observe(replace(scan, time_s=1.5e9 + late_s))
            last = robot.commit()
        assert last is not None
        robot.commit(retracts=(last.id,))
        found, snapshot = ages_of(robot.replica), robot.snapshot()
    assert found is not None and found.now == 1.5e9 + 3600
    told = np.unique(np.concatenate([each[np.isfinite(each)] for each in found.changes.values()]))
    assert told.tolist() == [1.5e9, 1.5e9 + 3600]
    T = scans[0].T_map_rig @ rig["colour_left"].transform
    sight, renderer = CameraRays(rig["colour_left"].camera.rays()), MapRenderer()
    seen = renderer.nearest(snapshot, sight, T, range_max_m=8)
    age_s = layer_values(renderer, snapshot, seen, Layer.AGE, found)
    assert np.isfinite(age_s[seen.hit]).mean() > 0.99
    assert set(np.unique(age_s[np.isfinite(age_s)])) <= {0.0, 3600.0}
    picture, at = tmp_path / "age.png", ",".join(f"{x:.3f}" for x in T[:3, 3])
    ahead = ",".join(f"{x:.3f}" for x in T[:3, 3] + 2 * T[:3, 2])
    words = ["render", str(state), "--from", at, "--to", ahead, "--size", "80x60", "--layer", "age", "-o", str(picture)]
    assert main(words) == 0
    assert len(np.unique(rendered(picture)[:60].reshape(-1, 3), axis=0)) >= 2


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--from", "0,0,1", "--to", "1,0,1"], "say what to write"),
        (["-o", "x.png"], "from where to look"),
        (["-o", "x.png", "--from", "0,0,1", "--to", "0,0,1"], "two places"),
        (["-o", "x.png", "--from", "0,0,1", "--to", "1,0,1", "--range", "1000"], "range_m"),
        (["-o", "x.png", "--from", "0,0,1", "--to", "1,0,1", "--low", "60"], "scale"),
        (["-o", "x.png", "--over", "recording"], "cairn clone"),
    ],
)
def test_what_is_missing_is_said(world: World, words: list[str], told: str) -> None:
    with pytest.raises(BadInputError, match=told):
        main(["render", world.url, *words])


def test_scans_and_cameras_that_are_not_there_are_said(world: World, tmp_path: Path) -> None:
    cells = tmp_path / "cells"
    main(["export", world.url, "--cells", str(cells)])
    words = ["render", str(cells), "--over", str(world.recording), "-o", str(tmp_path / "x.png")]
    for more, kind in (
        (["--layer", "age"], "no_age"),
        (["--covariance", "1,2"], "bad_pose"),
        (["--scan", "99"], "no_scan"),
        (["--camera", "depth"], "unknown_camera"),
    ):
        with pytest.raises(BadInputError) as caught:
            main([*words, *more])
        assert caught.value.kind == kind
