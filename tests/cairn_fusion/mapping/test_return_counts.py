"""Count of pixels by what became of them, and reach by the kind of the sensor."""

import numpy as np
import numpy.typing as npt
from hypothesis import given, settings
from hypothesis import strategies as st

from cairn_calib.rig.body import Body, BodyBox
from cairn_calib.rig.camera import Camera
from cairn_calib.rig.lidar import SpinningLidar
from cairn_calib.rig.rig import RangeSensing, Rig, Spectrum, mount_camera
from cairn_fusion.mapping.beam_returns import ReturnCounts, returns_of
from cairn_fusion.mapping.integrate import Integrator
from cairn_fusion.mapping.measurement import Measurement
from cairn_fusion.recording.scan import Scan
from cairn_map.evidence.grid import geometry_for

CAMERA = Camera(width=12, height=9, focal_px=(9.0, 9.0), centre_px=(5.5, 4.0))
LIDAR = SpinningLidar(width=12, height=9, elevations_deg=tuple(float(e) for e in range(4, -5, -1)))
BODY = Body(frame="base", boxes=(BodyBox(name="arm", low_m=(-0.5, -0.5, 0.4), high_m=(0.5, 0.5, 0.6)),))


def rig_of(camera: Camera | SpinningLidar, *, body: Body | None = None) -> Rig:
    """A rig with one range camera."""
    mounted = mount_camera(Spectrum.RANGE, camera, np.eye(4))
    mounted = mounted.model_copy(update={"sensing": RangeSensing(saturated_amplitude=1000)})
    return Rig(name="head", cameras={"tof": mounted}, body=body)


def scan_of(range_m: npt.NDArray[np.float32], amplitude: npt.NDArray[np.uint16] | None = None) -> Scan:
    """A scan at the map's origin."""
    return Scan(time_s=0.0, T_map_rig=np.eye(4), range_camera="tof", range_m=range_m, amplitude=amplitude)


@settings(max_examples=60, deadline=None, database=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([CAMERA, LIDAR]))
def test_every_pixel_is_counted_once_and_those_used_are_the_returns(seed: int, camera: Camera | SpinningLidar) -> None:
    rng = np.random.default_rng(seed)
    range_m = rng.choice(np.array([np.nan, np.inf, 0.0, 0.05, 0.5, 3.0, 3.01, 9.0, 20.0], np.float32), (9, 12))
    scan = scan_of(range_m, rng.integers(0, 1100, (9, 12)).astype(np.uint16))
    returns = returns_of(scan, rig_of(camera, body=BODY), min_range_m=0.1, max_range_m=10.0, flying_step_m=0.05)
    assert returns.counts.pixels == range_m.size
    assert returns.counts.used == len(returns.pixels) == np.isfinite(returns.range_m).sum()
    assert returns.counts + ReturnCounts() == returns.counts


def test_each_cause_is_told_apart() -> None:
    range_m = np.full((9, 12), 5.0, np.float32)
    range_m[0, :2] = np.nan
    range_m[1, :3] = 0.05
    range_m[2, :4] = 11.0
    range_m[4:, 8] = 6.0  # a pixel between a near and a far surface
    range_m[4:, 9:] = 7.0
    amplitude = np.zeros((9, 12), np.uint16)
    amplitude[3, :5] = 1000
    measurement = Measurement(rig_of(CAMERA), geometry_for(voxel_edge_m=0.1))
    measurement.add(scan_of(range_m, amplitude))
    measurement.add(scan_of(range_m, amplitude))
    counts = measurement.counts
    assert (counts.no_return, counts.too_near, counts.too_far, counts.saturated) == (4, 6, 8, 10)
    assert counts.flying > 0
    assert counts.used == 2 * 108 - 4 - 6 - 8 - 10 - counts.flying


def test_a_lidar_reaches_farther_than_a_camera_unless_a_limit_is_given() -> None:
    far = scan_of(np.full((9, 12), 60.0, np.float32))
    geometry = geometry_for(voxel_edge_m=0.5)
    for camera, integrator, used in (
        (LIDAR, Integrator(), 108),
        (CAMERA, Integrator(), 0),
        (CAMERA, Integrator(max_range_m=70), 108),
        (LIDAR, Integrator(max_range_m=50), 0),
    ):
        measurement = Measurement(rig_of(camera), geometry, integrator)
        measurement.add(far)
        assert (measurement.counts.used, measurement.counts.too_far) == (used, 108 - used)
        assert bool(measurement.diff()) == (used > 0)
