"""The small room says what is where."""

import numpy as np

from cairn_sim.room import small_room


def name_at(x: float, y: float, z: float) -> str | None:
    room = small_room()
    k = int(room.solid_at(np.array([x, y, z])))
    return room.solids[k].name if k >= 0 else None


def test_solid_at_names_what_stands_there() -> None:
    assert name_at(3, 2, -0.1) == "floor"
    assert name_at(3, 2, 2.7) == "ceiling"
    assert name_at(0.1, 2, 0.5) == "radiator"
    assert name_at(2.9, 1.1, 1.2) == "torso"
    assert name_at(1.8, 3.1, 1.0) == "pillar"
    assert name_at(5.5, 0.5, 1.2) == "cold tank dome"


def test_doorway_and_the_middle_of_the_room_are_free() -> None:
    assert name_at(4.05, 2.45, 1.0) is None
    assert name_at(4.05, 1.0, 1.0) == "partition south"
    assert name_at(2.5, 2.5, 1.3) is None
    assert name_at(float("nan"), 0, 0) is None


def test_distance_is_metres_to_the_nearest_surface() -> None:
    room = small_room()
    np.testing.assert_allclose(room.distance_m(np.array([2.9, 2.45, 1.1])), 1.1, atol=1e-12)
    np.testing.assert_allclose(room.distance_m(np.array([3.0, 2.0, -0.05])), -0.05, atol=1e-12)
    assert np.isnan(room.distance_m(np.array([np.nan, 0, 0])))
    assert room.distance_m(np.zeros((2, 5, 3))).shape == (2, 5)


def test_solids_have_names_of_their_own_and_rows_in_every_array() -> None:
    room = small_room()
    names = [s.name for s in room.solids]
    assert len(set(names)) == len(names)
    assert len(room.boxes) + len(room.cylinders) + len(room.spheres) == len(names)
    assert len(room.colours_srgb) == len(room.temperature_k) == len(room.reflectivity_nir) == len(names)


def test_room_is_closed() -> None:
    """Points just outside the interior are solid, all around."""
    x, y, z = np.meshgrid(np.linspace(-0.05, 6.05, 62), np.linspace(-0.05, 5.05, 52), np.linspace(-0.05, 2.65, 28))
    points = np.stack([x, y, z], axis=-1)
    outside = (x < 0) | (x > 6) | (y < 0) | (y > 5) | (z < 0) | (z > 2.6)
    assert (small_room().solid_at(points)[outside] >= 0).all()
