"""Readings made of views: what a view shows is shown, to the view's own steps."""

import numpy as np
import pytest
from tests.fixtures.map.histories import random_history
from tests.fixtures.map.made import KEY, SMALL

from cairn_map.codec.view_code import decode_view, encode_view
from cairn_map.epochs.present import present
from cairn_map.errors import BadInputError
from cairn_map.evidence.brick_cell import reading_cell
from cairn_map.evidence.channels import ChannelKind
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_map.evidence.view import Chance, Extent, ViewStyle, evidence_of_view
from cairn_map.evidence.voxels import voxels_of_evidence

MODEL = SensorModel()
STYLE = ViewStyle(extent=Extent.KNOWN, chance=Chance.LOG_ODDS, scalar_step=0.01)


def test_a_view_shows_the_states_and_temperatures_of_the_reading_that_it_was_made_of() -> None:
    read = present(random_history(3, SMALL), SMALL, MODEL).evidence
    data = encode_view(KEY, read, SMALL, MODEL, style=STYLE)
    shown = reading_cell(SMALL, evidence_of_view(decode_view(data).view, SMALL, MODEL), MODEL).packed()
    known = read.where(read.counts.any(axis=1))
    assert np.array_equal(shown.voxels, known.voxels)
    assert np.array_equal(shown.occupied(MODEL), known.occupied(MODEL))
    assert np.abs(shown.log_odds(MODEL) - known.log_odds(MODEL)).max() <= 0.0011
    is_sure = np.abs(known.log_odds(MODEL)) > 0.001
    assert is_sure.all()
    mine, its = (
        voxels_of_evidence(KEY, evidence, SMALL, MODEL, occupied_only=True).of_kind(ChannelKind.TEMPERATURE)
        for evidence in (shown, known)
    )
    assert mine is not None
    assert its is not None
    assert np.array_equal(mine.weight > 0, its.weight > 0)
    assert np.nanmax(np.abs(mine.mean - its.mean)) <= 0.5 * mine.channel.step + 0.006


def test_a_view_of_coarser_nodes_or_of_bytes_makes_no_reading() -> None:
    read = present(random_history(3, SMALL), SMALL, MODEL).evidence
    for style in (ViewStyle(depth=SMALL.depth - 1, chance=Chance.LOG_ODDS), ViewStyle()):
        with pytest.raises(BadInputError, match="log-odds"):
            evidence_of_view(decode_view(encode_view(KEY, read, SMALL, MODEL, style=style)).view, SMALL, MODEL)
