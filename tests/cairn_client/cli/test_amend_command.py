"""`cairn robot amend`: kept scans at a corrected trajectory make the map that it would have given from the start."""

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.fixtures.client.live_server import LiveServer
from tests.fixtures.client.made import GEOMETRY, cells_of
from tests.fixtures.client.robot_program import INTEGRATOR, RIG, scan_of
from tests.fixtures.client.robots import NOWHERE, robot_in

from cairn_calib.rig.camera import Camera
from cairn_calib.rig.poses import Transform, check_transform, look_at
from cairn_calib.rig.rig import Rig, Spectrum, mount_camera
from cairn_client import main as cairn
from cairn_client.folders.state_folder import opened_replica
from cairn_client.robot.kept_scans import KeptScans
from cairn_client.robot.robot import Robot
from cairn_fusion.mapping.integrate import integrate_scan
from cairn_fusion.recording.recording_writer import RecordingWriter
from cairn_fusion.recording.scan import Scan
from cairn_fusion.recording.trajectory import trajectory_line
from cairn_map.commits.commit import Commit
from cairn_map.commits.ids import CommitId
from cairn_map.evidence.evidence_map import EvidenceMap

Run = Callable[..., str]


def drift(seed: int) -> Transform:
    """Some centimetres and degrees."""
    rng = np.random.default_rng(seed)
    T = look_at((0, 0, 0), np.array([1, 0, 0]) + rng.normal(0, 0.05, 3)) @ np.linalg.inv(look_at((0, 0, 0), (1, 0, 0)))
    T[:3, 3] = rng.normal(0, 0.1, 3)
    return np.asarray(T)


def corrected(seed: int, by: int) -> Scan:
    return replace(scan_of(seed), T_map_rig=drift(by + seed) @ scan_of(seed).T_map_rig)


def trajectory(path: Path, seeds: Sequence[int], *, by: int = 1000) -> Path:
    """The corrected poses of some scans, in TUM's form."""
    path.write_text("".join(trajectory_line(s.time_s, s.T_map_rig) for s in (corrected(n, by) for n in sorted(seeds))))
    return path


def keeper(folder: Path, url: str = NOWHERE, **options: object) -> Robot:
    """A robot that keeps its scans."""
    return robot_in(folder, url, **({"keep_scans_bytes": 10_000_000, "stay": True} | options))


def measured(robot: Robot, *seeds: int) -> Commit:
    for seed in seeds:
        robot.observe(scan_of(seed))
    commit = robot.commit()
    assert commit is not None
    return commit


def view_of(folder: Path) -> EvidenceMap:
    with Robot(None, NOWHERE, directory=folder, name=folder.name, stay=True) as robot:
        return robot.map


def evidence_of(scans: Sequence[Scan], rig: Rig = RIG) -> EvidenceMap:
    total = EvidenceMap(GEOMETRY)
    for scan in scans:
        total.merge(integrate_scan(scan, rig, GEOMETRY, integrator=INTEGRATOR))
    return total


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    def run(*arguments: object, code: int = 0) -> str:
        capsys.readouterr()
        found = cairn.main(["robot", *map(str, arguments)])
        shown = capsys.readouterr()
        assert found == code, shown
        return shown.out + shown.err

    return run


@pytest.fixture
def mole(tmp_path: Path) -> Path:
    """The folder of a robot with three measurements of two scans."""
    with keeper(tmp_path) as robot:
        for n in range(3):
            measured(robot, 2 * n, 2 * n + 1)
    return tmp_path / "mole"


# The law


@pytest.mark.parametrize("turn", [[], ["--up", "-y"]])
def test_the_map_is_that_of_a_replay_with_the_corrected_poses(turn: list[str], tmp_path: Path, run: Run) -> None:
    with RecordingWriter(tmp_path / "walk", RIG, name="walk") as writer:
        for n in range(9):
            writer.add(scan_of(n))
    # Poses between the scans, so that those of the scans are interpolated.
    times = [(1.5e9 + n - 0.25, corrected(n, 50).T_map_rig) for n in range(10)]
    poses = tmp_path / "optimised.tum"
    poses.write_text("".join(trajectory_line(time_s, T) for time_s, T in times))
    replay = ("replay", tmp_path / "walk", "--map", NOWHERE, "--voxel", 0.05, "--scans-per-measurement", 2, *turn)
    run(*replay, "--state", tmp_path / "a", "--name", "a", "--keep-scans", 10)
    reading = ("--max-pose-gap", 2)
    run(*replay, "--state", tmp_path / "b", "--name", "b", "--poses", poses, "--poses-of", "rig", *reading)
    before = cells_of(view_of(tmp_path / "a"))
    assert "5 measurements of a amended" in run("amend", tmp_path / "a", "--trajectory", poses, *reading, *turn)
    assert cells_of(view_of(tmp_path / "a")) == cells_of(view_of(tmp_path / "b")) != before


