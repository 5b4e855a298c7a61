"""Complaints of models come out in their own words: no name of the library's, and no `document` where there is none."""

from pathlib import Path

import pytest
from pydantic import BaseModel, ValidationError, model_validator
from tests.fixtures.commands import cairn

from cairn_map.errors import first_error


class _Pair(BaseModel):
    low: int
    high: int

    @model_validator(mode="after")
    def _check(self) -> "_Pair":
        if self.low > self.high:
            raise ValueError(f"low {self.low} is above high {self.high}")
        return self


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"low": 2, "high": 1}, "low 2 is above high 1"),
        ({"low": 2}, "high: Field required"),
        ({"low": 2, "high": "x"}, "high: Input should be a valid integer"),
    ],
)
def test_the_first_complaint_has_its_place_if_it_has_one(fields: dict[str, object], said: str) -> None:
    with pytest.raises(ValidationError) as wrong:
        _Pair.model_validate(fields)
    assert first_error(wrong.value).startswith(said)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("token", "create", "http://127.0.0.1:9", "eye", "--role", "robot"), "a robot's token names its map"),
        (("token", "create", "http://127.0.0.1:9", "eye", "--role", "reader", "--robot", "mole"), "names no robot"),
        (("map", "create", "http://127.0.0.1:9/maps/lab", "--epoch", "-1"), "epoch"),
        (("serve", "--public-url", "nonsense"), "--public-url: "),
        (("serve", "--store", "nonsense"), "--store: expected a URL like postgresql://"),
        (("serve", "--admin-token-file", "short"), "--admin-token-file: expected a secret of at least 16 characters"),
    ],
)
def test_commands_do_not_speak_of_the_library(words: tuple[str, ...], said: str, tmp_path: Path) -> None:
    (tmp_path / "short").write_text("short")
    complaint = cairn(*words, folder=tmp_path, code=1)
    assert said in complaint
    assert "Value error" not in complaint
    assert "document" not in complaint
