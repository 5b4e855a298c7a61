"""Gate of scans: a robot at rest votes every two seconds, one that moves with each step or turn."""

import numpy as np
import pytest

from cairn_calib.rig.poses import Transform
from cairn_fusion.mapping.scan_gate import GateBounds, ScanGate
from cairn_map.errors import BadInputError


def pose(x_m: float = 0.0, yaw_deg: float = 0.0) -> Transform:
    c, s = np.cos(np.radians(yaw_deg)), np.sin(np.radians(yaw_deg))
    return np.array([[c, -s, 0, x_m], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])


def taken(gate: ScanGate, places: list[tuple[float, Transform]], camera: str = "tof") -> list[float]:
    return [time_s for time_s, T in places if gate.takes(camera, time_s, T)]


def test_ten_minutes_at_rest_are_at_most_310_scans() -> None:
    gate = ScanGate(GateBounds())
    count = len(taken(gate, [(n / 15, pose()) for n in range(9000)]))
    assert 290 <= count <= 310
    assert gate.kept_out == 9000 - count


def test_a_way_of_five_centimetres_or_a_turn_of_three_degrees_is_a_scan() -> None:
    way = [(n / 100, pose(x_m=0.0101 * n)) for n in range(21)]
    assert np.allclose(taken(ScanGate(GateBounds()), way), [0, 0.05, 0.10, 0.15, 0.20], atol=0.011)
    turn = [(n / 100, pose(yaw_deg=1.01 * n)) for n in range(13)]
    assert np.allclose(taken(ScanGate(GateBounds()), turn), [0, 0.03, 0.06, 0.09, 0.12], atol=0.011)


def test_slow_steps_add_up() -> None:
    creep = [(n / 100, pose(x_m=0.004 * n)) for n in range(100)]
    assert len(taken(ScanGate(GateBounds()), creep)) == pytest.approx(0.4 / 0.05, abs=1)


def test_each_range_camera_has_a_gate_of_its_own() -> None:
    gate = ScanGate(GateBounds())
    assert [gate.takes(camera, 0.0, pose()) for camera in ("front", "rear", "front", "rear")] == [
        True,
        True,
        False,
        False,
    ]


def test_a_clock_that_is_set_back_begins_again() -> None:
    gate = ScanGate(GateBounds())
    assert taken(gate, [(100.0, pose()), (50.0, pose()), (50.5, pose())]) == [100.0, 50.0]


def test_without_bounds_every_scan_is_taken() -> None:
    gate = ScanGate(None)
    assert len(taken(gate, [(0.0, pose())] * 20)) == 20
    assert gate.kept_out == 0


def test_a_bound_of_zero_takes_every_scan_and_a_negative_one_is_refused() -> None:
    assert len(taken(ScanGate(GateBounds(step_m=0.0)), [(0.0, pose())] * 5)) == 5
    with pytest.raises(BadInputError, match="0 or more"):
        GateBounds(pause_s=-1.0)
