"""Definitions of layers."""

import hashlib

import pytest
from pydantic import ValidationError
from tests.fixtures.map.made import MIDDLE, PLAIN, SMALL

from cairn_map.epochs.layer import MapLayer


def test_a_layer_without_epochs_is_its_geometry_as_in_version_1() -> None:
    assert MapLayer(geometry=SMALL).digest() == SMALL.digest()
    assert MapLayer(geometry=SMALL).word == 0


def test_layers_that_differ_in_anything_have_different_digests() -> None:
    layers = [
        MapLayer(geometry=SMALL),
        MapLayer(geometry=SMALL, epoch_s=120),
        MapLayer(geometry=SMALL, epoch_s=121),
        MapLayer(geometry=MIDDLE, epoch_s=120),
        MapLayer(geometry=SMALL, epoch_s=120, name="radar"),
    ]
    assert len({layer.digest() for layer in layers}) == len(layers)


def test_the_digest_is_over_the_definition_as_the_format_writes_it() -> None:
    text = f'{{"epoch_s":120,"geometry":"{PLAIN.digest().hex()}","kind":"evidence","name":"evidence"}}'
    assert MapLayer(geometry=PLAIN, epoch_s=120).digest() == hashlib.sha256(text.encode()).digest()


@pytest.mark.parametrize("epoch_s", [0, -1, 1 << 40, 1.5])
def test_lengths_that_are_none_are_refused(epoch_s: float) -> None:
    with pytest.raises(ValidationError, match="epoch_s"):
        MapLayer.model_validate({"epoch_s": epoch_s})
