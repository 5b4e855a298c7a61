"""`cairn reprocess`: kept scans under a new rig make the map that it would have given from the start."""

import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.fixtures.client.live_server import LiveServer
from tests.fixtures.client.made import GEOMETRY, cells_of
from tests.fixtures.client.robot_program import INTEGRATOR, RIG, scan_of
from tests.fixtures.client.robots import NOWHERE, robot_in
from tests.fixtures.client.world import stored_commits
from tests.fixtures.pages import DOCS

from cairn_calib.rig.camera import Camera
from cairn_calib.rig.poses import Transform, look_at
from cairn_calib.rig.rig import Rig, Spectrum, mount_camera
from cairn_client import main as cairn
from cairn_client.cli.robots.reprocess import ReprocessedFolder
from cairn_client.folders.reprocessing import Recipe, plan_of, reprocess
from cairn_client.replica.limits import LEAST_BYTES, Limits
from cairn_client.replica.replica_store import ReplicaStore
from cairn_client.robot.kept_scans import KeptScans
from cairn_client.robot.robot import Robot
from cairn_fusion.mapping.integrate import Integrator, integrate_scan
from cairn_fusion.recording.scan import Scan
from cairn_fusion.recording.scan_bytes import place_scan
from cairn_map.commits.commit import Commit
from cairn_map.commits.ids import CommitId
from cairn_map.errors import ConflictError
from cairn_map.evidence.evidence_map import EvidenceMap
from cairn_map.evidence.grid import CellKey

PLENTY = 10_000_000
Until = Callable[[Callable[[], bool]], None]


def head(offset_m: float, *, focal_px: float = 4.0, name: str = "head") -> Rig:
    """The head of the tests with its camera elsewhere, and with another lens."""
    T_rig_tof = look_at((offset_m, 0.02, 0), (1, 0.1, 0.05)) @ np.linalg.inv(look_at((0, 0, 0), (1, 0, 0)))
    lens = Camera(width=4, height=3, focal_px=(focal_px, focal_px), centre_px=(1.5, 1.0))
    return Rig(name=name, cameras={"tof": mount_camera(Spectrum.RANGE, lens, T_rig_tof)})


NEW = head(0.11, focal_px=4.3)
NEXT = head(-0.2, focal_px=3.8)


def drift(seed: int) -> Transform:
    """Some centimetres and degrees."""
    rng = np.random.default_rng(seed)
    T = look_at((0, 0, 0), np.array([1, 0, 0]) + rng.normal(0, 0.05, 3)) @ np.linalg.inv(look_at((0, 0, 0), (1, 0, 0)))
    T[:3, 3] = rng.normal(0, 0.1, 3)
    return np.asarray(T)


def moved(seed: int, by: int) -> Scan:
    return replace(scan_of(seed), T_map_rig=drift(by) @ scan_of(seed).T_map_rig)


def map_under(rig: Rig, scans: Sequence[Scan], integrator: Integrator = INTEGRATOR) -> EvidenceMap:
    total = EvidenceMap(GEOMETRY)
    for scan in scans:
        total.merge(integrate_scan(scan, rig, GEOMETRY, integrator=integrator))
    return total


def keeper(folder: Path, url: str = NOWHERE, *, name: str = "mole", **options: object) -> Robot:
    """A robot that keeps its scans."""
    return robot_in(folder, url, name=name, **({"keep_scans_bytes": PLENTY, "stay": True} | options))


def measured(robot: Robot, *seeds: int) -> Commit:
    for seed in seeds:
        robot.observe(scan_of(seed))
    commit = robot.commit()
    assert commit is not None
    return commit


def rig_file(folder: Path, rig: Rig = NEW) -> Path:
    path = folder / f"{rig.digest()[:8]}.json"
    path.write_bytes(rig.to_json())
    return path


def reprocessed(*arguments: object, code: int = 0) -> None:
    assert cairn.main(["reprocess", *map(str, arguments)]) == code


def reports(capsys: pytest.CaptureFixture[str], *arguments: object, code: int = 0) -> list[ReprocessedFolder]:
    capsys.readouterr()
    reprocessed(*arguments, "--json", code=code)
    return [ReprocessedFolder.model_validate_json(line) for line in capsys.readouterr().out.splitlines()]


def view_of(folder: Path, name: str = "mole") -> EvidenceMap:
    with Robot(None, NOWHERE, directory=folder / name, name=name, stay=True) as robot:
        return robot.map


