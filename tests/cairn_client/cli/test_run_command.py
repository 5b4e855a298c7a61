"""`cairn robot run`: what a driver puts into a spool is mapped, each measurement once, through signals and kills."""

import argparse
import os
import random
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
from tests.fixtures.client.live_server import LiveServer
from tests.fixtures.client.made import GEOMETRY, cells_of
from tests.fixtures.client.robot_program import INTEGRATOR, RIG, scan_of
from tests.fixtures.client.robots import robot_in
from tests.fixtures.client.world import stored_commits

from cairn_client import main as cairn
from cairn_client.cli.robots.run import _commit, _map_what_came, _Tally
from cairn_client.folders.spool import Spool, SpoolMark, remember
from cairn_fusion.mapping.integrate import integrate_scan
from cairn_fusion.recording.recording import open_recording
from cairn_fusion.recording.recording_writer import RecordingWriter
from cairn_map.codec.cell_code import Profile
from cairn_map.commits.commit import Commit
from cairn_map.errors import BadInputError, UnreachableError
from cairn_map.evidence.evidence_map import EvidenceMap

Until = Callable[[Callable[[], bool]], None]


def record(spool: Path, name: str, *stops: Sequence[int]) -> Path:
    """A recording with measurements of these scans."""
    with RecordingWriter(spool / name, RIG, name=name) as recording:
        for stop in stops:
            for seed in stop:
                recording.add(scan_of(seed))
            recording.end_measurement()
    return spool / name


def evidence_in(spool: Path) -> EvidenceMap:
    """The sum of all recordings."""
    total = EvidenceMap(GEOMETRY)
    for path in spool.iterdir():
        for scan in open_recording(path):
            total.merge(integrate_scan(scan, RIG, GEOMETRY, integrator=INTEGRATOR))
    return total


def process(spool: Path, url: str, *options: str) -> "subprocess.Popen[str]":
    state = ("--state", str(spool.parent / "mole"), "--name", "mole", "--max-range", "2", "--every", "0.05")
    command = [sys.executable, "-m", "cairn_client.main", "robot", "run", str(spool), "--map", url, *state, *options]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def ended(running: "subprocess.Popen[str]", number: int = signal.SIGTERM) -> str:
    """Output of a run that a signal ends."""
    running.send_signal(number)
    out, err = running.communicate(timeout=30)
    assert running.returncode == 0, err
    return out


@pytest.fixture
def spool(tmp_path: Path) -> Path:
    folder = tmp_path / "spool"
    folder.mkdir()
    return folder


@pytest.mark.processes
def test_what_comes_is_mapped_once_and_pushed_until_a_signal(
    server: LiveServer, spool: Path, tmp_path: Path, until: Until
) -> None:
    stored = tmp_path / "server"
    with process(spool, server.map_url) as running:
        record(spool, "0001", [1, 2], [3])
        until(lambda: len(stored_commits(stored)) == 2)
        record(spool, "0002", [4])
        until(lambda: len(stored_commits(stored)) == 3)
        assert "mapped 4 scans as 3 commits" in ended(running)
    with process(spool, server.map_url) as running:
        record(spool, "0003", [5])
        until(lambda: len(stored_commits(stored)) == 4)
        assert "mapped 1 scans as 1 commits" in ended(running, signal.SIGINT)
    server.wait_for_fold()
    with robot_in(tmp_path, server.map_url, name="bat") as bat:
        bat.sync()
        assert cells_of(bat.map) == cells_of(evidence_in(spool))


@pytest.mark.processes
def test_kills_lose_nothing_and_count_nothing_twice(
    server: LiveServer, spool: Path, tmp_path: Path, until: Until
) -> None:
    for n in range(12):
        record(spool, f"{n:04}", [4 * n, 4 * n + 1], [4 * n + 2], [4 * n + 3])
    moments = random.Random(5)
    for _ in range(2):
        with process(spool, server.map_url) as running:
            assert running.stderr is not None
            for _ in range(moments.randrange(1, 10)):
                running.stderr.readline()
            os.kill(running.pid, signal.SIGKILL)
    with process(spool, server.map_url) as running:
        until(lambda: len(stored_commits(tmp_path / "server")) == 36)
        assert " 0 commits wait" in ended(running)
    server.wait_for_fold()
    assert len(stored_commits(tmp_path / "server")) == 36
    with robot_in(tmp_path, server.map_url, name="bat") as bat:
        bat.sync()
        assert cells_of(bat.map) == cells_of(evidence_in(spool))


