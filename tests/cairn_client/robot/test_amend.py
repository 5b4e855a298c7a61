"""Amends: after a loop closure the map is the one that the corrected poses would have given from the start."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from tests.fixtures.client.live_server import LiveServer
from tests.fixtures.client.made import GEOMETRY, PLAIN, cells_of
from tests.fixtures.client.robot_program import INTEGRATOR, RIG, scan_of
from tests.fixtures.client.world import stored_commits

from cairn_calib.rig.poses import Transform, look_at
from cairn_client.replica.limits import Limits
from cairn_client.robot.kept_scans import OPEN, KeptScans
from cairn_client.robot.robot import Robot
from cairn_fusion.mapping.integrate import integrate_scan
from cairn_fusion.recording.scan import Scan
from cairn_map.commits.commit import Commit
from cairn_map.commits.ids import CommitId
from cairn_map.epochs.history_map import HistoryMap
from cairn_map.errors import BadInputError, ConflictError, DamagedDataError, NotFoundError

NOWHERE = "http://127.0.0.1:9/maps/lab"
PLENTY = 10_000_000


def robot_in(
    folder: Path,
    url: str = NOWHERE,
    *,
    name: str = "mole",
    keep_scans_bytes: int = PLENTY,
    limits: Limits | None = None,
) -> Robot:
    return Robot(
        RIG, url, directory=folder / name, name=name, geometry=GEOMETRY, integrator=INTEGRATOR,
        keep_scans_bytes=keep_scans_bytes, limits=limits,
    )  # fmt: skip


def moved(scan: Scan, T_map_rig: Transform) -> Scan:
    return dataclasses.replace(scan, T_map_rig=T_map_rig)


def sum_of(scans: Sequence[Scan]) -> HistoryMap:
    total = HistoryMap(PLAIN)
    for scan in scans:
        total.merge(integrate_scan(scan, RIG, GEOMETRY, integrator=INTEGRATOR))
    return total


def measured(robot: Robot, *seeds: int) -> Commit:
    for seed in seeds:
        robot.observe(scan_of(seed))
    commit = robot.commit()
    assert commit is not None
    return commit


def drift(seed: int) -> Transform:
    """A few centimetres and degrees."""
    rng = np.random.default_rng(seed)
    T = look_at(np.zeros(3), np.array([1, 0, 0]) + rng.normal(0, 0.05, 3)) @ np.linalg.inv(
        look_at(np.zeros(3), (1, 0, 0))
    )
    T[:3, 3] = rng.normal(0, 0.1, 3)
    return np.asarray(T)


def corrected(*seeds: int) -> list[Scan]:
    return [moved(scan_of(seed), drift(seed) @ scan_of(seed).T_map_rig) for seed in seeds]


def poses_of(scans: Sequence[Scan]) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    return np.array([scan.T_map_rig for scan in scans])


# The law


@pytest.mark.slow
def test_after_a_loop_closure_of_50_measurements_all_maps_are_those_of_the_corrected_poses(
    server: LiveServer, tmp_path: Path
) -> None:
    seeds = [(2 * n, 2 * n + 1) for n in range(50)]
    truth = cells_of(sum_of([scan for pair in seeds for scan in corrected(*pair)]))
    with robot_in(tmp_path, server.map_url) as mole, robot_in(tmp_path, server.map_url, name="fox") as fox:
        commits = [measured(mole, *pair) for pair in seeds[:30]]
        mole.sync()
        server.wait_for_fold()
        mole.sync()
        fox.sync()
        commits += [measured(mole, *pair) for pair in seeds[30:]]  # the server has never heard of these
        assert cells_of(mole.map) != truth
        amends = mole.amend_all({c.id: poses_of(corrected(*pair)) for c, pair in zip(commits, seeds, strict=True)})
        assert cells_of(mole.map) == truth  # at once, without a link
        assert [amend.meta.retracted_ids for amend in amends] == [(commit.id,) for commit in commits]
        mole.sync()
        server.wait_for_fold()
        with robot_in(tmp_path, server.map_url, name="late") as late:
            for robot in (mole, fox, late):
                robot.sync()
                assert cells_of(robot.map) == truth
        row = server.service.store.map("lab")
        with server.service.store.snapshot(row) as snapshot:
            assert {
                cell.key: (cell.digest, cell.fingerprint.hex()) for cell in snapshot.cells() if cell.voxels
            } == truth
    assert len(stored_commits(tmp_path / "server")) == 100


# One amend


def test_one_correction_moves_all_scans_and_is_counted_from_the_observed_poses(tmp_path: Path) -> None:
    with robot_in(tmp_path) as robot:
        commit = measured(robot, 1, 2)
        robot.amend(commit, T_map_observed=drift(5))
        robot.amend(commit, T_map_observed=drift(6))
        expected = [moved(scan_of(seed), drift(6) @ scan_of(seed).T_map_rig) for seed in (1, 2)]
        assert cells_of(robot.map) == cells_of(sum_of(expected))


def test_amending_again_names_the_latest_amend_whatever_it_is_asked_for(server: LiveServer, tmp_path: Path) -> None:
    with robot_in(tmp_path, server.map_url) as robot:
        first = measured(robot, 1)
        second = robot.amend(first, T_map_observed=drift(1))
        robot.sync()
        third = robot.amend(first.id, T_map_observed=drift(2))
        fourth = robot.amend(str(second.id), T_map_observed=drift(3))
        assert [c.meta.retracted_ids for c in (second, third, fourth)] == [(first.id,), (second.id,), (third.id,)]
        robot.sync()
        server.wait_for_fold()
        robot.sync()
        assert cells_of(robot.map) == cells_of(sum_of([moved(scan_of(1), drift(3) @ scan_of(1).T_map_rig)]))


def test_a_robot_can_amend_what_it_measured_and_amended_before_a_restart(tmp_path: Path) -> None:
    with robot_in(tmp_path) as robot:
        first, other = measured(robot, 1), measured(robot, 2)
        robot.amend(first, T_map_observed=drift(9))
    with robot_in(tmp_path) as robot:
        robot.amend_all({str(commit.id): poses_of(corrected(n)) for n, commit in enumerate((first, other), 1)})
        assert cells_of(robot.map) == cells_of(sum_of(corrected(1, 2)))


def test_an_amend_is_seen_at_once_although_the_commit_is_stable_everywhere(server: LiveServer, tmp_path: Path) -> None:
    with robot_in(tmp_path, server.map_url) as robot:
        commit = measured(robot, 1)
        for _ in range(3):
            robot.sync()
            server.wait_for_fold()
        server.stop()
        robot.amend(commit, poses_of(corrected(1)))
        assert cells_of(robot.map) == cells_of(sum_of(corrected(1)))


def test_commits_leave_the_robot_when_their_scans_did(server: LiveServer, tmp_path: Path) -> None:
    with robot_in(tmp_path, server.map_url, keep_scans_bytes=900, limits=Limits(keep_acked_s=0)) as robot:
        commits = [measured(robot, seed) for seed in range(1, 7)]
        for _ in range(3):
            robot.sync()
            server.wait_for_fold()
        kept = robot.replica.commits
        assert kept == [commit.id for commit in commits][-len(kept) :]
        assert 0 < len(kept) < len(commits)


def test_a_replaced_commit_stays_hidden_when_the_amends_bytes_have_gone_first(
    server: LiveServer, tmp_path: Path
) -> None:
    """Pushed together, they leave cells that the server never had: there the first commit's bytes stay, and showed."""
    limits = Limits(disk_bytes_max=1_000_000, keep_acked_s=0)
    with robot_in(tmp_path, server.map_url, limits=limits) as robot:
        amend = robot.amend(measured(robot, 1), poses_of(corrected(1)))
        for _ in range(3):
            robot.sync()
            server.wait_for_fold()
        assert amend.id not in robot.replica.commits
    with robot_in(tmp_path, server.map_url) as robot:
        assert cells_of(robot.map) == cells_of(sum_of(corrected(1)))


