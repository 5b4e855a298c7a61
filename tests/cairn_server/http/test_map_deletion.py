"""Answers about a map that was deleted: `gone` to its own tokens and to those of all maps, nothing to others."""

from collections.abc import Iterator

import pytest
from tests.fixtures.map.made import SMALL
from tests.fixtures.server.access import ADMIN, ENROLLER, bearer, robot_token
from tests.fixtures.server.answers import kind_of
from tests.fixtures.server.listening import by_socket, by_sse, hello_of
from tests.fixtures.server.live import Live, until
from tests.fixtures.server.protocol_document import ROLES_OF
from tests.fixtures.server.pushes import MOLE, pushed

from cairn_map.errors import NotFoundError
from cairn_map.wire.messages import CreateMap, MapDeleted, MapSizes
from cairn_server.operations.upstream import OwnMaps
from cairn_server.store.store_rows import MapRow


@pytest.fixture(scope="module")
def guarded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Live]:
    """A server that wants tokens."""
    with Live(tmp_path_factory.mktemp("deletion"), admin_token=ADMIN, enrolment_token=ENROLLER) as server:
        yield server


def delete(live: Live, row: MapRow, **options: object) -> MapDeleted:
    answer = live.http.delete(f"/maps/{row.name}", params={"confirm": row.name}, headers=bearer(ADMIN), **options)  # type: ignore[arg-type]
    assert answer.status_code == 200, answer.text
    return MapDeleted.model_validate_json(answer.content)


def test_a_map_is_deleted_by_a_request_that_names_it_twice(guarded: Live) -> None:
    row = guarded.new_map()
    for params in ({}, {"confirm": ""}, {"confirm": "another"}):
        answer = guarded.http.delete(f"/maps/{row.name}", params=params, headers=bearer(ADMIN))
        assert (answer.status_code, kind_of(answer)) == (400, "not_confirmed")
    assert guarded.http.get(f"/maps/{row.name}", headers=bearer(ADMIN)).status_code == 200
    assert delete(guarded, row).name == row.name
    again = guarded.http.delete(f"/maps/{row.name}", params={"confirm": row.name}, headers=bearer(ADMIN))
    assert (again.status_code, kind_of(again)) == (410, "gone")
    lines = [line for line in guarded.service.store.audit_log.page(after=0, limit=1000) if line.what == "delete_map"]
    assert (lines[-1].who, lines[-1].detail.partition(":")[0]) == ("admin", f"map {row.name}")


@pytest.mark.parametrize("has_namesake", [False, True])
def test_every_route_tells_the_map_s_own_tokens_that_it_is_gone(guarded: Live, has_namesake: bool) -> None:
    row, other = guarded.new_map(), guarded.new_map()
    own, others = robot_token(guarded, row, "mole"), robot_token(guarded, other, "mole")
    delete(guarded, row)
    if has_namesake:
        guarded.service.maps.create(row.name, CreateMap(geometry=SMALL))
    names = {"name": row.name, "branch": "mole", "robot": "mole", "author": str(MOLE), "commit": str(pushed(0, 0).id)}
    names |= {"cell": "0,0,0", "voxel": "0,0,0", "sha": "0" * 64}
    for method, path in ROLES_OF:
        if "{name}" not in path or (method, path) == ("PUT", "/maps/{name}"):
            continue
        url = path.format_map(names)
        for token, expected in ((own, (410, "gone")), (others, (401, "bad_token"))):
            answer = guarded.ask(method, url, content=b"{}", headers=bearer(token))
            told = None if method == "HEAD" else kind_of(answer)
            # An admin's routes are refused before they look, to whoever is no admin of all maps.
            assert (answer.status_code, told) in (expected, (expected[0], None)), (method, path, answer.text)
    for headers in (bearer(ADMIN), bearer(ENROLLER)):
        answer = guarded.http.get(f"/maps/{row.name}", headers=headers)
        assert answer.status_code == (200 if has_namesake else 410)
    assert guarded.http.get(f"/maps/{row.name}").status_code == 401


def test_a_token_of_a_deleted_map_is_told_so_wherever_it_is_shown(guarded: Live) -> None:
    row, other = guarded.new_map(), guarded.new_map()
    token = robot_token(guarded, row, "mole")
    delete(guarded, row)
    for path in ("/maps", f"/maps/{other.name}", "/maps/nowhere", "/tokens"):
        answer = guarded.http.get(path, headers=bearer(token))
        assert (answer.status_code, kind_of(answer)) == (410, "gone")
        assert f"map {row.name} was deleted" in answer.json()["detail"]
    listed = guarded.http.get("/tokens", headers=bearer(ADMIN)).json()
    assert row.name not in {each["map"] for each in listed}


def test_nothing_of_a_map_can_be_changed_and_the_answer_says_why(guarded: Live) -> None:
    row = guarded.new_map()
    answer = guarded.http.patch(f"/maps/{row.name}", json={"name": "other"}, headers=bearer(ADMIN))
    assert (answer.status_code, kind_of(answer)) == (400, "map_is_fixed")
    assert "signed" in answer.json()["detail"]


def test_streams_of_a_deleted_map_end(live: Live) -> None:
    row, other = live.new_map(), live.new_map()
    with by_socket(live, row) as socket, by_sse(live, row) as stream, by_socket(live, other) as kept:
        for events in (socket, stream, kept):
            hello_of(events)
        live.http.delete(f"/maps/{row.name}", params={"confirm": row.name}).raise_for_status()
        assert [list(events) for events in (socket, stream)] == [[], []]
        live.push(other, pushed(0, 0))
        assert next(kept) is not None


def test_a_deleted_map_s_rows_go_by_themselves_and_folding_goes_on(live: Live) -> None:
    row, other = live.new_map(), live.new_map()
    for n in range(3):
        live.push(row, pushed(n, n))
    live.http.delete(f"/maps/{row.name}", params={"confirm": row.name}).raise_for_status()
    until(lambda: not live.service.store.clear_deleted(size_bytes_max=1), "the rows are gone")
    live.push(other, pushed(0, 0))
    live.folded(other)
    assert live.http.get("/readyz").status_code == 200


def test_a_relay_makes_no_map_again_that_was_deleted_here(live: Live) -> None:
    row = live.new_map()
    info = live.service.maps.info(row)
    live.http.delete(f"/maps/{row.name}", params={"confirm": row.name}).raise_for_status()
    with pytest.raises(NotFoundError, match="was deleted"):
        OwnMaps(live.service).open(info)
    assert row.name not in OwnMaps(live.service).map_names()


def test_sizes_of_a_map_are_those_of_its_cells_evidence_and_log(live: Live) -> None:
    row, commits = live.new_map(), [pushed(n, n) for n in range(3)]
    for commit in commits:
        live.push(row, commit)
    live.folded(row)

    def sizes() -> MapSizes:
        return MapSizes.model_validate_json(live.http.get(f"/maps/{row.name}/sizes").content)

    cells_bytes = sum(map(len, live.cells(row).values()))
    assert sizes().present_bytes + sizes().history_bytes == cells_bytes
    assert sizes().evidence_bytes == sum(len(commit.data) for commit in commits)
    assert (sizes().log_entries, sizes().log_bytes > 0) == (3, True)
    live.service.store.forget_evidence(row, before_s=1e9, limit=2)
    assert sizes().evidence_bytes == len(commits[2].data)
    live.push(row, commits[0])
    assert sizes().evidence_bytes == len(commits[0].data) + len(commits[2].data)
