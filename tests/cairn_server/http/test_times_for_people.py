"""Times in answers: seconds for programs, and ISO 8601 next to them for people, who state no version."""

import math
from datetime import datetime
from pathlib import Path
from typing import Any

import pytest
from tests.fixtures.server.live import Live
from tests.fixtures.server.pushes import MOLE, pushed

from cairn_map.wire.utc_times import utc_text

ADMIN = {"Authorization": "Bearer " + "a" * 20}
PROGRAM = {"Cairn-Protocol": "1"}
READ = ("/tokens", "/audit", "/maps/{map}/log", "/maps/{map}/branches", "/maps/{map}/keys")


def without_texts(answer: Any) -> Any:
    """An answer as programs get it."""
    if isinstance(answer, list):
        return [without_texts(each) for each in answer]
    if isinstance(answer, dict):
        return {name: without_texts(value) for name, value in answer.items() if not name.endswith("_utc")}
    return answer


def pairs_of(answer: Any) -> list[tuple[Any, Any]]:
    """Every time in an answer, in seconds and as text."""
    if isinstance(answer, list):
        return [pair for each in answer for pair in pairs_of(each)]
    if not isinstance(answer, dict):
        return []
    own = [(answer[f"{name[:-4]}_s"], text) for name, text in answer.items() if name.endswith("_utc")]
    return own + [pair for value in answer.values() for pair in pairs_of(value)]


def test_people_get_each_time_in_both_forms_and_programs_what_they_always_got(tmp_path: Path) -> None:
    with Live(tmp_path, admin_token="a" * 20) as live:
        row = live.new_map()
        body = {"robot": "mole", "incarnation": MOLE.incarnation}
        live.http.post(f"/maps/{row.name}/branches", json=body, headers=ADMIN)
        live.push(row, pushed(0, 0), headers=ADMIN)
        live.folded(row)
        for path in READ:
            url = path.format(map=row.name)
            for_people, for_programs = (live.http.get(url, headers=ADMIN | more).json() for more in ({}, PROGRAM))
            assert without_texts(for_people) == without_texts(for_programs) == for_programs, path
            pairs = pairs_of(for_people)
            assert pairs, path
            for seconds, text in pairs:
                times = list(zip(seconds, text, strict=True)) if isinstance(seconds, list) else [(seconds, text)]
                assert all(datetime.fromisoformat(said).timestamp() == math.floor(at) for at, said in times), path


@pytest.mark.parametrize("time_s", [-1e11, 1e12, math.inf, math.nan])
def test_a_time_without_such_a_form_is_said_to_be_out_of_range(time_s: float) -> None:
    assert utc_text(time_s) == "out of range"