def test_a_kill_between_an_amend_and_its_note_on_the_scans_leaves_them_to_amend(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def killed(*_: object) -> None:
        raise KeyboardInterrupt

    with robot_in(tmp_path) as robot:
        commit = measured(robot, 1)
        monkeypatch.setattr(KeptScans, "rename", killed)
        for seed in (3, 4):
            with pytest.raises(KeyboardInterrupt):
                robot.amend(commit, T_map_observed=drift(seed))
        monkeypatch.undo()
    with robot_in(tmp_path) as robot:
        robot.amend(commit, poses_of(corrected(1)))
        assert cells_of(robot.map) == cells_of(sum_of(corrected(1)))
        robot.retract(commit)
        refused_amend(robot, commit, "taken_back")


def test_the_open_measurement_stays_open(tmp_path: Path) -> None:
    with robot_in(tmp_path) as robot:
        commit = measured(robot, 1)
        robot.observe(scan_of(2))
        robot.amend(commit, poses_of(corrected(1)))
        robot.commit()
        assert cells_of(robot.map) == cells_of(sum_of([*corrected(1), scan_of(2)]))


def test_an_amend_states_the_new_poses_and_the_times_of_the_scans(tmp_path: Path) -> None:
    with robot_in(tmp_path) as robot:
        amend = robot.amend(measured(robot, 1, 2), poses_of(corrected(1, 2)), note="closed a loop")
    assert amend.meta.note == "closed a loop"
    assert amend.meta.captured_s == (1.5e9 + 1, 1.5e9 + 2)
    stated = [pose.t_map_rig for pose in amend.meta.scans]
    assert np.allclose(stated, [scan.T_map_rig[:3, 3] for scan in corrected(1, 2)])


# What cannot be amended


def refused_amend(robot: Robot, commit: Commit | CommitId | str, kind: str, **poses: object) -> str:
    """The message of an amend that is refused and changes nothing."""
    before = cells_of(robot.map), robot.replica.commits
    with pytest.raises((BadInputError, NotFoundError, ConflictError, DamagedDataError)) as refused:
        robot.amend(commit, **(poses or {"T_map_observed": drift(1)}))  # type: ignore[arg-type]
    assert refused.value.kind == kind
    assert (cells_of(robot.map), robot.replica.commits) == before
    return refused.value.message


def test_scans_that_had_to_go_are_said_to_be_gone_and_how_to_keep_more(tmp_path: Path) -> None:
    with robot_in(tmp_path, keep_scans_bytes=900) as robot:
        old = measured(robot, 1)
        new = [measured(robot, seed) for seed in range(2, 7)][-1]
        assert 0 < robot._kept_scans.size_bytes <= 900
        message = refused_amend(robot, old, "no_scans")
        assert "older ones went" in message
        assert "keep_scans_bytes" in message
        with pytest.raises(NotFoundError):  # none of them, then
            robot.amend_all({new.id: poses_of(corrected(6)), old.id: poses_of(corrected(1))})
        assert len(robot.replica.commits) == 6
        robot.amend(new, poses_of(corrected(6)))


def test_a_robot_that_keeps_no_scans_says_so(tmp_path: Path) -> None:
    with robot_in(tmp_path, keep_scans_bytes=0) as robot:
        assert "open it with keep_scans_bytes=" in refused_amend(robot, measured(robot, 1), "no_scans")
    assert not (tmp_path / "mole/scans").exists()


def test_a_measurement_larger_than_the_buffer_is_mapped_all_the_same(tmp_path: Path) -> None:
    with robot_in(tmp_path, keep_scans_bytes=900) as robot:
        assert "they alone are larger" in refused_amend(robot, measured(robot, *range(1, 12)), "no_scans")
        assert cells_of(robot.map) == cells_of(sum_of([scan_of(seed) for seed in range(1, 12)]))
        robot.amend(measured(robot, 20), poses_of(corrected(20)))


def test_a_disk_that_takes_no_scans_costs_no_evidence(tmp_path: Path) -> None:
    with robot_in(tmp_path) as robot:
        (tmp_path / "mole/scans").write_text("a file")
        assert "the disk did not take them" in refused_amend(robot, measured(robot, 1, 2), "no_scans")
        assert cells_of(robot.map) == cells_of(sum_of([scan_of(1), scan_of(2)]))


def test_a_disk_that_gets_full_costs_no_evidence(tmp_path: Path) -> None:
    with robot_in(tmp_path) as robot:
        (tmp_path / "mole/scans").mkdir()
        (tmp_path / "mole/scans" / OPEN).symlink_to("/dev/full")
        seeds = range(1, 151)  # more than is buffered
        refused_amend(robot, measured(robot, *seeds), "no_scans")
        assert cells_of(robot.map) == cells_of(sum_of([scan_of(seed) for seed in seeds]))
        robot.amend(measured(robot, 200), poses_of(corrected(200)))  # there is room again


@pytest.mark.parametrize("damage", ["cut", "flipped"])
def test_damaged_scans_are_said_to_be_damaged(tmp_path: Path, damage: str) -> None:
    with robot_in(tmp_path) as robot:
        commit = measured(robot, 1, 2)
        (path,) = (tmp_path / "mole/scans").glob("*.scans")
        data = bytearray(path.read_bytes())
        data[-30] ^= 1
        path.write_bytes(data[:-7] if damage == "cut" else data)
        refused_amend(robot, commit, "damaged_scan")


def test_poses_that_are_none_or_too_few_or_too_many_are_refused(tmp_path: Path) -> None:
    with robot_in(tmp_path) as robot:
        commit = measured(robot, 1, 2)
        for count in (0, 1, 3):
            message = refused_amend(robot, commit, "bad_transform", T_map_rig=np.tile(np.eye(4), (count, 1, 1)))
            assert "2 scans" in message
        refused_amend(robot, commit, "bad_transform", T_map_rig=np.eye(4))
        refused_amend(robot, commit, "bad_transform", T_map_rig=np.zeros((2, 4, 4)))
        refused_amend(robot, commit, "bad_transform", T_map_observed=np.diag([2.0, 1, 1, 1]))
        refused_amend(robot, commit, "bad_option", T_map_rig=None)
        refused_amend(robot, commit, "bad_option", T_map_rig=np.eye(4)[None], T_map_observed=np.eye(4))
        refused_amend(robot, "no.id", "bad_id")


def test_what_was_taken_back_otherwise_is_not_amended(tmp_path: Path) -> None:
    with robot_in(tmp_path) as robot:
        first, second = measured(robot, 1), measured(robot, 2)
        robot.observe(scan_of(3))
        third = robot.commit(retracts=(first.id, second.id))
        assert third is not None
        for commit in (first, second):
            assert str(third.id) in refused_amend(robot, commit, "taken_back")
        robot.amend(third, poses_of(corrected(3)))
        assert cells_of(robot.map) == cells_of(sum_of(corrected(3)))


def test_a_commit_that_got_a_new_id_can_be_amended_by_the_old_one(tmp_path: Path) -> None:
    with robot_in(tmp_path) as robot:
        commit = measured(robot, 1)
        robot.amend(commit, T_map_observed=drift(3))
        for kept in robot.replica.commits:
            robot.replica.rename(kept)
        robot.amend(commit, poses_of(corrected(1)))
        assert cells_of(robot.map) == cells_of(sum_of(corrected(1)))


def test_a_robot_without_a_rig_amends_nothing(tmp_path: Path) -> None:
    with robot_in(tmp_path) as robot:
        commit = measured(robot, 1)
    with Robot(None, NOWHERE, directory=tmp_path / "mole", name="mole", geometry=GEOMETRY) as robot:
        refused_amend(robot, commit, "no_rig")


def test_what_was_never_measured_here_is_told_as_such(tmp_path: Path) -> None:
    """Both were "not kept: older ones went"."""
    with robot_in(tmp_path) as robot:
        commit = measured(robot, 1)
        unknown = str(commit.id).rpartition(".")[0] + ".77"
        assert "this folder knows no such commit" in refused_amend(robot, unknown, "no_scans")
        others = str(commit.id).replace("mole.", "wren.")
        assert "it is wren's, and this robot, mole, amends its own alone" in refused_amend(robot, others, "no_scans")
