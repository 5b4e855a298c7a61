"""Mistakes of a robot's program: each is named with its numbers, and none becomes evidence."""

import dataclasses
import os
import threading
from pathlib import Path

import numpy as np
import pytest
from tests.fixtures.client.live_server import LiveServer
from tests.fixtures.client.robot_program import TOF, scan_of
from tests.fixtures.client.robots import evidence_of, map_commit, robot_in

from cairn_calib.rig.rig import Rig, Spectrum, mount_camera
from cairn_client.robot.robot import Robot
from cairn_fusion.recording.scan import Scan
from cairn_fusion.recording.scan_units import kelvin_from_celsius
from cairn_map.errors import BadInputError, CairnError, ConflictError, UnreachableError

THERMAL_RIG = Rig(
    name="head",
    cameras={
        "tof": mount_camera(Spectrum.RANGE, TOF, np.eye(4)),
        "warm": mount_camera(Spectrum.THERMAL, TOF, np.eye(4)),
        "eye": mount_camera(Spectrum.COLOUR, TOF, np.eye(4)),
    },
)


def refusal(robot: Robot, scan: Scan) -> str:
    with pytest.raises(BadInputError) as refused:
        robot.observe(scan)
    assert robot.commit() is None
    return f"{refused.value.kind}: {refused.value.message}"


def test_numbers_in_another_unit_are_refused_with_the_likely_unit(tmp_path: Path) -> None:
    scan = scan_of(1)
    celsius = np.linspace(15, 40, 12, dtype=np.float32).reshape(3, 4)
    with robot_in(tmp_path) as robot:
        robot.mount(THERMAL_RIG)
        in_mm = refusal(robot, dataclasses.replace(scan, range_m=scan.range_m * 1000 + 1000))
        assert in_mm.startswith("bad_units: 12 of 12 ranges of tof lie beyond 1000 m, median ")
        assert "millimetres?" in in_mm
        assert "12 of 12 temperatures of warm lie below 150 K, median 27.5: degrees Celsius" in refusal(
            robot, dataclasses.replace(scan, thermal={"warm": celsius})
        )
        assert "milliseconds" in refusal(robot, dataclasses.replace(scan, time_s=1.76e12))
        robot.observe(dataclasses.replace(scan, thermal={"warm": kelvin_from_celsius(celsius)}))
        assert robot.commit() is not None


def test_an_array_in_the_place_of_images_by_camera_is_named(tmp_path: Path) -> None:
    image = np.zeros((3, 4, 3), np.uint8)
    with robot_in(tmp_path) as robot:
        robot.mount(THERMAL_RIG)
        wrong = dataclasses.replace(scan_of(1), colour=image)  # type: ignore[arg-type]
        assert "colour must be a mapping from cameras to images" in refusal(robot, wrong)


def test_scans_without_evidence_say_what_became_of_their_pixels(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    scan = scan_of(1)
    with robot_in(tmp_path) as robot:
        for ranges in (scan.range_m * np.nan, scan.range_m * 0, scan.range_m + 3):
            robot.observe(dataclasses.replace(scan, range_m=ranges.astype(np.float32)))
        assert robot.commit() is None
    said = "3 scans gave no evidence, nothing is committed: 0 of 36 pixels used, 12 no return, 12 too near, 12 too far"
    assert said in caplog.text


def test_a_step_that_no_robot_makes_is_doubted(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with robot_in(tmp_path) as robot:
        for n, x_m in enumerate((0.0, 0.4, 1200.0)):
            T_map_rig = np.eye(4)
            T_map_rig[0, 3] = x_m
            robot.observe(dataclasses.replace(scan_of(1), T_map_rig=T_map_rig, time_s=1.5e9 + n / 10))
            assert ("T_map_rig moved 1199.6 m in 0.1 s" in caplog.text) == (n == 2)


@pytest.mark.processes
def test_a_forked_process_is_refused_and_does_the_robot_no_harm(tmp_path: Path) -> None:
    with robot_in(tmp_path) as robot:
        robot.observe(scan_of(1))
        child = os.fork()
        if child == 0:
            code = 1
            try:
                robot.commit()
            except CairnError as exc:
                code = 0 if exc.kind == "robot_forked" else 2
            finally:
                robot.close()
                os._exit(code)
        assert os.waitpid(child, 0)[1] == 0
        assert robot.commit() is not None
        assert robot.map == evidence_of(1)


def test_threads_may_observe_and_commit_at_once(tmp_path: Path) -> None:
    seeds = range(24)
    with robot_in(tmp_path) as robot:

        def work(part: int) -> None:
            for seed in seeds[part::3]:
                robot.observe(scan_of(seed))
                robot.commit()

        threads = [threading.Thread(target=work, args=(part,)) for part in range(3)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert robot.map == evidence_of(*seeds)


# Level with the server


def test_a_robot_knows_when_the_map_holds_all_that_it_has(server: LiveServer, tmp_path: Path) -> None:
    with (
        robot_in(tmp_path, server.map_url) as mole,
        robot_in(tmp_path, server.map_url, name="wren") as wren,
    ):
        for robot, seeds in ((mole, (1, 2)), (wren, (3,))):
            for seed in seeds:
                map_commit(robot, seed)
            report = robot.sync(until_folded=True)
            assert report.is_up_to_date
        assert mole.map != wren.map
        assert mole.sync().is_up_to_date
        assert mole.map == wren.map == evidence_of(1, 2, 3)
        assert mole.map.digest() == wren.map.digest()
        map_commit(mole, 4)
        assert mole.map.digest() != wren.map.digest()
        server.stop()
        with pytest.raises(UnreachableError):
            mole.sync(until_folded=True)
        server.start()


def test_a_map_that_is_not_folded_in_time_is_said_not_to_be(
    server: LiveServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with robot_in(tmp_path, server.map_url) as robot:
        robot.sync()
        map_commit(robot, 1)
        monkeypatch.setattr(robot.replica, "behind", lambda: (0, 1))
        report = robot.sync()
        assert (report.pending, report.is_up_to_date) == (1, False)
        with pytest.raises(UnreachableError, match="lacks 1 own commits still; nothing is lost") as late:
            robot.sync(until_folded=True, within_s=0.1)
        assert late.value.kind == "not_folded"


# Retracts


def test_a_retract_takes_the_latest_amend_back_and_a_second_one_says_so(server: LiveServer, tmp_path: Path) -> None:
    with robot_in(tmp_path, server.map_url, keep_scans_bytes=10_000_000) as robot:
        first, _ = map_commit(robot, 1), map_commit(robot, 2)
        robot.amend(first, T_map_observed=np.eye(4))
        robot.observe(scan_of(3))
        taken = robot.retract(first, note="the head hung loose")
        assert not taken.cells
        assert robot.map == evidence_of(2)
        with pytest.raises(ConflictError, match=f"{first} was taken back before, by {taken.id}"):
            robot.retract(first)
        with pytest.raises(BadInputError, match="an operator can retract it"):
            robot.retract("wren.0123456789abcdef.0")
        robot.commit()
        robot.sync(until_folded=True)
        assert robot.map == evidence_of(2, 3)
    with robot_in(tmp_path, server.map_url, name="wren") as wren:
        wren.sync()
        assert wren.map == evidence_of(2, 3)