def commits_in(folder: Path, name: str = "mole") -> list[CommitId]:
    with Robot(None, NOWHERE, directory=folder / name, name=name, stay=True) as robot:
        return robot.replica.commits


def server_cells(server: LiveServer) -> dict[CellKey, tuple[bytes, str]]:
    """As `cells_of`, of the server's map."""
    with server.service.store.snapshot(server.service.store.map("lab")) as snapshot:
        return {cell.key: (cell.digest, cell.fingerprint.hex()) for cell in snapshot.cells() if cell.voxels}


def synced(server: LiveServer, folder: Path) -> None:
    """Push what waits, and fetch what the server made of it."""
    for _ in range(3):
        assert cairn.main(["robot", "sync", str(folder)]) == 0
        server.wait_for_fold()


# The law


@pytest.mark.slow
@pytest.mark.processes
def test_two_robots_folders_give_the_map_of_the_new_rig_byte_for_byte(server: LiveServer, tmp_path: Path) -> None:
    seeds = {"mole": [(2 * n, 2 * n + 1) for n in range(8)], "wren": [(100 + n,) for n in range(5)]}
    truth: list[Scan] = []
    for name, groups in seeds.items():
        with keeper(tmp_path, server.map_url, name=name) as robot:
            commits = [measured(robot, *group) for group in groups[:-2]]
            robot.sync()
            server.wait_for_fold()
            robot.sync()
            commits += [measured(robot, *group) for group in groups[-2:]]  # the server has never heard of these
            # One is moved twice by a pose graph, one is taken back.
            robot.amend(commits[0], T_map_observed=drift(7))
            robot.amend(commits[0], T_map_observed=drift(8))
            robot.retract(commits[1])
            truth += [moved(seed, 8) for seed in groups[0]]
            truth += [scan_of(seed) for group in groups[2:] for seed in group]
    folders, rig = [tmp_path / name for name in seeds], rig_file(tmp_path)
    server.stop()
    reprocessed(*folders, "--rig", rig, "--jobs", 2)
    server.start()
    for folder in folders:
        assert cairn.main(["robot", "sync", str(folder)]) == 0
    server.wait_for_fold()
    expected = cells_of(map_under(NEW, truth))
    assert server_cells(server) == expected
    with robot_in(tmp_path, server.map_url, name="late") as late:
        late.sync()
        assert cells_of(late.map) == expected
    # Once more: nothing to do, with the link or without.
    before = len(stored_commits(tmp_path / "server"))
    reprocessed(*folders, "--rig", rig, "--jobs", 2)
    for folder in folders:
        assert cairn.main(["robot", "sync", str(folder)]) == 0
    assert len(stored_commits(tmp_path / "server")) == before == 13 + 4 + 2 + 11


