"""Layers by place: scans go into the layers of the boxes around the head, else into those of all other places."""

import numpy as np
import pytest

from cairn_client.robot.layer_places import LayerPlaces
from cairn_map.errors import BadInputError

SHED = ((-2.0, -1.0, 0.0), (0.0, 1.0, 2.0))
DOOR = ((-0.4, -0.5, 0.0), (0.0, 0.5, 2.0))
PLACES = LayerPlaces(boxes={"evidence": [SHED], "ground": [DOOR]}, elsewhere=("ground",))


def at(x: float, y: float, z: float) -> np.ndarray:
    """Pose of a head there, turned about z."""
    T = np.eye(4)
    T[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    T[:3, 3] = x, y, z
    return T


@pytest.mark.parametrize(
    ("place", "layers"),
    [
        ((-1.0, 0.0, 1.0), ("evidence",)),
        ((-0.2, 0.0, 1.0), ("evidence", "ground")),
        ((0.5, 0.0, 1.0), ("ground",)),
        ((-1.0, 0.0, 2.5), ("ground",)),
        ((-2.0, -1.0, 0.0), ("evidence",)),
        ((np.nan, 0.0, 0.0), ("ground",)),
    ],
)
def test_a_scan_goes_into_the_layers_of_the_place_of_its_head(
    place: tuple[float, float, float], layers: tuple[str, ...]
) -> None:
    assert PLACES.layers_at(at(*place)) == layers


def test_a_robot_contributes_to_all_layers_of_its_places() -> None:
    assert PLACES.layers == ("evidence", "ground")
    assert LayerPlaces(boxes={}, elsewhere=()).layers_at(np.eye(4)) == ()


@pytest.mark.parametrize(
    "box", [((0, 0, 0), (1, 1, 0)), ((0, 0, 0), (1, 1, np.nan)), ((2, 0, 0), (1, 1, 1)), ((0, 0, 0), (np.inf, 1, 1))]
)
def test_a_box_that_is_none_is_refused(box: tuple[tuple[float, float, float], tuple[float, float, float]]) -> None:
    with pytest.raises(BadInputError) as caught:
        LayerPlaces(boxes={"evidence": [SHED, box]}, elsewhere=("ground",))
    assert caught.value.kind == "bad_box"


def test_a_text_in_the_place_of_names_is_refused() -> None:
    with pytest.raises(BadInputError) as caught:
        LayerPlaces(boxes={}, elsewhere="ground")  # type: ignore[arg-type]
    assert caught.value.kind == "bad_layer"