def test_others_see_the_corrected_map_after_a_sync(server: LiveServer, tmp_path: Path, run: Run) -> None:
    with keeper(tmp_path, server.map_url) as robot:
        measured(robot, 1, 2)
        taken_back = measured(robot, 3)
        robot.sync()
        server.wait_for_fold()
        robot.sync()
        measured(robot, 4)  # the server has never heard of it
        robot.retract(taken_back)
    poses = trajectory(tmp_path / "new.tum", [1, 2, 3, 4])
    said = run("amend", tmp_path / "mole", "--trajectory", poses)
    assert "2 measurements of mole amended, by up to" in said and "1 taken back" in said
    for _ in range(3):
        run("sync", tmp_path / "mole")
        server.wait_for_fold()
    with robot_in(tmp_path, server.map_url, name="late") as late:
        late.sync()
        assert cells_of(late.map) == cells_of(evidence_of([corrected(n, 1000) for n in (1, 2, 4)]))


# Again, and after a kill


def test_a_second_run_changes_nothing_and_newer_poses_take_the_place_of_the_last(
    mole: Path, tmp_path: Path, run: Run
) -> None:
    poses = trajectory(tmp_path / "new.tum", range(6))
    assert "3 measurements of mole amended" in run("amend", mole, "--trajectory", poses)
    with Robot(None, NOWHERE, directory=mole, name="mole", stay=True) as robot:
        made = robot.replica.commits
    assert "0 measurements of mole amended, 3 were there before" in run("amend", mole, "--trajectory", poses)
    with Robot(None, NOWHERE, directory=mole, name="mole", stay=True) as robot:
        assert robot.replica.commits == made
    newer = trajectory(tmp_path / "newer.tum", range(6), by=2000)
    report = json.loads(run("amend", mole, "--trajectory", newer, "--json").splitlines()[0])
    assert (report["amended"], report["there_before"], report["waiting"]) == (3, 0, 9)
    assert cells_of(view_of(mole)) == cells_of(evidence_of([corrected(n, 2000) for n in range(6)]))


def test_the_observed_poses_are_where_they_are_and_bring_back_the_first_map(
    mole: Path, tmp_path: Path, run: Run
) -> None:
    before = cells_of(view_of(mole))
    observed = tmp_path / "observed.tum"
    observed.write_text("".join(trajectory_line(scan_of(n).time_s, scan_of(n).T_map_rig) for n in range(6)))
    run("amend", mole, "--trajectory", observed)  # in the file they are rounded to a billionth of a metre
    rounded = cells_of(view_of(mole))
    run("amend", mole, "--trajectory", trajectory(tmp_path / "new.tum", range(6)))
    assert cells_of(view_of(mole)) not in (before, rounded)
    run("amend", mole, "--trajectory", observed)
    assert cells_of(view_of(mole)) == rounded


