"""Straightening of bent images: of lattices that a lens bends, and of none that it does not."""

import numpy as np
import numpy.typing as npt
import pytest

from cairn_calib.board.discs.straightening import Straightening, bent_view, straightening_of
from cairn_calib.board.homography import map_points
from cairn_calib.rig.fisheye import FisheyeCamera

Floats = npt.NDArray[np.float64]
SHAPE = (512, 640)
LATTICE = np.stack(np.meshgrid(np.arange(4.0), np.arange(3.0)), axis=-1).reshape(-1, 2)


def near_lattice() -> Floats:
    """(12, 2) pixels of a board that fills the image of a lens of 150 degrees."""
    f = 320 / np.radians(75)
    lens = FisheyeCamera(width=640, height=512, focal_px=(f, f), centre_px=(319.5, 255.5))
    points = np.column_stack([LATTICE - [1.5, 1.0], np.full(12, 0.8)])
    points[:, 2] += 0.15 * points[:, 0]
    return lens.project(points)


def test_places_on_the_board_are_nearly_its_lattice_and_move_as_their_derivatives_say() -> None:
    pixels = near_lattice()
    view = bent_view(LATTICE, pixels, SHAPE)
    assert np.abs(view.places(pixels) - LATTICE).max() < 0.1
    step = 1e-4 * np.random.default_rng(1).normal(size=pixels.shape)
    difference = view.places(pixels + step) - view.places(pixels - step)
    assert difference == pytest.approx((2 * view.jacobian(pixels) @ step[..., None])[..., 0], abs=1e-9)


def test_derivatives_agree_with_differences() -> None:
    straightening = Straightening(np.array([320.0, 250.0]), 400.0, -0.8)
    rng = np.random.default_rng(1)
    pixels, step = rng.uniform([100, 60], [540, 440], (50, 2)), 1e-4 * rng.normal(size=(50, 2))
    difference = straightening.straight(pixels + step) - straightening.straight(pixels - step)
    predicted = 2 * straightening.jacobian(pixels) @ step[..., None]
    assert difference == pytest.approx(predicted[..., 0], abs=1e-9)


def test_a_lattice_that_no_lens_bends_stays_as_it_is() -> None:
    homography = np.array([[90.0, 8.0, 150.0], [-5.0, 80.0, 120.0], [0.02, 0.05, 1.0]])
    pixels = map_points(homography, LATTICE)
    straightening = straightening_of(LATTICE, pixels, SHAPE)
    assert straightening.bend == 0.0
    assert straightening.straight(pixels) == pytest.approx(pixels)
    assert straightening.jacobian(pixels) == pytest.approx(np.tile(np.eye(2), (12, 1, 1)))


def test_a_lattice_behind_a_lens_of_150_degrees_becomes_one_that_a_homography_makes() -> None:
    pixels = near_lattice()
    straightening = straightening_of(LATTICE, pixels, SHAPE)
    assert straightening.bend < -0.5
    # Lines stay lines: the middle of a row is on the line through its ends.
    for image, least, most in ((pixels, 10.0, 200.0), (straightening.straight(pixels), 0.0, 4.0)):
        first, middle, last = image[0], image[1], image[3]
        along = (last - first) / np.linalg.norm(last - first)
        off = middle - first
        assert least <= abs(along[0] * off[1] - along[1] * off[0]) < most