@pytest.mark.processes
def test_a_recording_that_begins_with_a_damaged_scan_does_not_say_what_there_is_to_map(
    server: LiveServer, spool: Path, tmp_path: Path, until: Until
) -> None:
    image = sorted(record(spool, "0001", [1, 2]).rglob("*.png"))[0]
    image.write_bytes(image.read_bytes()[:40])
    with process(spool, f"{server.url}/maps/new", "--voxel", "0.05") as running:
        assert running.stderr is not None
        assert "0001 cannot be the first recording of a map" in running.stderr.readline()
        record(spool, "0002", [3])
        until(lambda: len(stored_commits(tmp_path / "server")) == 2)
        assert "mapped 2 scans as 2 commits" in ended(running)


@pytest.mark.processes
def test_scans_are_kept_and_others_commits_are_carried_if_one_wants_that(
    server: LiveServer, spool: Path, tmp_path: Path, until: Until
) -> None:
    with robot_in(tmp_path, server.map_url, name="bat") as bat:
        bat.observe(scan_of(9))
        bat.commit()
        bat.sync()
    record(spool, "0001", [1])
    state = tmp_path / "mole"
    with process(spool, server.map_url, "--keep-scans", "1", "--carry", "1") as running:
        until(lambda: len(list(state.glob("scans/*.scans"))) == 1 and len(list(state.glob("carried/bat.*"))) == 1)
        ended(running)


@pytest.mark.processes
def test_mapped_recordings_are_deleted_if_one_wants_that(
    server: LiveServer, spool: Path, tmp_path: Path, until: Until
) -> None:
    (spool / "0000").mkdir()
    (spool / "0000" / "rig.json").write_text("{}")  # not whole yet
    record(spool, "0001", [1])
    with process(spool, server.map_url, "--delete", "--stay", "--disk-max", "50", "--outbox-max", "20") as running:
        until(lambda: not (spool / "0001").exists())
        record(spool, "0001", [2])  # the name is free again
        until(lambda: not (spool / "0001").exists())
        assert "mapped 2 scans as 2 commits" in ended(running)
    assert (spool / "0000").exists()


def test_a_spool_is_read_in_order_and_only_what_is_whole_and_sound(spool: Path, tmp_path: Path) -> None:
    with robot_in(tmp_path) as mole:
        watched = Spool(spool)
        assert watched.next_recording() is None
        record(spool, "b", [3])
        record(spool, "a", [1], [2])
        (spool / ".c").mkdir()
        (spool / "note.txt").write_text("not a recording")
        record(spool, "d", [4])
        (spool / "d" / "tof.txt").write_text("nonsense")
        record(spool, "e", [5]).joinpath("recording.json").unlink()
        found = [(stop.folder.name, stop.scans.start) for stop in watched.stops(mole.replica)]
        assert found == [("a", 0), ("a", 1), ("b", 0)]
        again = Spool(spool)
        remember(mole.replica, next(iter(again.stops(mole.replica))).mark())
        assert [(stop.folder.name, stop.scans.start) for stop in again.stops(mole.replica)] == [("a", 1), ("b", 0)]


def test_scans_that_nobody_grouped_are_grouped_and_go_on_where_a_mark_of_single_scans_ended(
    spool: Path, tmp_path: Path
) -> None:
    """A mark from before counted measurements of one scan each: the same number counts scans."""
    record(spool, "a", list(range(1, 6)))
    (spool / "a" / "measurements.txt").unlink()
    with robot_in(tmp_path) as mole:
        (stop,) = Spool(spool).stops(mole.replica)
        assert stop.scans == range(5)
        first_s = stop.source.files[0].time_s
        remember(mole.replica, {"spool/a": SpoolMark(first_s=first_s, stops=2, is_done=False).model_dump_json()})
        (stop,) = Spool(spool).stops(mole.replica)
        assert stop.scans == range(2, 5)
        remember(mole.replica, stop.mark())
        assert list(Spool(spool).stops(mole.replica)) == []


def test_another_recording_under_an_old_name_is_mapped(spool: Path, tmp_path: Path) -> None:
    with robot_in(tmp_path) as mole:
        record(spool, "a", [1])
        (stop,) = Spool(spool).stops(mole.replica)
        remember(mole.replica, stop.mark())
        assert list(Spool(spool).stops(mole.replica)) == []
        for path in sorted((spool / "a").rglob("*"), reverse=True):
            path.rmdir() if path.is_dir() else path.unlink()
        record(spool, "a", [2])
        assert len(list(Spool(spool).stops(mole.replica))) == 1


