"""The example of a door: scans of a pipe become the map that a robot makes of them."""

import io
import runpy
from pathlib import Path

import numpy as np
from tests.fixtures.client.robot_program import RIG, scan_of
from tests.fixtures.sources import ROOT

from cairn_client.robot.robot import Robot
from cairn_fusion.recording.scan import Scan
from cairn_map.evidence.grid import geometry_for

NOWHERE = "http://127.0.0.1:9/maps/lab"


def piped(scans: list[Scan], camera: str) -> bytes:
    """Scans as the driver of the example writes them, one of another camera's size among them."""
    parts = []
    for n, scan in enumerate(scans):
        file = io.BytesIO()
        range_m = scan.range_m if n != 1 else np.ones((2, 2), np.float32)
        np.savez(file, time_s=scan.time_s, T_map_rig=scan.T_map_rig, range_m=range_m)
        parts += [len(file.getvalue()).to_bytes(4, "little"), file.getvalue()]
    return b"".join(parts)


def test_scans_of_a_pipe_are_mapped_and_those_that_do_not_fit_are_left_out(tmp_path: Path) -> None:
    door = runpy.run_path(str(ROOT / "docs" / "examples" / "own_door.py"))
    scans = [scan_of(seed) for seed in range(4)]
    (tmp_path / "rig.json").write_bytes(RIG.to_json())
    camera = scans[0].range_camera
    stream = io.BytesIO(piped(scans, camera))
    folder = tmp_path / "door"
    assert door["map_all"](stream, str(tmp_path / "rig.json"), camera, NOWHERE, str(folder)) == 3
    grid = geometry_for(voxel_edge_m=0.05)
    with (
        Robot(RIG, NOWHERE, directory=tmp_path / "other", name="other", geometry=grid) as other,
        Robot(None, NOWHERE, directory=folder, name="walle", stay=True) as found,
    ):
        for n in (0, 2, 3):
            bare = Scan(
                time_s=scans[n].time_s, T_map_rig=scans[n].T_map_rig, range_camera=camera, range_m=scans[n].range_m
            )
            other.observe(bare)
        other.commit()
        assert found.map.digest() == other.map.digest()
