"""A sweep of a spinning lidar is a range image like any other: inside a round tower, its wall is what is hit."""

import numpy as np
import numpy.typing as npt
import pytest

from cairn_calib.rig.camera import camera_from_field_of_view
from cairn_calib.rig.fisheye import FisheyeCamera
from cairn_calib.rig.lidar import SpinningLidar
from cairn_calib.rig.poses import look_at
from cairn_calib.rig.rig import Rig, Spectrum, mount_camera
from cairn_fusion.mapping.integrate import Integrator
from cairn_fusion.mapping.measurement import Measurement
from cairn_fusion.recording.recording_format import (
    Convention,
    RangeEncoding,
    RecordingHeader,
    check_cameras,
    decode_range,
    encode_range,
)
from cairn_fusion.recording.scan import Scan
from cairn_fusion.transfer.transfer import points_from_range
from cairn_map.errors import BadInputError
from cairn_map.evidence.channels import COLOUR
from cairn_map.evidence.grid import Geometry, centres_of_voxels, voxels_in_cell

RADIUS_M = 2.0
EDGE_M = 0.05
GEOMETRY = Geometry(voxel_edge_um=50_000, depth=5, channels=(COLOUR,))
LIDAR = SpinningLidar(width=360, height=8, elevations_deg=(20, 12, 6, 3, 0, -4, -10, -25))
EYE = (0.31, -0.42, 1.13)
HOME = look_at(EYE, (1.31, -0.42, 1.13))  # forward is the map's x
RIG = Rig(
    name="mast",
    cameras={
        "lidar": mount_camera(Spectrum.RANGE, LIDAR, np.eye(4)),
        "front": mount_camera(Spectrum.COLOUR, camera_from_field_of_view(64, 48, horizontal_deg=60), np.eye(4)),
    },
)

Floats = npt.NDArray[np.float64]


def tower() -> npt.NDArray[np.float32]:
    """The range image of a round wall about the lidar."""
    across = np.cos(np.radians(LIDAR.elevations_deg))
    return np.repeat(RADIUS_M / across[:, None], LIDAR.width, axis=1).astype(np.float32)


@pytest.fixture(scope="module")
def seen() -> tuple[Floats, npt.NDArray[np.int32], npt.NDArray[np.bool_]]:
    """Voxels that a measurement of the tower saw: (N, 3) centres from the lidar in metres, (N, 2) hits and
    misses, (N,) with a colour."""
    measurement = Measurement(RIG, GEOMETRY, Integrator(min_range_m=0.1, max_range_m=5))
    colour = np.full((48, 64, 3), 200, np.uint8)
    measurement.add(Scan(time_s=0.0, T_map_rig=HOME, range_camera="lidar", range_m=tower(), colour={"front": colour}))
    centres, counts, coloured = [], [], []
    for key, evidence in measurement.diff().items():
        centres.append(centres_of_voxels(voxels_in_cell(evidence.voxels, key, GEOMETRY), GEOMETRY) - EYE)
        counts.append(evidence.counts)
        coloured.append(np.isin(np.arange(len(evidence.voxels)), evidence.sampled))
    return np.concatenate(centres), np.concatenate(counts), np.concatenate(coloured)


def test_points_of_a_sweep_lie_on_the_wall() -> None:
    points = points_from_range(tower(), LIDAR)
    np.testing.assert_allclose(np.hypot(points[..., 0], points[..., 2]), RADIUS_M, rtol=1e-6)
    heights_m = RADIUS_M * np.tan(np.radians(LIDAR.elevations_deg))
    np.testing.assert_allclose(points[..., 1], -np.repeat(heights_m[:, None], 360, axis=1), atol=1e-6)


def test_what_is_hit_is_the_wall_all_round_and_what_is_missed_the_room_before_it(
    seen: tuple[Floats, npt.NDArray[np.int32], npt.NDArray[np.bool_]],
) -> None:
    centres, counts, _ = seen
    hit = counts[:, 0] > 0
    from_axis_m = np.hypot(centres[:, 0], centres[:, 1])
    half_diagonal_m = EDGE_M * np.sqrt(0.5)
    assert np.abs(from_axis_m[hit] - RADIUS_M).max() <= half_diagonal_m + 1e-6
    assert (from_axis_m[~hit] < RADIUS_M + half_diagonal_m).all()
    degrees = np.degrees(np.arctan2(centres[hit, 1], centres[hit, 0]))
    assert np.diff(np.sort(degrees)).max() < np.degrees(2 * EDGE_M / RADIUS_M)
    assert hit.sum() > 8 * 2 * np.pi * RADIUS_M / EDGE_M * 0.8  # a ring of voxels per beam


def test_another_camera_colours_the_part_of_the_wall_that_it_sees(
    seen: tuple[Floats, npt.NDArray[np.int32], npt.NDArray[np.bool_]],
) -> None:
    centres, counts, coloured = seen
    degrees = np.abs(np.degrees(np.arctan2(centres[:, 1], centres[:, 0])))
    assert degrees[coloured].max() < 32
    level = (counts[:, 0] > 0) & (degrees < 28) & (np.abs(centres[:, 2]) < 0.7)
    assert coloured[level].all()


def test_a_sweep_is_recorded_as_other_range_images_are() -> None:
    encoding = RangeEncoding()
    again = decode_range(encode_range(tower(), LIDAR, encoding), LIDAR, encoding)
    np.testing.assert_allclose(again, tower(), atol=0.00051)


def test_depth_along_an_axis_that_a_lidar_does_not_have_is_refused() -> None:
    fisheye = FisheyeCamera(width=8, height=6, focal_px=(3.0, 3.0), centre_px=(3.5, 2.5))
    rig = Rig(name="wide", cameras={"tof": mount_camera(Spectrum.RANGE, fisheye, np.eye(4))})
    header = RecordingHeader(name="wide", range={"tof": RangeEncoding(convention=Convention.Z)})
    with pytest.raises(BadInputError, match="must be along the beam"):
        check_cameras(header, rig)
    header = RecordingHeader(name="sweep", range={"lidar": RangeEncoding(convention=Convention.Z)})
    with pytest.raises(BadInputError, match="must be along the beam"):
        check_cameras(header, RIG)
    check_cameras(RecordingHeader(name="sweep", range={"lidar": RangeEncoding()}), RIG)