def test_a_second_run_finds_all_done_and_a_third_rig_takes_the_newest_form(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with keeper(tmp_path) as robot:
        commits = [measured(robot, n) for n in range(3)]
        robot.retract(commits[2])
    folder = tmp_path / "mole"
    (report,) = reports(capsys, folder, "--rig", rig_file(tmp_path))
    assert (report.amended, report.done_before, report.taken_back, report.waiting) == (2, 0, 1, 6)
    made = commits_in(tmp_path)
    (report,) = reports(capsys, folder, "--rig", rig_file(tmp_path))
    assert (report.amended, report.done_before, report.waiting) == (0, 2, 6)
    assert commits_in(tmp_path) == made
    (report,) = reports(capsys, folder, "--rig", rig_file(tmp_path, NEXT))
    assert report.amended == 2
    assert cells_of(view_of(tmp_path)) == cells_of(map_under(NEXT, [scan_of(0), scan_of(1)]))
    with keeper(tmp_path) as robot:
        retracts = [kept.meta.retracted_ids for c in robot.replica.commits if (kept := robot.replica.kept_commit(c))]
    assert retracts[-2:] == [(commit,) for commit in made[-2:]]


def test_poses_of_a_loop_closure_stay_bit_for_bit_through_rigs(tmp_path: Path) -> None:
    records = []

    def note_records(robot: Robot) -> None:
        found = [robot.replica.outbox.amends.of(commit) for commit in robot.replica.commits]
        records.append([None if record is None else record.T_map_rig for record in found])

    with keeper(tmp_path) as robot:
        robot.amend(measured(robot, 1, 2), T_map_observed=drift(3))
        note_records(robot)
    poses = records[0][-1]
    assert poses is not None and not np.array_equal(poses, [scan_of(seed).T_map_rig for seed in (1, 2)])
    placed = [place_scan(scan_of(seed), T_map_rig) for seed, T_map_rig in zip((1, 2), poses, strict=True)]
    for rig in (NEW, NEXT):
        reprocessed(tmp_path / "mole", "--rig", rig_file(tmp_path, rig))
        assert cells_of(view_of(tmp_path)) == cells_of(map_under(rig, placed))
        with keeper(tmp_path) as robot:
            note_records(robot)
    # The newest amend alone has them: a folder does not grow with each rig.
    assert [[at is not None for at in row] for row in records] == [[0, 1], [0, 0, 1], [0, 0, 0, 1]]
    assert np.array_equal(records[1][-1], poses) and np.array_equal(records[2][-1], poses)  # type: ignore[arg-type]


def test_amends_of_before_there_were_records_keep_their_poses(tmp_path: Path) -> None:
    with keeper(tmp_path) as robot:
        robot.amend(measured(robot, 1), T_map_observed=drift(3))
        measured(robot, 2)
        store = robot.replica.store
        for key in store.keys("amend:"):
            store.put(key, None)
    reprocessed(tmp_path / "mole", "--rig", rig_file(tmp_path))
    assert cells_of(view_of(tmp_path)) == cells_of(map_under(NEW, [moved(1, 3), scan_of(2)]))


def test_another_range_limit_is_another_integrator_and_none_keeps_that_of_each_measurement(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with keeper(tmp_path) as robot:
        measured(robot, 1, 2)
    folder, rig = tmp_path / "mole", rig_file(tmp_path, RIG)
    assert reports(capsys, folder, "--rig", rig)[0].done_before == 1
    limits = ("--max-range", "1.0")
    assert reports(capsys, folder, "--rig", rig, *limits)[0].amended == 1
    assert reports(capsys, folder, "--rig", rig, *limits)[0].done_before == 1
    expected = map_under(RIG, [scan_of(1), scan_of(2)], replace(INTEGRATOR, max_range_m=1.0))
    assert cells_of(view_of(tmp_path)) == cells_of(expected) != cells_of(map_under(RIG, [scan_of(1), scan_of(2)]))


def test_a_robot_whose_disk_is_bounded_is_reprocessed_too(
    server: LiveServer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    limits = Limits(disk_bytes_max=1_000_000, keep_acked_s=0)
    with keeper(tmp_path, server.map_url, limits=limits) as robot:
        robot.amend(measured(robot, 1), T_map_observed=drift(3))
        measured(robot, 2)
        for _ in range(3):
            robot.sync()
            server.wait_for_fold()
        assert len(robot.replica.commits) < 3  # bytes have gone, and with them what they state
    for amended, done in ((2, 0), (0, 2)):
        (report,) = reports(capsys, tmp_path / "mole", "--rig", rig_file(tmp_path))
        assert (report.amended, report.done_before) == (amended, done)
        synced(server, tmp_path / "mole")
    assert server_cells(server) == cells_of(view_of(tmp_path)) == cells_of(map_under(NEW, [moved(1, 3), scan_of(2)]))


@pytest.mark.slow
@pytest.mark.processes
def test_the_job_queue_of_the_page_gives_the_same_with_one_folder_a_job(tmp_path: Path) -> None:
    for name in ("mole", "wren", "newt"):
        with keeper(tmp_path / "fleet", name=name) as robot:
            measured(robot, 1, 2)
    rig_file(tmp_path).rename(tmp_path / "recalibrated.json")
    (tmp_path / "cairn").write_text(f'#!/bin/sh\nexec {sys.executable} -m cairn_client.main "$@"\n')
    (tmp_path / "cairn").chmod(0o755)
    found = re.search(r"^ +\$ (ls .*xargs.*)$", (DOCS / "calibration-engineer.md").read_text(), re.MULTILINE)
    assert found is not None
    path = f"{tmp_path}:{os.environ['PATH']}"
    for amended in (1, 0):
        done = subprocess.run(
            ["bash", "-c", found[1]], cwd=tmp_path, env=os.environ | {"PATH": path}, capture_output=True, text=True,
            check=False,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        assert done.stdout.count(f": {amended} measurement") == 3
    for name in ("mole", "wren", "newt"):
        assert cells_of(view_of(tmp_path / "fleet", name)) == cells_of(map_under(NEW, [scan_of(1), scan_of(2)]))


# Kills


class Killed(BaseException):
    """The end of a process, at a step."""


@contextmanager
def killed_at(step: int) -> Iterator[list[int]]:
    """Die at a step: before each transaction's end, after it, and before and after the scans get their new name."""
    steps, patch = [0], pytest.MonkeyPatch()
    transaction, rename = ReplicaStore.transaction, KeptScans.rename

    def passed() -> None:
        steps[0] += 1
        if steps[0] == step:
            raise Killed

    @contextmanager
    def mortal_transaction(store: ReplicaStore) -> Iterator[None]:
        with transaction(store):
            yield
            passed()
        passed()

    def mortal_rename(kept: KeptScans, commit: CommitId, new: CommitId) -> None:
        passed()
        rename(kept, commit, new)
        passed()

    patch.setattr(ReplicaStore, "transaction", mortal_transaction)
    patch.setattr(KeptScans, "rename", mortal_rename)
    try:
        yield steps
    finally:
        patch.undo()


def run_out(folder: Path, rig: Rig) -> int:
    """Reprocess a folder in this process; the number of amends."""
    *_, report = reprocess(folder, Recipe(rig=rig))
    assert report.stopped is None and not report.plan.failed
    return report.amended


def test_killed_at_any_step_and_run_again_it_gives_the_same(tmp_path: Path) -> None:
    expected = cells_of(map_under(NEW, [moved(1, 3), scan_of(2), scan_of(3)]))
    step, kills = 1, 0
    while True:
        folder = tmp_path / str(step)
        with keeper(folder) as robot:
            robot.amend(measured(robot, 1), T_map_observed=drift(3))
            measured(robot, 2)
            measured(robot, 3)
        with killed_at(step) as steps:
            try:
                run_out(folder / "mole", NEW)
            except Killed:
                kills += 1
        if steps[0] < step:
            break
        # Each measurement is amended once, by this run or the one that was killed.
        run_out(folder / "mole", NEW)
        assert len(commits_in(folder)) == 4 + 3
        assert run_out(folder / "mole", NEW) == 0
        assert cells_of(view_of(folder)) == expected
        # The scans are those of the newest amend, for a rig to come and for a robot that moves them.
        assert run_out(folder / "mole", NEXT) == 3
        with keeper(folder) as robot:
            for commit in robot._kept_scans.commits:
                robot.amend(commit, T_map_observed=np.eye(4))
        step += 1
    assert kills >= 3 * 4


@pytest.mark.slow
@pytest.mark.processes
def test_after_a_kill_of_the_command_its_workers_let_go_and_the_same_command_goes_on(
    tmp_path: Path, until: Until
) -> None:
    names = ("mole", "wren")
    for name in names:
        with keeper(tmp_path, name=name) as robot:
            for n in range(120):
                measured(robot, n)
    rig = rig_file(tmp_path)
    command = [sys.executable, "-m", "cairn_client.main", "reprocess", *names, "--rig", str(rig), "--jobs", "2"]

    def has_amends() -> bool:
        """True once the scans of some amend, whose number follows those of the first commits, have its name."""
        return any(int(path.name.split(".")[-2]) >= 120 for path in tmp_path.glob("*/scans/*.scans"))

    with subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.DEVNULL) as running:
        until(lambda: has_amends() or running.poll() is not None)
        os.kill(running.pid, signal.SIGKILL)
    for name in names:
        until(lambda name=name: not plan_is_refused(tmp_path / name))  # type: ignore[misc]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    expected = cells_of(map_under(NEW, [scan_of(n) for n in range(120)]))
    for name in names:
        assert len(commits_in(tmp_path, name)) == 240
        assert cells_of(view_of(tmp_path, name)) == expected


def plan_is_refused(folder: Path) -> bool:
    try:
        plan_of(folder, Recipe(rig=NEW))
    except ConflictError:
        return True
    return False


# What is refused, and what is left as it is


def refused(capsys: pytest.CaptureFixture[str], *arguments: object, code: int = 1) -> str:
    """The message of a command that is refused."""
    capsys.readouterr()
    reprocessed(*arguments, code=code)
    return capsys.readouterr().err


@pytest.fixture
def two_folders(tmp_path: Path) -> list[Path]:
    """Folders of mole and wren with two measurements each."""
    for name in ("mole", "wren"):
        with keeper(tmp_path, name=name) as robot:
            measured(robot, 1)
            measured(robot, 2)
    return [tmp_path / "mole", tmp_path / "wren"]


@pytest.fixture
def rig(tmp_path: Path) -> Path:
    return rig_file(tmp_path)


def assert_nothing_was_written(two_folders: list[Path]) -> None:
    for folder in two_folders:
        assert len(commits_in(folder.parent, folder.name)) == 2


def test_what_is_no_robots_folder_is_refused_before_anything_is_written(
    two_folders: list[Path], rig: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert "[no_state_folder]" in refused(capsys, *two_folders, tmp_path, "--rig", rig)
    assert "[no_state_folder]" in refused(capsys, *two_folders, tmp_path / "none", "--rig", rig)
    with Robot(None, NOWHERE, directory=tmp_path / "copy", name="eye", mode="viewer", geometry=GEOMETRY):
        pass
    assert "which makes no commits" in refused(capsys, *two_folders, tmp_path / "copy", "--rig", rig, "--jobs", 1)
    assert_nothing_was_written(two_folders)


def test_a_folder_that_a_robot_has_open_is_refused(
    two_folders: list[Path], rig: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with keeper(tmp_path, name="wren"):
        assert "[folder_in_use]" in refused(capsys, *two_folders, "--rig", rig, "--jobs", 1, code=4)
    assert_nothing_was_written(two_folders)


def test_a_rig_that_cannot_be_read_or_lacks_a_camera_of_the_scans_is_refused(
    two_folders: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "no.json").write_text("{")
    other = rig_file(tmp_path, Rig(name="other", cameras={"lidar": NEW["tof"]}))
    larger = Camera(width=8, height=6, focal_px=(4.0, 4.0), centre_px=(1.5, 1.0))
    larger_file = rig_file(
        tmp_path, Rig(name="large", cameras={"tof": mount_camera(Spectrum.RANGE, larger, np.eye(4))})
    )
    options = (*two_folders, "--jobs", 1, "--rig")
    assert "cannot read" in refused(capsys, *options, tmp_path / "none.json")
    assert "[bad_rig]" in refused(capsys, *options, tmp_path / "no.json")
    message = refused(capsys, *options, other)
    assert "has no camera 'tof'" in message and "--old-rig" in message and "nothing was written" in message
    assert "do not fit the rig large" in refused(capsys, *options, larger_file)
    assert_nothing_was_written(two_folders)


def test_options_that_cannot_be_are_refused(
    two_folders: list[Path], rig: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = (*two_folders, "--rig", rig)
    assert "--jobs takes 1 or more" in refused(capsys, *options, "--jobs", 0)
    assert "[bad_range]" in refused(capsys, *options, "--max-range", "0.01")
    assert "1024 characters" in refused(capsys, *options, "--note", "x" * 1025)
    assert "--rig takes a rig.json" in refused(capsys, *options, "--old-rig", "none")
    assert_nothing_was_written(two_folders)


def test_several_rigs_are_replaced_by_name_alone(
    two_folders: list[Path], rig: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with keeper(tmp_path, name="wren") as robot:
        robot.mount(NEXT)
        measured(robot, 3)
    options = (*two_folders, "--rig", rig, "--jobs", 1)
    message = refused(capsys, *options)
    assert f"4 of {RIG.digest()}, 1 of {NEXT.digest()}" in message and "--old-rig" in message
    for old, mole, wren, other in ((rig_file(tmp_path, RIG), 2, 2, 1), (NEXT.digest(), 0, 1, 0)):
        first, second = reports(capsys, *options, "--old-rig", old)
        assert (first.amended, second.amended, second.other_rig) == (mole, wren, other)
    assert cells_of(view_of(tmp_path, "wren")) == cells_of(map_under(NEW, [scan_of(n) for n in (1, 2, 3)]))


def test_scans_that_are_not_kept_are_counted_and_named_and_the_others_amended(
    two_folders: list[Path], rig: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with keeper(tmp_path, keep_scans_bytes=0) as robot:
        lost = [measured(robot, n) for n in (5, 6)]
    for _ in range(2):  # the second time, too
        (report,) = reports(capsys, tmp_path / "mole", "--rig", rig, code=3)
        assert report.lost == [str(commit.id) for commit in lost]
    message = refused(capsys, *two_folders, "--rig", rig, "--jobs", 1, code=3)
    assert "2 measurements cannot be integrated again" in message and "[no_scans]" in message
    reprocessed(tmp_path / "mole", "--rig", rig, code=3)
    assert f"the scans of 2 are not kept any more: {lost[0].id}-3" in capsys.readouterr().out
    expected = map_under(NEW, [scan_of(1), scan_of(2)])
    expected.merge(map_under(RIG, [scan_of(5), scan_of(6)]).packed())
    assert cells_of(view_of(tmp_path)) == cells_of(expected)


def test_measurements_of_the_new_rig_need_no_scans(
    tmp_path: Path, rig: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with keeper(tmp_path, keep_scans_bytes=0) as robot:
        robot.mount(NEW)
        measured(robot, 1)
    (report,) = reports(capsys, tmp_path / "mole", "--rig", rig)
    assert (report.amended, report.lost) == (0, [])


@pytest.mark.parametrize("damage", ["flipped", "cut", "scan lost"])
def test_damaged_scans_are_named_and_the_others_amended(
    two_folders: list[Path], rig: Path, tmp_path: Path, damage: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with keeper(tmp_path) as robot:
        bad = measured(robot, 5, 6)
    (path,) = (tmp_path / "mole/scans").glob(f"*{bad.id}.scans")
    data = bytearray(path.read_bytes())
    data[-30] ^= 1
    path.write_bytes({"flipped": data, "cut": data[:-7], "scan lost": data[: len(data) // 2]}[damage])
    for amended in (2, 0):
        (report,) = reports(capsys, tmp_path / "mole", "--rig", rig, code=6)
        assert report.amended == amended
        assert list(report.failed) == [str(bad.id)] and "[damaged_scan]" in report.failed[str(bad.id)]


def test_a_dry_run_says_what_would_be_done_and_changes_nothing(
    two_folders: list[Path], rig: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    reprocessed(*two_folders, "--rig", rig, "--dry-run", "--jobs", 1)
    out = capsys.readouterr().out
    for folder in two_folders:
        assert f"{folder}: 2 measurements of {folder.name} would be amended\n" in out
    assert_nothing_was_written(two_folders)


def test_the_amends_say_why_and_wait_for_the_next_sync(
    two_folders: list[Path], rig: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    reprocessed(*two_folders, two_folders[0], "--rig", rig, "--note", "tof moved", "--profile", "small", "--jobs", 1)
    out = capsys.readouterr().out
    assert f"{two_folders[0]}: 2 measurements of mole amended; 4 commits wait" in out
    assert f"push them: cairn robot sync {two_folders[0]}; cairn robot sync {two_folders[1]}" in out
    with keeper(tmp_path) as robot:
        kept = robot.replica.kept_commit(robot.replica.commits[-1])
        assert kept is not None
        assert (kept.meta.note, kept.meta.rig, kept.meta.sensors) == ("tof moved", NEW.digest(), ("tof",))
        assert kept.meta.captured_s == (1.5e9 + 2, 1.5e9 + 2)


def test_a_full_outbox_stops_a_folder_that_goes_on_after_a_sync(
    server: LiveServer, rig: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with keeper(tmp_path, server.map_url, limits=Limits(outbox_bytes_max=LEAST_BYTES, keep_acked_s=0)) as robot:
        count = 0
        while robot.replica.kept_bytes() < LEAST_BYTES - 20_000:
            measured(robot, count)
            count += 1
    (report,) = reports(capsys, tmp_path / "mole", "--rig", rig, code=5)
    assert "[outbox_full]" in report.stopped and 0 < report.amended < 10
    runs = 1
    while report.amended + report.done_before < count:
        synced(server, tmp_path / "mole")
        capsys.readouterr()
        code = cairn.main(["reprocess", str(tmp_path / "mole"), "--rig", str(rig), "--json"])
        report = ReprocessedFolder.model_validate_json(capsys.readouterr().out)
        runs += 1
        assert code in (0, 5) and runs < 20
    synced(server, tmp_path / "mole")
    assert server_cells(server) == cells_of(map_under(NEW, [scan_of(n) for n in range(count)]))
