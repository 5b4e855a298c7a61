"""Far sweeps and open air go from a robot over a server to another robot and out as points: no bound refuses them.

Each byte of theirs pays for what it stands for, so nothing of the allowances of small commits is needed here; a sweep
that is larger than these takes half a minute (docs/decisions/019-commits-by-their-price.md has figures).
"""

from pathlib import Path

import httpx
import numpy as np
import pytest
from tests.fixtures.client.live_server import LiveServer, wait_until

from cairn_calib.rig.camera import Camera, camera_from_field_of_view
from cairn_calib.rig.lidar import SpinningLidar
from cairn_calib.rig.poses import look_at
from cairn_calib.rig.rig import Rig, Spectrum, mount_camera
from cairn_client.http.api import MapApi
from cairn_client.robot.robot import Robot
from cairn_fusion.mapping.integrate import Integrator
from cairn_fusion.recording.scan import Scan
from cairn_map.commits import commit
from cairn_map.evidence.grid import Geometry
from cairn_map.wire.messages import CreateMap

STREET = Geometry(voxel_edge_um=100_000, depth=6, channels=())
SKY = Geometry(voxel_edge_um=20_000, depth=6, channels=())
SPINNING = SpinningLidar(width=128, height=64, elevations_deg=tuple(np.linspace(15, -25, 64).tolist()))
WIDE = camera_from_field_of_view(320, 240, horizontal_deg=60)


def sweep_m(reach_m: float) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
    """Ranges over flat ground 1.5 m below, walls all round at `reach_m`."""
    slopes = np.radians(SPINNING.elevations_deg)
    ground_m = np.where(slopes < 0, 1.5 / np.maximum(np.sin(-slopes), 1e-9), np.inf)
    ranges_m = np.minimum(reach_m / np.cos(slopes), ground_m)
    return np.repeat(ranges_m[:, None], SPINNING.width, axis=1).astype(np.float32)


@pytest.mark.parametrize(
    ("geometry", "camera", "range_m"),
    [
        pytest.param(STREET, SPINNING, sweep_m(40), id="lidar"),
        pytest.param(SKY, WIDE, np.full((240, 320), 3.5, np.float32), id="open air at 2 cm"),
    ],
)
def test_what_an_honest_scan_stands_for_is_paid_by_its_bytes(
    geometry: Geometry,
    camera: Camera | SpinningLidar,
    range_m: np.ndarray[tuple[int, ...], np.dtype[np.float32]],
    server: LiveServer,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(commit, "BRICKS_ALLOWANCE", 0)
    monkeypatch.setattr(commit, "EVIDENCE_ALLOWANCE_BYTES", 0)
    mast = Rig(name="mast", cameras={"tof": mount_camera(Spectrum.RANGE, camera, np.eye(4))})
    scan = Scan(time_s=0.0, T_map_rig=look_at((0, 0, 1.5), (1, 0, 1.5)), range_camera="tof", range_m=range_m)
    with MapApi(server.url) as api:
        api.create_map("far", CreateMap(geometry=geometry))
    url = f"{server.url}/maps/far"
    with (
        Robot(
            mast,
            url,
            directory=tmp_path / "mole",
            name="mole",
            integrator=Integrator(max_range_m=50),
            geometry=geometry,
        ) as mole,
        Robot(None, url, directory=tmp_path / "wren", name="wren") as wren,
    ):
        mole.observe(scan)
        assert mole.commit() is not None
        mole.sync()
        wait_until(lambda: not any(backlog.commits for backlog in server.service.store.health.backlogs()))
        wren.sync()
        assert list(wren.map) == list(mole.map)
        assert all(wren.map.evidence(key) == mole.map.evidence(key) for key in wren.map)
        assert wren.map.size_bytes <= 200 * wren.traffic.down_bytes
        points = httpx.get(f"{url}/main/export", params={"p": 0.5}, timeout=60)
        assert points.status_code == 200
        assert int(points.headers["Cairn-Points"]) > 100
