"""Promises of `openapi.json`, tried by schemathesis on a live server: every route, with sound and unsound input."""

import random
from typing import Any

import pytest
import schemathesis
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from schemathesis.checks import (
    content_type_conformance,
    not_a_server_error,
    response_schema_conformance,
    status_code_conformance,
)
from tests.fixtures.map.made import SMALL
from tests.fixtures.server.live import Live
from tests.fixtures.server.protocol_document import ROUTES, documented_kinds
from tests.fixtures.server.pushes import pushed
from tests.fuzz.wrapping_mutator import bytewise, mutated_commit

from cairn_map.wire.messages import CreateMap, Problem, Register

pytestmark = pytest.mark.fuzz

KINDS = documented_kinds()
BYTES = (
    "application/octet-stream",
    "application/vnd.cairn.cell",
    "application/vnd.cairn.commit",
    "image/jpeg",
    "image/png",
)
"""Media types of bodies that are not JSON."""
COMMITS = [pushed(n, n) for n in range(4)]
PLACES = {
    "name": ["lab"],
    "branch": ["mole"],
    "robot": ["mole"],
    "commit": [str(commit.id) for commit in COMMITS],
    "cell": ["0,0,0", "-1,0,2", "0,0,0.ply", "0,0,0.npz", "0,0,0.view"],
    "voxel": ["0,0,0", "-1,0,2"],
    "token": ["looker"],
    "author": [f"mole.{'5' * 16}"],
    "sha": ["0" * 64],
    "file": ["x.js"],
}
"""Names of things that exist, so that not every answer is 404."""
CONFORMANCE = (status_code_conformance, content_type_conformance, response_schema_conformance)
ANSWER_S = 10.0
PROBLEM = "application/problem+json"
ENDLESS = {"/maps/{name}/events", "/maps/{name}/live"}
"""Answers without end; test_live.py asks these."""


@pytest.fixture(scope="module")
def schema(live: Live) -> schemathesis.BaseSchema:
    """The routes of a server with a map, a robot and commits in it."""
    live.http.put("/maps/lab", json=CreateMap(geometry=SMALL).model_dump()).raise_for_status()
    body = Register.model_validate({"robot": "mole", "incarnation": "0" * 16}).model_dump()
    live.http.post("/maps/lab/branches", json=body).raise_for_status()
    row = live.service.store.map("lab")
    for commit in COMMITS[:2]:
        assert live.push(row, commit).status_code == 201
    live.folded(row)
    return schemathesis.openapi.from_url(f"http://127.0.0.1:{live.port}/openapi.json")


@st.composite
def commit_bodies(draw: st.DrawFn) -> bytes:
    """A commit, sound or changed somewhere inside."""
    rng = random.Random(draw(st.integers(0, 1 << 32)))
    sound = draw(st.sampled_from(COMMITS)).data
    return sound if draw(st.booleans()) else mutated_commit(sound, rng, bytewise(rng))


def _as_it_is(_: object, value: object) -> bytes:
    """Bytes of our own media types need no serializer: what the document says of them is `string`, `binary`."""
    return value.encode(errors="surrogatepass") if isinstance(value, str) else bytes(value)  # type: ignore[call-overload, no-any-return]


for _media_type in BYTES:
    schemathesis.serializer(_media_type)(_as_it_is)


@pytest.mark.parametrize(("method", "path"), [route for route in ROUTES if route[1] not in {"/openapi.json", *ENDLESS}])
def test_every_route_answers_anything_as_it_is_documented(
    schema: schemathesis.BaseSchema, method: str, path: str
) -> None:
    operation = schema[path][method]
    takes_bytes = path.endswith("/commits/{commit}")

    @settings(
        max_examples=25,
        deadline=None,
        database=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(
        case=operation.as_strategy(),
        places=st.fixed_dictionaries({name: st.none() | st.sampled_from(found) for name, found in PLACES.items()}),
        body=commit_bodies(),
    )
    def try_it(case: Any, places: dict[str, str | None], body: bytes) -> None:
        for name in case.path_parameters or {}:
            if places[name] is not None:
                case.path_parameters[name] = places[name]
        answer = case.call(timeout=ANSWER_S, **({"data": body} if takes_bytes else {}))
        documents_errors = {"400", "4XX", "default"} & operation.definition.raw["responses"].keys()
        checks = (not_a_server_error, *(CONFORMANCE if documents_errors else ()))
        case.validate_response(answer, checks=list(checks))
        check(method, path, answer.status_code, answer.headers.get("content-type", [""])[0], answer.content)

    try_it()


def check(method: str, path: str, status: int, media_type: str, content: bytes) -> None:
    """As PROTOCOL.md has it."""
    if status >= 400:
        assert media_type == PROBLEM
        if method == "HEAD":
            return
        problem = Problem.model_validate_json(content)
        assert problem.kind in KINDS
        assert problem.status == status
    else:
        assert status in (200, 201, 204, 206, 304)  # what else of it is as documented, `CONFORMANCE` says


def test_the_server_still_serves_and_folds_afterwards(live: Live, schema: schemathesis.BaseSchema) -> None:
    row = live.new_map()
    assert live.push(row, COMMITS[3]).status_code == 201
    assert live.cells(row).keys() == COMMITS[3].cells.keys()
