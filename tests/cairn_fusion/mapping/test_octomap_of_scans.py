"""Maps of scans as OctoMap files: OctoMap's own tools find the occupied and the free voxels of the map, no others."""

import shutil
import subprocess
from pathlib import Path

import pytest
from tests.fixtures.map.octomap_files import Cells, known_states, octomap_file
from tests.naive.octomap import read_tree, states_of

from cairn_calib.rig.poses import look_at
from cairn_fusion.importers import open_source
from cairn_fusion.mapping.measurement import Measurement
from cairn_map.evidence.grid import Geometry, geometry_for
from cairn_map.files.export_request import ExportRequest
from cairn_sim.render.render import render_scan
from cairn_sim.robots.heads import RANGE_CAMERA, full_head
from cairn_sim.scene.scene_file import load_scene

pytestmark = [
    pytest.mark.processes,
    pytest.mark.skipif(shutil.which("convert_octree") is None, reason="needs Debian's octomap-tools"),
]


def check_octomap_finds_the_same(cells: Cells, geometry: Geometry, folder: Path) -> None:
    """Both files, as OctoMap reads them and writes them again."""
    occupied, free = known_states(cells, geometry, ExportRequest())
    assert min(len(occupied), len(free)) > 1000
    for asked in (ExportRequest(format="ot"), ExportRequest(format="bt")):
        (folder / f"map.{asked.format}").write_bytes(octomap_file(cells, geometry, asked)[0])
        subprocess.run(["convert_octree", f"map.{asked.format}", "own.bt"], cwd=folder, capture_output=True, check=True)
        assert states_of(read_tree((folder / "own.bt").read_bytes())) == (occupied, free)


def test_octomap_finds_the_voxels_of_a_simulated_room(tmp_path: Path) -> None:
    scene, head, geometry = load_scene("building"), full_head(scale=0.25), geometry_for(voxel_edge_m=0.08)
    target = scene.solids[scene.number_of("technician/torso")].T_map_solid[:3, 3]
    measurement = Measurement(head, geometry)
    for shift in ([-1.6, 0.3, 0.2], [-1.2, 0.8, 0.4]):
        T_map_rig = look_at(target + shift, target)
        measurement.add(render_scan(scene, head, T_map_rig=T_map_rig, range_camera=RANGE_CAMERA, time_s=0.0))
    check_octomap_finds_the_same(measurement.diff(), geometry, tmp_path)


@pytest.mark.recording
def test_octomap_finds_the_voxels_of_a_real_recording(test_data: Path, tmp_path: Path) -> None:
    source, geometry = open_source(test_data / "apc_shelf_rgbd"), geometry_for(voxel_edge_m=0.02)
    measurement = Measurement(source.rig, geometry)
    for n in (0, 7):
        measurement.add(source.scan(n))
    check_octomap_finds_the_same(measurement.diff(), geometry, tmp_path)
