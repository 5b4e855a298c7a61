"""Messages about maps, as programs of this version and of the one before read them."""

import json

import pytest
from pydantic import ValidationError
from tests.fixtures.map.made import SMALL, made_cursor

from cairn_map.epochs.epoch import EPOCH_S_MAX
from cairn_map.epochs.layer import MapLayer
from cairn_map.errors import DamagedDataError
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_map.wire.messages import (
    JSON_FIELDS_MAX,
    JSON_VALUES_MAX,
    CreateMap,
    MapInfo,
    Registered,
    check_json_size,
)

OLD_INFO = {
    "name", "geometry", "sensor_model", "cursor", "cells", "size_bytes", "commits", "branches", "box_m", "server_key",
}  # fmt: skip
"""Fields of a map info before there were epochs: programs of then refuse others."""


def info_of(**more: object) -> MapInfo:
    """Facts of an empty map."""
    facts = {"name": "lab", "geometry": SMALL, "sensor_model": SensorModel(), "cursor": str(made_cursor())}
    return MapInfo.model_validate(
        {**facts, "cells": 0, "size_bytes": 0, "commits": 0, "branches": 0, "box_m": None, **more}
    )


def test_a_map_without_epochs_is_told_in_the_fields_of_before() -> None:
    plain = info_of()
    registered = Registered(branch="mole", token="t", map=plain)
    for told in (plain.model_dump(mode="json"), json.loads(registered.model_dump_json())["map"]):
        assert set(told) == OLD_INFO
    assert set(CreateMap(geometry=SMALL).model_dump(mode="json")) == {"geometry", "sensor_model"}
    assert (plain.epoch_s, plain.history_bytes, plain.layer) == (None, 0, MapLayer(geometry=SMALL))


def test_epochs_and_history_are_read_as_they_were_written() -> None:
    told = info_of(epoch_s=120, history_bytes=7)
    assert set(json.loads(told.model_dump_json())) == OLD_INFO | {"epoch_s", "history_bytes"}
    assert MapInfo.model_validate_json(told.model_dump_json()) == told
    assert told.layer == MapLayer(geometry=SMALL, epoch_s=120)
    asked = CreateMap(geometry=SMALL, epoch_s=EPOCH_S_MAX)
    assert CreateMap.model_validate_json(asked.model_dump_json()) == asked
    assert set(info_of(epoch_s=120).model_dump()) == OLD_INFO | {"epoch_s"}


@pytest.mark.parametrize("epoch_s", [0, -120, 1.5, EPOCH_S_MAX + 1, "none"])
def test_a_length_of_epochs_that_cannot_be_is_refused(epoch_s: object) -> None:
    with pytest.raises(ValidationError):
        CreateMap.model_validate({"epoch_s": epoch_s})


@pytest.mark.parametrize("text", [":" * JSON_FIELDS_MAX, '\\",[{:' * JSON_FIELDS_MAX, "\\\\", '\\\\\\"' + ":" * 9])
def test_separators_in_a_text_are_no_values(text: str) -> None:
    said = json.dumps({"note": text, "more": ["\\", '"', text, text + ":"]})
    for sent in (said, said.encode()):
        check_json_size(sent)


@pytest.mark.parametrize("left", ['"a\\\\",', '"\\"",', "1,", '{"":0},', '"' + ":," * 9 + '",'])
def test_separators_outside_of_texts_are_values_whatever_stands_between_them(left: str) -> None:
    said = f"[{left * JSON_VALUES_MAX}0]"
    for sent in (said, said.encode(), said.encode()[:-1]):
        with pytest.raises(DamagedDataError) as refused:
            check_json_size(sent)
        assert refused.value.kind == "too_many_values"
