"""Other conventions become a scan's, and no pixel without a measurement becomes one with."""

import numpy as np
import pytest

from cairn_calib.rig.camera import Camera
from cairn_fusion.recording.recording_format import kelvin_from_counts, range_from_radial, range_from_z_depth
from cairn_fusion.transfer.transfer import points_from_range
from cairn_map.errors import BadInputError

CAMERA = Camera(width=8, height=6, focal_px=(5.0, 6.0), centre_px=(3.4, 2.6), distortion=(0.1, -0.02, 0.01, 0.0, 0.0))


def test_a_z_depth_becomes_the_range_whose_point_has_that_depth() -> None:
    depth = np.random.default_rng(0).integers(300, 5000, (6, 8)).astype(np.uint16)
    points = points_from_range(range_from_z_depth(depth, CAMERA, units_per_m=1000), CAMERA)
    np.testing.assert_allclose(points[..., 2], depth / 1000, rtol=1e-6)


def test_a_radial_distance_is_the_range() -> None:
    radial = np.full((6, 8), 25_000, np.uint16)
    assert (range_from_radial(radial, CAMERA, units_per_m=10_000) == np.float32(2.5)).all()


@pytest.mark.parametrize("nothing", [0.0, np.nan, np.inf, -1.0])
@pytest.mark.parametrize("convert", [range_from_z_depth, range_from_radial])
def test_no_return_is_nan(convert: object, nothing: float) -> None:
    depth = np.full((6, 8), 1.0, np.float32)
    depth[2, 3] = nothing
    ranges = convert(depth, CAMERA, units_per_m=1)  # type: ignore[operator]
    assert ranges.dtype == np.float32
    assert np.argwhere(np.isnan(ranges)).tolist() == [[2, 3]]


@pytest.mark.parametrize("units_per_m", [0.0, -1.0, np.nan])
def test_a_scale_that_is_none_is_refused(units_per_m: float) -> None:
    with pytest.raises(BadInputError):
        range_from_radial(np.zeros((6, 8)), CAMERA, units_per_m=units_per_m)


def test_an_image_of_another_size_is_refused() -> None:
    with pytest.raises(BadInputError):
        range_from_z_depth(np.zeros((8, 6)), CAMERA, units_per_m=1000)


def test_counts_become_kelvin_and_zero_no_reading() -> None:
    kelvin = kelvin_from_counts(np.array([[0, 1000]], np.uint16), kelvin_per_count=0.1, kelvin_at_zero=200.0)
    assert np.isnan(kelvin[0, 0])
    assert kelvin[0, 1] == np.float32(300)
