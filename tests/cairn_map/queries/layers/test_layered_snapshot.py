"""Layers asked together: the finest that knows a point answers, as a slow reader finds it, and nothing is mixed."""

import numpy as np
import pytest
from tests.fixtures.map.made import random_evidence

from cairn_map.epochs.history_map import HistoryMap
from cairn_map.epochs.layer import MapLayer
from cairn_map.errors import BadInputError, NotFoundError
from cairn_map.evidence.channels import COLOUR, TEMPERATURE, Channel, ChannelKind
from cairn_map.evidence.grid import Geometry, cell_key
from cairn_map.queries.layers.layered_snapshot import LayeredSnapshot
from cairn_map.queries.map_snapshot import MapSnapshot, snapshot_of
from cairn_map.queries.occupancy_states import State

EDGES_UM = {"wide": 200_000, "evidence": 40_000, "fine": 10_000}
CHANNELS = {"wide": (COLOUR, TEMPERATURE), "evidence": (TEMPERATURE,), "fine": (COLOUR,)}


def layer(name: str, *, seed: int, voxels: int = 150) -> MapSnapshot:
    """A layer whose cell at the origin and seven more are full of anything."""
    geometry = Geometry(voxel_edge_um=EDGES_UM[name], depth=3, channels=CHANNELS[name])
    whole = HistoryMap(MapLayer(geometry=geometry))
    cells = np.stack(np.meshgrid(*[[-1, 0]] * 3), axis=-1).reshape(-1, 3).tolist()
    whole.merge(
        {cell_key(tuple(cell)): random_evidence(seed + n, geometry, voxels=voxels) for n, cell in enumerate(cells)}
    )
    return snapshot_of(whole)


@pytest.fixture(scope="module")
def layers() -> dict[str, MapSnapshot]:
    return {name: layer(name, seed=9 * n) for n, name in enumerate(EDGES_UM)}


def points(seed: int = 3) -> np.ndarray:
    """Places in all layers, in some, and in none."""
    rng = np.random.default_rng(seed)
    return np.concatenate([rng.uniform(-reach, reach, (400, 3)) for reach in (0.08, 0.3, 1.6, 4.0)])


def test_the_finest_layer_that_knows_a_point_answers_for_it(layers: dict[str, MapSnapshot]) -> None:
    found, asked = LayeredSnapshot(layers), points()
    assert found.names == ("fine", "evidence", "wide")
    names, states = found.names_at(asked), found.state_at(asked)
    probability, odds = found.probability_at(asked), found.log_odds_at(asked)
    assert {*names} == {"fine", "evidence", "wide", None}
    for n, point in enumerate(asked):
        slow = next((name for name in found.names if layers[name].state_at([point])[0] != State.UNKNOWN), None)
        assert names[n] == slow
        if slow is None:
            assert (states[n], np.isnan(probability[n]), np.isnan(odds[n])) == (State.UNKNOWN, True, True)
        else:
            assert states[n] == layers[slow].state_at([point])[0]
            assert probability[n] == layers[slow].probability_at([point])[0]
            assert odds[n] == layers[slow].log_odds_at([point])[0]


def test_a_channel_is_read_from_the_finest_layer_with_samples_of_it(layers: dict[str, MapSnapshot]) -> None:
    found, asked = LayeredSnapshot(layers), points()
    for channel in ("temperature", "colour"):
        reading = found.reading_at(asked, channel)
        having = [name for name in found.names if layers[name].geometry.channel(channel)]
        taken = set()
        for n, point in enumerate(asked):
            slow = next((r for name in having if (r := layers[name].reading_at([point], channel)).weight[0]), None)
            assert reading.weight[n] == (slow.weight[0] if slow else 0)
            np.testing.assert_array_equal(
                reading.mean[n], slow.mean[0] if slow else np.full_like(reading.mean[n], np.nan)
            )
            if slow is not None and slow.spread is not None:
                assert reading.spread is not None and reading.spread[n] == slow.spread[0]
            taken.add(slow is None)
        assert taken == {True, False}


def test_channels_of_one_name_in_another_unit_are_left_out() -> None:
    made = {}
    for name, unit in (("fine", "K"), ("wide", "mK")):
        channel = Channel(kind=ChannelKind.SCALAR, name="dose", unit=unit, step=1.0)
        geometry = Geometry(voxel_edge_um=EDGES_UM[name], depth=3, channels=(channel,))
        whole = HistoryMap(MapLayer(geometry=geometry))
        whole.merge({cell_key((0, 0, 0)): random_evidence(1, geometry, voxels=400)})
        made[name] = snapshot_of(whole)
    asked = np.full((1, 3), 1.5)
    assert made["wide"].reading_at(asked, "dose").weight[0]
    assert LayeredSnapshot(made).reading_at(asked, "dose").weight[0] == 0


def test_one_layer_answers_as_it_does_alone(layers: dict[str, MapSnapshot]) -> None:
    alone, asked = layers["evidence"], points()
    found = LayeredSnapshot({"evidence": alone})
    np.testing.assert_array_equal(found.probability_at(asked), alone.probability_at(asked))
    assert found["evidence"] is alone
    assert len(found.state_at(np.empty((0, 3)))) == 0


def test_what_is_not_there_is_refused_by_name(layers: dict[str, MapSnapshot]) -> None:
    with pytest.raises(BadInputError, match="one layer at least"):
        LayeredSnapshot({})
    with pytest.raises(NotFoundError, match="no layer 'far', but fine, evidence, wide"):
        LayeredSnapshot(layers)["far"]
    with pytest.raises(BadInputError, match="no layer of the map has a channel 'dose'"):
        LayeredSnapshot(layers).reading_at([[0, 0, 0]], "dose")
    with pytest.raises(BadInputError):
        LayeredSnapshot(layers).state_at([[0, 0]])
