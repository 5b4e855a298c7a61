"""The lidar's cylinder: a lens like any other, so everything that takes a camera takes it."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from cairn_calib.rig.lidar import SpinningLidar
from cairn_map.errors import BadInputError

law = settings(max_examples=50, deadline=None, database=None)
UNEVEN = SpinningLidar(width=36, height=4, elevations_deg=(10, 4, 0, -20))


def lidar_of(width: int, elevations_deg: list[float]) -> SpinningLidar:
    return SpinningLidar(width=width, height=len(elevations_deg), elevations_deg=tuple(elevations_deg))


lidars = st.builds(
    lidar_of,
    st.integers(1, 2048),
    st.lists(st.integers(-890, 890), min_size=1, max_size=128, unique=True).map(
        lambda tenths: [tenth / 10 for tenth in sorted(tenths, reverse=True)]
    ),
)


@law
@given(lidars)
def test_project_undoes_unproject_at_every_pixel(lidar: SpinningLidar) -> None:
    x, y = np.meshgrid(np.arange(lidar.width), np.arange(lidar.height))
    np.testing.assert_allclose(np.linalg.norm(lidar.rays(), axis=-1), 1, rtol=1e-12)
    np.testing.assert_allclose(lidar.project(lidar.rays() * 3.7), np.stack([x, y], axis=-1), rtol=0, atol=1e-9)


@law
@given(lidars, st.floats(-0.5, 0.499), st.floats(-0.5, 0.499))
def test_project_undoes_unproject_beside_the_middle_of_a_pixel(lidar: SpinningLidar, dx: float, dy: float) -> None:
    centres = np.array([[0, 0], [lidar.width - 1, lidar.height - 1], [lidar.width // 2, lidar.height // 2]])
    pixels = centres + np.array([dx, dy])
    again = lidar.project(lidar.unproject(pixels))
    # The left and the right edge of the image are one direction.
    turned = (again[:, 0] - pixels[:, 0] + lidar.width / 2) % lidar.width - lidar.width / 2
    inside = ~np.isnan(again[:, 1])
    np.testing.assert_allclose(turned[inside], 0, atol=1e-9)
    np.testing.assert_allclose(again[inside, 1], pixels[inside, 1], atol=1e-9)
    assert inside.all() or dy < -0.5 + 1e-9  # rounding may lift the top edge out of the image


@pytest.mark.parametrize(
    ("direction", "x"),
    [
        ((0, 0, 1), 17.5),  # forward: the middle
        ((1, 0, 0), 26.5),  # right
        ((-1, 0, 0), 8.5),
        ((0, 0, -1), -0.5),  # back: the left edge, where the turn begins
        ((-1e-20, 0, -1), -0.5),
        ((-0.0, 0, -1), -0.5),
    ],
)
def test_columns_go_round_clockwise_from_straight_back(direction: tuple[float, ...], x: float) -> None:
    pixel = UNEVEN.project(np.array(direction, dtype=np.float64) * 5)
    np.testing.assert_allclose(pixel, [x, 2], atol=1e-12)
    assert UNEVEN.contains(pixel)


@law
@given(st.floats(-np.pi, np.pi), st.integers(1, 16384))
def test_every_azimuth_is_in_the_image(azimuth_rad: float, width: int) -> None:
    lidar = lidar_of(width, [1.0, 0.0])
    pixel = lidar.project(np.array([np.sin(azimuth_rad), 0.0, np.cos(azimuth_rad)]))
    assert lidar.contains(pixel)
    assert 0 <= np.rint(pixel[0]) < width


def at_elevation(elevation_deg: float) -> np.ndarray:  # type: ignore[type-arg]
    angle = np.radians(elevation_deg)
    return np.array([0.0, -np.sin(angle), np.cos(angle)])


@pytest.mark.parametrize(
    ("elevation_deg", "y"),
    [(10, 0), (7, 0.5), (4, 1), (1, 1.75), (-10, 2.5), (12.9, -0.5 + 0.1 / 6), (-29.9, 3.5 - 0.1 / 20)],
)
def test_rows_lie_between_the_beams_as_elevations_do(elevation_deg: float, y: float) -> None:
    assert UNEVEN.project(at_elevation(elevation_deg))[1] == pytest.approx(y, abs=1e-9)


@pytest.mark.parametrize("elevation_deg", [13.1, -30.1, 90, -90])
def test_what_is_more_than_half_a_row_outside_has_no_pixel(elevation_deg: float) -> None:
    assert np.isnan(UNEVEN.project(at_elevation(elevation_deg))).all()


def test_a_row_outside_has_no_ray_and_a_column_outside_goes_on_round() -> None:
    assert np.isnan(UNEVEN.unproject(np.array([[0, -0.6], [0, 3.6]]))).all()
    np.testing.assert_allclose(UNEVEN.unproject(np.array([37.0, 2])), UNEVEN.unproject(np.array([1.0, 2])), atol=1e-12)


def test_a_single_beam_is_a_row_of_one_degree() -> None:
    lidar = lidar_of(8, [5.0])
    elevations = np.array([at_elevation(e) for e in (4.4, 4.6, 5, 5.4, 5.6)])
    np.testing.assert_allclose(lidar.project(elevations)[:, 1], [np.nan, 0.4, 0, -0.4, np.nan], atol=1e-9)
    assert lidar.focal_px == pytest.approx((8 / (2 * np.pi), np.degrees(1)))


def test_rows_end_straight_up_and_down() -> None:
    lidar = lidar_of(8, [89.0, 0.0, -89.0])
    np.testing.assert_allclose(lidar.unproject(np.array([[3.0, -0.5], [3, 2.5]]))[:, 1], [-1, 1])


@pytest.mark.parametrize("point", [(0, 0, 0), (np.nan, 0, 1), (0, np.nan, 1), (0, 0, np.nan)])
def test_what_has_no_direction_has_no_pixel(point: tuple[float, ...]) -> None:
    assert np.isnan(UNEVEN.project(np.array(point))).all()


@pytest.mark.parametrize("pixel", [(np.nan, 1), (1, np.nan)])
def test_a_pixel_that_is_none_has_no_ray(pixel: tuple[float, float]) -> None:
    assert np.isnan(UNEVEN.unproject(np.array(pixel))).all()


def test_focal_lengths_are_pixels_per_radian() -> None:
    lidar = lidar_of(360, [2.0, 1.0, 0.0])
    assert lidar.focal_px == pytest.approx((np.degrees(1), np.degrees(1)))


def test_rays_are_computed_once_and_cannot_be_changed() -> None:
    same = UNEVEN.model_copy()
    assert (same, hash(same)) == (UNEVEN, hash(UNEVEN))
    assert same.rays() is UNEVEN.rays()
    with pytest.raises(ValueError, match="read-only"):
        UNEVEN.rays()[0, 0] = 0


def test_an_image_of_another_size_is_refused() -> None:
    UNEVEN.check_image(np.zeros((4, 36)), name="sweep")
    with pytest.raises(BadInputError, match="36 x 4"):
        UNEVEN.check_image(np.zeros((36, 4)), name="sweep")


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        ({"width": 0}, "width"),
        ({"height": 5}, "one per row: 5, got 4"),
        ({"elevations_deg": (10, 4, 4, -20)}, "fall"),
        ({"elevations_deg": (-20, 0, 4, 10)}, "fall"),
        ({"elevations_deg": (90, 4, 0, -20)}, "elevations_deg"),
        ({"elevations_deg": (10, 4, np.nan, -20)}, "elevations_deg"),
        ({"elevations_deg": ()}, "elevations_deg"),
        ({"model": "rolling"}, "model"),
        ({"focal_px": (1, 1)}, "focal_px"),
    ],
)
def test_a_lidar_that_cannot_be_is_refused(wrong: dict[str, object], named: str) -> None:
    with pytest.raises(ValidationError, match=named):
        SpinningLidar.model_validate(UNEVEN.model_dump() | wrong)
