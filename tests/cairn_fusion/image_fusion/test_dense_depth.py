"""Depth for the eye: its kernel's slow twin, what is filled and what is not, and that no map takes it."""

import numpy as np
import numpy.typing as npt
import pytest
from tests.naive import views as naive_views

from cairn_calib.rig.camera import Camera
from cairn_calib.rig.rig import Rig, Spectrum, mount_camera
from cairn_fusion.image_fusion.dense_depth import ALIKE, CLOSE, DenseDepth, Origin, dense_depth
from cairn_fusion.image_fusion.dense_depth_kernels import REACH, densify_into
from cairn_fusion.image_fusion.surface import drawn_surface, surface_of
from cairn_fusion.recording.scan import Scan
from cairn_fusion.transfer.transfer import Label
from cairn_map.errors import BadInputError

TOF = Camera(width=44, height=36, focal_px=(40.0, 40.0), centre_px=(21.5, 17.5))
COLOUR = Camera(width=220, height=180, focal_px=(200.0, 200.0), centre_px=(109.5, 89.5))
HEAD = Rig(
    name="head",
    cameras={
        "tof": mount_camera(Spectrum.RANGE, TOF, np.eye(4)),
        "colour": mount_camera(Spectrum.COLOUR, COLOUR, np.eye(4)),
    },
)


def two_walls() -> tuple[npt.NDArray[np.float32], npt.NDArray[np.uint8]]:
    """Range of 1 m before 3 m along a slanted edge, and its picture: two greys, with noise."""
    rng = np.random.default_rng(0)

    def left(camera: Camera) -> npt.NDArray[np.bool_]:
        rays = camera.rays()
        return np.asarray(rays[..., 0] / rays[..., 2] < 0.1 + 0.2 * rays[..., 1] / rays[..., 2])

    z_m = np.where(left(TOF), 1.0, 3.0)
    picture = np.where(left(COLOUR), 90, 170)[..., None] + rng.integers(-6, 7, (180, 220, 3))
    return (z_m / TOF.rays()[..., 2]).astype(np.float32), picture.astype(np.uint8)


def depth_of(
    range_m: npt.NDArray[np.float32], picture: npt.NDArray[np.uint8], amplitude: npt.NDArray[np.uint16] | None = None
) -> DenseDepth:
    scan = Scan(time_s=0.0, T_map_rig=np.eye(4), range_camera="tof", range_m=range_m, amplitude=amplitude)
    drawn = drawn_surface(surface_of(scan, HEAD), HEAD, "colour")
    return dense_depth(drawn, HEAD, "colour", picture, range_camera="tof")


@pytest.mark.parametrize("seed", range(4))
def test_dense_depth_agrees_with_its_slow_twin(seed: int) -> None:
    rng = np.random.default_rng(seed)
    step, (rows, columns) = 3, (8, 11)
    nearness = rng.choice([0.0, 0.0, 0.5, 0.505, 1.0], size=(rows, columns)).astype(np.float32)
    nearness[:3, :4] = 0.5
    marks = rng.choice([3, 3, 3, 3, 3, 3, 4, 5], size=(rows, columns)).astype(np.uint8)
    picture = rng.integers(0, 256, (23, 32, 3)).astype(np.uint8)
    coarse, trust = rng.integers(0, 256, (rows, columns, 3)).astype(np.uint8), rng.random((rows, columns)) + 0.1
    range_m, origins = np.empty((23, 32), np.float32), np.empty((23, 32), np.uint8)
    arrays = (range_m, origins, picture, nearness, marks, trust.astype(np.float32), coarse, ALIKE, CLOSE)
    for band in ((0, 7), (7, 8), (8, 23)):
        densify_into(*arrays, 2.0, step, *band)
    full = marks == Label.SATURATED
    slow, slow_origins = naive_views.dense(picture, nearness, full, arrays[5], coarse, ALIKE, CLOSE, 2.0, step, REACH)
    np.testing.assert_array_equal(origins, slow_origins)
    np.testing.assert_allclose(range_m, slow, rtol=2e-4)
    assert {0, 1, 2} == set(origins.ravel().tolist())