def test_a_recording_under_an_old_name_is_not_deleted_before_it_is_mapped(spool: Path, tmp_path: Path) -> None:
    with robot_in(tmp_path) as mole:
        watched = Spool(spool)
        record(spool, "a", [1])
        (stop,) = watched.stops(mole.replica)
        remember(mole.replica, stop.mark())
        (spool / "a").rename(tmp_path / "moved")  # by the driver, which begins to count again
        record(spool, "a", [2])
        watched.delete_done(mole.replica)
        Spool(spool).delete_done(mole.replica)  # after a restart
        (stop,) = watched.stops(mole.replica)
        assert stop.source.files[0].time_s == scan_of(2).time_s
        remember(mole.replica, stop.mark())
        assert list(watched.stops(mole.replica)) == []
        (spool / ".0.going").mkdir()  # the power was cut
        watched.delete_done(mole.replica)
        assert list(spool.iterdir()) == []


def test_a_mark_is_kept_with_its_commit_or_not_at_all(
    spool: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    record(spool, "a", [1])
    with robot_in(tmp_path) as mole:
        (stop,) = Spool(spool).stops(mole.replica)
        mole.observe(stop.source.scan(0))
        add_commit = mole.replica.store.add_commit
        stopping = threading.Event()

        def full(commit: Commit, *, seal: str | None = None) -> None:
            add_commit(commit, seal=seal)
            stopping.set()
            raise UnreachableError("store_failed", "the disk is full")

        monkeypatch.setattr(mole.replica.store, "add_commit", full)
        monkeypatch.setattr("cairn_client.cli.robots.run.COMMIT_AGAIN_S", 0.0)
        assert not _commit(mole, stop, Profile.FAST, _Tally(), stopping)
        assert mole.replica.store.get("spool/a") is None
        monkeypatch.undo()
    with robot_in(tmp_path) as mole:  # neither was kept, nor when the robot was closed
        assert mole.waiting == 0
        (stop,) = Spool(spool).stops(mole.replica)
        mole.observe(stop.source.scan(0))
        assert _commit(mole, stop, Profile.FAST, _Tally(), threading.Event())
        assert list(Spool(spool).stops(mole.replica)) == []
        remember(mole.replica, dict.fromkeys(stop.mark()))
        mole.observe(scan_of(7))
        assert mole.commit() is not None
        assert len(list(Spool(spool).stops(mole.replica))) == 1  # the next commit says nothing of it
        assert mole.waiting == 2


def test_a_measurement_that_no_commit_can_be_made_of_stops_nothing(
    spool: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    record(spool, "a", [1], [2])
    record(spool, "b", [3])
    with robot_in(tmp_path) as mole:
        commit = mole.commit

        def picky(**options: Any) -> Commit | None:
            if mole._measurement and mole._measurement.poses[0].time_s == scan_of(1).time_s:
                raise BadInputError("too_large", "256 MiB at most")
            return commit(**options)

        monkeypatch.setattr(mole, "commit", picky)
        args, tally = argparse.Namespace(profile="fast", delete=True), _Tally()
        _map_what_came(mole, Spool(spool), args, tally, threading.Event())
        assert (tally.commits, mole.waiting) == (2, 2)
        assert "scans 0 to 0 of" in caplog.text and "256 MiB at most" in caplog.text
        assert [path.name for path in spool.iterdir()] == ["a"]  # it is not deleted: not all of it is mapped
        assert list(Spool(spool).stops(mole.replica)) == []  # after a restart


def test_a_robot_takes_another_head_between_its_measurements(tmp_path: Path) -> None:
    with robot_in(tmp_path) as mole:
        mole.observe(scan_of(1))
        with pytest.raises(BadInputError, match="discard"):
            mole.mount(RIG)
        mole.discard()
        mole.mount(RIG)
        assert mole.commit() is None


def test_a_folder_that_is_no_spool_is_refused(spool: Path) -> None:
    url = "http://127.0.0.1:9/maps/lab"
    assert cairn.main(["robot", "run", str(spool / "none"), "--map", url]) == 1
    assert cairn.main(["robot", "run", str(record(spool, "a", [1])), "--map", url]) == 1
    assert cairn.main(["robot", "run", str(spool), "--map", url, "--every", "0"]) == 1
    assert cairn.main(["robot", "run", str(spool), "--map", url, "--carry", "-1"]) == 1
    assert cairn.main(["robot", "run", str(spool), "--map", url, "--disk-max", "0.001"]) == 1
