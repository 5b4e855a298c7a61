"""The robot's own body: which points are on it, and which beams it stops."""

import json

import numpy as np
import pytest

from cairn_calib.rig.body import Body, BodyBox
from cairn_calib.rig.camera import camera_from_field_of_view
from cairn_calib.rig.rig import Rig, Spectrum, mount_camera, rig_from_json
from cairn_map.errors import BadInputError

BODY = Body(
    frame="robot",
    boxes=(
        BodyBox(name="hull", low_m=(-0.4, -0.3, -0.2), high_m=(0.4, 0.3, 0.1)),
        BodyBox(name="mast", low_m=(-0.05, -0.05, 0.1), high_m=(0.05, 0.05, 0.9)),
    ),
)
RIG = Rig(
    name="head",
    cameras={"tof": mount_camera(Spectrum.RANGE, camera_from_field_of_view(4, 3, horizontal_deg=60), np.eye(4))},
    body=BODY,
)


def test_a_point_is_on_the_body_in_a_box_or_on_its_face() -> None:
    points = np.array([[0.4, 0.3, 0.1], [0.401, 0, 0], [0, 0, 0.5], [0.06, 0, 0.5], [np.nan, 0, 0]])
    assert BODY.holds(points).tolist() == [True, False, True, False, False]


@pytest.mark.parametrize("seed", range(5))
def test_a_beam_is_stopped_where_points_along_it_are_on_the_body(seed: int) -> None:
    rng = np.random.default_rng(seed)
    origin = rng.uniform(-0.7, 0.7, 3)
    beams = rng.standard_normal((200, 3))
    beams[:20, rng.integers(3)] = 0
    beams /= np.linalg.norm(beams, axis=1, keepdims=True)
    along = np.linspace(0, 1.2, 4001)
    naive = BODY.holds(origin + along[None, :, None] * beams[:, None]).any(axis=1)
    met = BODY.stops(origin, beams, 1.2)
    grown = Body(frame="robot", boxes=tuple(_grown(box, 0.001) for box in BODY.boxes))
    assert (naive <= met).all()
    assert (met <= grown.holds(origin + along[None, :, None] * beams[:, None]).any(axis=1)).all()
    assert naive.any() and not naive.all()


def _grown(box: BodyBox, by_m: float) -> BodyBox:
    low, high = np.array(box.low_m) - by_m, np.array(box.high_m) + by_m
    return BodyBox(name=box.name, low_m=tuple(low.tolist()), high_m=tuple(high.tolist()))


def test_a_rig_with_a_body_comes_back_and_one_without_says_nothing_of_it() -> None:
    assert rig_from_json(RIG.to_json()) == RIG
    assert "body" not in json.loads(RIG.model_copy(update={"body": None}).to_json())


@pytest.mark.parametrize(
    "body",
    [
        {"frame": "robot", "boxes": []},
        {"frame": "ro bot", "boxes": [{"name": "a", "low_m": [0, 0, 0], "high_m": [1, 1, 1]}]},
        {"frame": "robot", "boxes": [{"name": "a", "low_m": [0, 0, 0], "high_m": [1, 0, 1]}]},
        {"frame": "robot", "boxes": [{"name": "a", "low_m": [0, 0, 0], "high_m": [1, 1, 1e9]}]},
        {"frame": "robot", "boxes": [{"name": "a", "low_m": [0, 0, 0]}]},
    ],
)
def test_boxes_that_are_none_are_refused(body: object) -> None:
    document = json.loads(RIG.to_json()) | {"body": body}
    with pytest.raises(BadInputError, match="body"):
        rig_from_json(json.dumps(document).encode())