def test_the_picture_says_on_which_side_of_an_edge_a_pixel_is_and_nothing_is_between() -> None:
    range_m, picture = two_walls()
    depth = depth_of(range_m, picture)
    z_m = depth.shown_m * COLOUR.rays()[..., 2]
    known = depth.origins != Origin.NOTHING
    assert known.mean() > 0.95
    near, far = np.abs(z_m - 1) < 0.05, np.abs(z_m - 3) < 0.15
    assert (near | far)[known].all()
    # The edge is where it is in the picture, not in the range image, whose pixels are five times as wide.
    wrong = known & (near != (picture[..., 0] < 130))
    assert wrong.sum() < 0.002 * wrong.size
    filled = depth.origins == Origin.FILLED
    assert 0.01 < filled.mean() < 0.2 and not filled[20:-20, 20:60].any()


@pytest.mark.parametrize("times", [1, 5])
def test_what_has_nothing_beside_it_ends_a_range_pixel_beyond_its_last_on_all_sides(times: int) -> None:
    lens = COLOUR if times == 5 else TOF
    rig = Rig(name="one", cameras={**HEAD.cameras, "colour": mount_camera(Spectrum.COLOUR, lens, np.eye(4))})
    range_m = np.full((36, 44), np.nan, np.float32)
    range_m[10:20, 12:30] = 2.0
    scan = Scan(time_s=0.0, T_map_rig=np.eye(4), range_camera="tof", range_m=range_m)
    drawn = drawn_surface(surface_of(scan, rig), rig, "colour")
    picture = np.zeros((lens.height, lens.width, 3), np.uint8)
    known = dense_depth(drawn, rig, "colour", picture, range_camera="tof").origins != Origin.NOTHING
    y, x = (np.flatnonzero(known.any(axis=axis)) for axis in (1, 0))
    ends = np.array([[x[0] - lens.centre_px[0], x[-1] - lens.centre_px[0]], [y[0] - lens.centre_px[1], y[-1]]])
    ends[1, 1] -= lens.centre_px[1]
    # In range pixels; drawn ones are half as wide, and the surface's border is drawn to the last that it reaches.
    last = np.array([[12, 29], [10, 19]]) - np.array(TOF.centre_px)[:, None]
    beyond = (ends / times - last) * [-1, 1]
    assert (beyond <= 1.0 + 1e-9).all() and (beyond > 0.4).all()
    np.testing.assert_allclose(beyond[:, 0], beyond[:, 1], atol=0.5 / times + 1e-9)
    measured = np.zeros_like(known)
    measured[y[0] + times : y[-1] + 1 - times, x[0] + times : x[-1] + 1 - times] = True
    assert known[measured].all()


def test_where_too_much_light_returned_or_nothing_near_did_nothing_is_filled() -> None:
    range_m, picture = two_walls()
    amplitude = np.full(range_m.shape, 1000, np.uint16)
    amplitude[10:13, 5:8], range_m[10:13, 5:8] = 65535, np.nan
    range_m[20:32, 3:14] = np.nan
    depth = depth_of(range_m, picture, amplitude)
    x, y = (np.array([6, 11]) - 21.5) * 5 + 109.5
    assert depth.origins[round(y), round(x)] == Origin.NOTHING
    assert depth.origins[round((26 - 17.5) * 5 + 89.5), round((8 - 21.5) * 5 + 109.5)] == Origin.NOTHING
    assert np.isnan(depth.shown_m[depth.origins == Origin.NOTHING]).all()


def test_a_map_cannot_take_depth_that_was_filled_in() -> None:
    depth = depth_of(*two_walls())
    with pytest.raises(BadInputError, match="DenseDepth"):
        Scan(time_s=0.0, T_map_rig=np.eye(4), range_camera="tof", range_m=depth)  # type: ignore[arg-type]
    with pytest.raises(BadInputError, match="partly guessed"):
        np.asarray(depth)
