"""State of the hand-over to an upstream server: figures that are there from the start, and what a probe is answered."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.fixtures.client.joined import ADMIN, EVERY_S, Server, mapped
from tests.fixtures.client.made import GEOMETRY, MAP
from tests.fixtures.server.access import bearer
from tests.fixtures.server.live import free_port, until
from tests.fixtures.server.prometheus_text import families_of

from cairn_client.cli.doctor.command import main as doctor
from cairn_client.relay.upstream import Upstream
from cairn_map.errors import DeniedError, UnreachableError
from cairn_map.wire.messages import CreateMap
from cairn_server.operations.upstream import OwnMaps

# FastAPI silences this warning while it builds a route, in a way that two threads undo for each other.
pytestmark = pytest.mark.filterwarnings("ignore::pydantic.warnings.UnsupportedFieldAttributeWarning")


@pytest.fixture
def base(tmp_path: Path) -> Iterator[Server]:
    with Server(tmp_path / "base") as server:
        server.create_map()
        yield server


@pytest.fixture
def field(tmp_path: Path, base: Server) -> Iterator[Server]:
    """A field server with the same map, not joined yet."""
    with Server(tmp_path / "field", upstream=base.url) as server:
        server.create_map()
        yield server


def figures(server: Server, name: str) -> dict[str, float]:
    """Values of a family by the label `map`."""
    text = server.http.get("/metrics", headers=bearer(ADMIN)).text
    return {dict(labels)["map"]: value for (_, labels), value in families_of(text)[name].samples.items()}


def ups(server: Server) -> dict[str, float]:
    return figures(server, "cairn_upstream_up")


def degraded(server: Server) -> str:
    answer = server.http.get("/readyz")
    assert answer.status_code == 200
    return str(answer.json().get("degraded", ""))


def test_the_figures_are_there_before_anything_was_handed_over(field: Server) -> None:
    assert ups(field) == {"": 0, MAP: 0}
    assert 0 <= figures(field, "cairn_upstream_age_seconds")[MAP] < 60
    assert degraded(field) == ""


def test_a_server_without_upstream_has_none(base: Server) -> None:
    assert ups(base) == {}
    assert figures(base, "cairn_upstream_age_seconds") == {}


def test_a_map_that_is_handed_over_is_up_and_one_that_the_base_lacks_is_not(base: Server, field: Server) -> None:
    field.join(base)
    until(lambda: ups(field) == {"": 1, MAP: 1}, "all is well")
    assert degraded(field) == ""
    field.service.maps.create("own", CreateMap(geometry=GEOMETRY))
    until(lambda: degraded(field).startswith("upstream_refused: "), "the base has no such map")
    assert ups(field) == {"": 1, MAP: 1, "own": 0}
    assert "own" not in degraded(field)


def test_a_base_that_refuses_the_token_makes_the_field_server_unwell_until_it_is_given_another(
    base: Server, field: Server, capsys: pytest.CaptureFixture[str]
) -> None:
    relay = Upstream(base.url, "x" * 20, OwnMaps(field.service), every_s=EVERY_S)
    field.relays.append(relay)
    until(lambda: degraded(field) != "", "it is refused")
    assert ups(field) == {"": 0, MAP: 0}
    assert doctor([field.url, "--token", ADMIN]) == 0
    assert "warn  ready         takes pushes; upstream_refused: the upstream server refuses" in capsys.readouterr().out
    relay.use_token(base.token("field", role="relay"))
    until(lambda: ups(field) == {"": 1, MAP: 1}, "it is taken")
    assert degraded(field) == ""


def test_without_a_link_it_is_down_and_the_server_well(base: Server, tmp_path: Path) -> None:
    url = f"http://127.0.0.1:{free_port('127.0.0.1')}"
    with Server(tmp_path / "lonely", upstream=url) as lonely:
        lonely.create_map()
        lonely.relays.append(Upstream(url, None, OwnMaps(lonely.service), every_s=EVERY_S))
        until(lambda: "no_link" in str(lonely.service.sync.upstream._whole_ill.kind), "it was tried")  # type: ignore[union-attr]
        assert ups(lonely) == {"": 0, MAP: 0}
        assert degraded(lonely) == ""


def test_a_robot_with_another_key_at_the_base_makes_its_map_unwell(base: Server, field: Server, tmp_path: Path) -> None:
    mapped(base, tmp_path / "one", "mole", 1)
    mapped(field, tmp_path / "other", "mole", 2)
    field.join(base)
    until(lambda: degraded(field).startswith("upstream_refused: "), "the base refuses the other mole's commit")
    assert ups(field) == {"": 1, MAP: 0}


def test_what_is_refused_is_not_well_and_what_is_away_is(field: Server) -> None:
    progress = field.service.sync.upstream
    progress.note_round(None, None)
    progress.note_round(MAP, UnreachableError("no_link", "cut"))
    assert (progress.ups([MAP])[MAP], progress.complaint()) == (False, None)
    progress.note_round(MAP, DeniedError("not_allowed", "no"))
    assert progress.complaint() is not None
    progress.note_round(MAP, None)
    assert (progress.ups([MAP])[MAP], progress.complaint()) == (True, None)