def test_a_run_that_is_killed_before_the_scans_get_their_new_name_goes_on(
    mole: Path, tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Killed(BaseException):
        pass

    poses, renamed = trajectory(tmp_path / "new.tum", range(6)), []
    rename = KeptScans.rename

    def mortal(kept: KeptScans, commit: CommitId, new: CommitId) -> None:
        renamed.append(new)
        if len(renamed) == 2:
            raise Killed
        rename(kept, commit, new)

    with monkeypatch.context() as patch:
        patch.setattr(KeptScans, "rename", mortal)
        with pytest.raises(Killed):
            run("amend", mole, "--trajectory", poses)
    assert "1 measurement of mole amended, by up to" in run("amend", mole, "--trajectory", poses)
    assert "3 were there before" in run("amend", mole, "--trajectory", poses)
    assert cells_of(view_of(mole)) == cells_of(evidence_of([corrected(n, 1000) for n in range(6)]))


def test_after_a_new_rig_measurements_move_with_that_rig(mole: Path, tmp_path: Path, run: Run) -> None:
    lens = Camera(width=4, height=3, focal_px=(4.3, 4.3), centre_px=(1.5, 1.0))
    new = Rig(name="head", cameras={"tof": mount_camera(Spectrum.RANGE, lens, np.eye(4))})
    (tmp_path / "rig.json").write_bytes(new.to_json())
    assert cairn.main(["reprocess", str(mole), "--rig", str(tmp_path / "rig.json")]) == 0
    run("amend", mole, "--trajectory", trajectory(tmp_path / "new.tum", range(6)))
    assert cells_of(view_of(mole)) == cells_of(evidence_of([corrected(n, 1000) for n in range(6)], new))


# What is refused, and what stays


def assert_unchanged(mole: Path) -> None:
    with Robot(None, NOWHERE, directory=mole, name="mole", stay=True) as robot:
        assert len(robot.replica.commits) == 3


def test_scans_outside_the_trajectory_are_counted_and_nothing_moves_unless_asked(
    mole: Path, tmp_path: Path, run: Run
) -> None:
    poses = trajectory(tmp_path / "short.tum", range(3))
    said = run("amend", mole, "--trajectory", poses, code=1)
    assert "3 of 6 frames have no pose" in said and "scan 1 of mole." in said
    assert "--skip-bad" in said and "nothing was moved" in said
    assert_unchanged(mole)
    said = run("amend", mole, "--trajectory", poses, "--skip-bad")
    assert "1 measurement of mole amended" in said and "2 measurements stay" in said
    expected = evidence_of([corrected(n, 1000) for n in range(2)])
    expected.merge(evidence_of([scan_of(n) for n in range(2, 6)]).packed())
    assert cells_of(view_of(mole)) == cells_of(expected)


def test_a_trajectory_of_another_time_is_refused_with_both_times(mole: Path, tmp_path: Path, run: Run) -> None:
    poses = trajectory(tmp_path / "other.tum", range(100, 103))
    said = run("amend", mole, "--trajectory", poses, "--skip-bad", code=1)
    assert "6 of 6 frames have no pose" in said and "1500000100" in said and "1500000005" in said
    assert_unchanged(mole)


def test_poses_by_number_are_refused(mole: Path, tmp_path: Path, run: Run) -> None:
    rows = [" ".join(map(str, np.eye(4)[:3].ravel())) for _ in range(6)]
    (tmp_path / "kitti.txt").write_text("\n".join(rows))
    said = run("amend", mole, "--trajectory", tmp_path / "kitti.txt", "--poses-of", "rig", code=1)
    assert "are by number, and kept scans have times alone" in said
    assert_unchanged(mole)


def test_a_dry_run_says_what_would_move_and_changes_nothing(mole: Path, tmp_path: Path, run: Run) -> None:
    said = run("amend", mole, "--trajectory", trajectory(tmp_path / "new.tum", range(6)), "--dry-run")
    assert "3 measurements of mole would be amended, by up to 0." in said
    assert_unchanged(mole)


def test_a_robot_at_work_has_its_folder_for_itself(tmp_path: Path, run: Run) -> None:
    with keeper(tmp_path) as robot:
        measured(robot, 1)
        said = run("amend", tmp_path / "mole", "--trajectory", trajectory(tmp_path / "new.tum", [1]), code=4)
        assert "[folder_in_use]" in said


def test_measurements_without_scans_stay_and_are_named(mole: Path, tmp_path: Path, run: Run) -> None:
    with keeper(tmp_path, keep_scans_bytes=0) as robot:
        lost = measured(robot, 6)
    poses = trajectory(tmp_path / "new.tum", range(7))
    said = run("amend", mole, "--trajectory", poses, code=3)
    assert "3 measurements of mole amended" in said and f"the scans of 1 are not kept any more: {lost.id}" in said
    with keeper(tmp_path / "none", keep_scans_bytes=0) as robot:
        measured(robot, 1)
    assert "--keep-scans MB" in run("amend", tmp_path / "none/mole", "--trajectory", poses, code=3)


def test_a_head_that_is_not_kept_is_asked_for_and_one_that_is_named_counts(
    mole: Path, tmp_path: Path, run: Run
) -> None:
    for kept in (mole / "scans").glob("*.rig.json"):
        kept.unlink()
    poses = trajectory(tmp_path / "new.tum", range(6))
    assert "give its rig.json with --rig" in run("amend", mole, "--trajectory", poses, code=1)
    assert_unchanged(mole)
    (tmp_path / "rig.json").write_bytes(RIG.to_json())
    assert "3 measurements" in run("amend", mole, "--trajectory", poses, "--rig", tmp_path / "rig.json")


def test_poses_are_taken_as_a_scan_takes_them() -> None:
    T = corrected(3, 1000).T_map_rig
    assert np.array_equal(check_transform(T), replace(scan_of(3), T_map_rig=T).T_map_rig)


def test_the_measurements_of_a_robot_on_several_layers_are_amended_in_each(run: Run, tmp_path: Path) -> None:
    state = tmp_path / "state"
    state.mkdir()
    for layer in ("evidence", "fine"):
        with keeper(tmp_path / layer) as robot:
            measured(robot, 1, 2)
        (tmp_path / layer / "mole").rename(state / layer)
    with Robot(None, NOWHERE, directory=state / "wide", name="mole", mode="viewer", geometry=GEOMETRY):
        pass

    def seen_in(layer: str) -> object:
        with opened_replica(state / layer) as replica:
            return cells_of(replica.view)

    before = seen_in("fine")
    said = run("amend", state, "--trajectory", trajectory(tmp_path / "slam.tum", (1, 2)))
    assert said.count("1 measurement of mole amended") == 2
    assert seen_in("evidence") == seen_in("fine") != before
    assert "no_state_folder" in run("amend", tmp_path / "none", "--trajectory", tmp_path / "slam.tum", code=1)
