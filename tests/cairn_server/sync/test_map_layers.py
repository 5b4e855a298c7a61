"""Layers over HTTP: added by operators, listed, mapped into, refused; names, tokens and marks are the map's."""

import shutil
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import httpx
import pytest
from tests.fixtures.map.classed import CLASSED
from tests.fixtures.map.layers import FINE, layer_commit
from tests.fixtures.map.made import SMALL
from tests.fixtures.map.marks import mark, mark_commit
from tests.fixtures.server.access import ADMIN, ENROLLER, bearer, robot_token
from tests.fixtures.server.answers import kind_of
from tests.fixtures.server.live import Live
from tests.fixtures.server.pushes import MOLE, pushed, read, sum_of
from tests.fixtures.server.stores import one_server

from cairn_map.epochs.layer import LAYERS_MAX
from cairn_map.evidence.grid import Geometry, level_geometry
from cairn_map.wire.layer_messages import Assignment, LayerAdded, LayerInfo
from cairn_server.store.store_rows import MapRow

KNOWS_LAYERS = {"Cairn-Format": "4"}


@pytest.fixture(scope="module")
def guarded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Live]:
    folder: Path = tmp_path_factory.mktemp("guarded-layers")
    with Live(folder, admin_token=ADMIN, enrolment_token=ENROLLER) as server:
        yield server


def add(live: Live, row: MapRow, name: str = "fine", geometry: Geometry = FINE, **options: Any) -> Any:
    body = {"name": name, "geometry": geometry.model_dump(mode="json")}
    return live.http.post(f"/maps/{row.name}/layers", json=body | options.pop("fields", {}), **options)


def layer_of(live: Live, row: MapRow, name: str = "fine") -> MapRow:
    return live.service.store.map(f"{row.name}.{name}")


def listed(live: Live, row: MapRow) -> list[LayerInfo]:
    answer = live.http.get(f"/maps/{row.name}/layers")
    assert answer.status_code == 200, answer.text
    return [LayerInfo.model_validate(each) for each in answer.json()]


@pytest.mark.parametrize("epoch_s", [None, 60])
def test_an_operator_adds_a_layer_and_robots_map_into_it_apart_from_the_map(live: Live, epoch_s: int | None) -> None:
    row = live.new_map(epoch_s=epoch_s)
    answer = add(live, row)
    assert answer.status_code == 201, answer.text
    added = LayerAdded.model_validate_json(answer.content)
    assert (added.layer.name, added.layer.map, added.layer.epoch_s) == ("fine", f"{row.name}.fine", None)
    # Its beginning is a commit of the map, as relays and robots get it.
    fetched = live.http.get(f"/maps/{row.name}/commits/{added.commit}", headers=KNOWS_LAYERS)
    assert (fetched.content[:5], "Cairn-Seal" in fetched.headers) == (b"CRCM\x04", True)
    live.folded(row)
    (entry,) = live.http.get(f"/maps/{row.name}/log").json()
    assert (entry["id"], entry["cells"]) == (added.commit, 0)

    fine = layer_of(live, row)
    evidence = [pushed(n, n, MOLE, geometry=FINE) for n in range(3)]
    for commit in evidence:
        assert live.push(fine, commit).status_code == 201
    assert live.retract(fine, evidence[0]).status_code == 201
    assert read(live.cells(fine)) == sum_of(evidence[1:])
    assert live.cells(row) == {}
    assert [(each.name, each.cells > 0) for each in listed(live, row)] == [("evidence", False), ("fine", True)]


def test_the_grid_of_a_layer_is_not_that_of_the_map(live: Live) -> None:
    row = live.new_map()
    add(live, row)
    fine = layer_of(live, row)
    for target, geometry in ((row, FINE), (fine, SMALL)):
        answer = live.push(target, pushed(0, 0, geometry=geometry))
        assert (answer.status_code, kind_of(answer)) == (400, "other_geometry")
    assert live.push(row, pushed(0, 0)).status_code == 201
    assert live.push(fine, pushed(0, 0, geometry=FINE)).status_code == 201
    for target, geometry in ((row, SMALL), (fine, FINE)):
        answer = live.http.get(f"/maps/{target.name}", headers=KNOWS_LAYERS).json()
        assert (answer["name"], Geometry.model_validate(answer["geometry"])) == (target.name, geometry)


def test_equal_layers_are_one_and_other_definitions_are_refused_with_both_named(live: Live) -> None:
    row = live.new_map()
    assert add(live, row).status_code == 201
    again = add(live, row)
    assert (again.status_code, again.json()["commit"]) == (200, None)
    for answer in (add(live, row, geometry=SMALL), add(live, row, fields={"epoch_s": 120})):
        assert (answer.status_code, kind_of(answer)) == (409, "other_layer")
        assert "voxels of 0.01 m" in answer.text
    assert [each.name for each in listed(live, row)] == ["evidence", "fine"]


@pytest.mark.parametrize(
    ("name", "status", "kind"),
    [("evidence", 400, "reserved_name"), ("Fine", 422, ""), ("9fine", 422, ""), ("a.b", 422, ""), ("a" * 33, 422, "")],
)
def test_names_that_no_layer_has_are_refused(live: Live, name: str, status: int, kind: str) -> None:
    row = live.new_map()
    answer = add(live, row, name)
    assert answer.status_code == status
    assert kind_of(answer) == kind or not kind
    assert [each.name for each in listed(live, row)] == ["evidence"]


def test_a_map_has_sixteen_layers_and_cells_fit_the_server(live: Live) -> None:
    row = live.new_map()
    for n in range(LAYERS_MAX - 1):
        assert add(live, row, f"layer{n}").status_code == 201
    answer = add(live, row, "one_more")
    assert (answer.status_code, kind_of(answer)) == (409, "too_many_layers")
    large = Geometry(voxel_edge_um=10_000, depth=8, channels=SMALL.channels)
    for answer in (add(live, live.new_map(), geometry=large), _handed(live, large)):
        assert (answer.status_code, kind_of(answer)) == (400, "cell_too_large")


def _handed(live: Live, geometry: Geometry) -> Any:
    """Answer to a relay, or an administrator, who brings a definition."""
    return live.push(live.new_map(), layer_commit(0, geometry=geometry))


def test_what_is_the_map_s_is_not_the_layer_s(live: Live) -> None:
    row = live.new_map()
    add(live, row)
    fine = layer_of(live, row)
    refused = [
        add(live, fine, "finer"),
        live.http.get(f"/maps/{fine.name}/layers"),
        live.http.delete(f"/maps/{fine.name}", params={"confirm": fine.name}),
        live.http.post(
            f"/maps/{fine.name}/main/marks", json={"mark": {"kind": "a", "name": "b", "place_m": [0, 0, 0]}}
        ),
        live.push(fine, mark_commit(0, mark(), geometry=FINE)),
        live.push(fine, layer_commit(0, of=FINE)),
    ]
    for answer in refused:
        assert (answer.status_code, kind_of(answer)) == (400, "layer_of_map"), answer.text
        assert f"layer of map {row.name}" in answer.text
    answer = live.http.put(f"/maps/{row.name}.other", json={})
    assert (answer.status_code, kind_of(answer)) == (400, "bad_name")
    answer = live.http.get(f"/maps/{row.name}.other")
    assert (answer.status_code, kind_of(answer)) == (404, "no_map")


def test_a_map_takes_its_layers_along_when_it_is_deleted(live: Live) -> None:
    row = live.new_map()
    add(live, row)
    assert live.http.delete(f"/maps/{row.name}", params={"confirm": row.name}).status_code == 200
    for name in (row.name, f"{row.name}.fine"):
        answer = live.http.get(f"/maps/{name}")
        assert (answer.status_code, kind_of(answer)) == (410, "gone")


def test_a_list_of_maps_names_layers_to_clients_that_know_of_them_alone(live: Live) -> None:
    row = live.new_map()
    add(live, row)

    def names(headers: dict[str, str]) -> list[str]:
        found = [each["name"] for each in live.http.get("/maps", headers=headers).json()]
        return [name for name in found if name.partition(".")[0] == row.name]

    assert names(KNOWS_LAYERS) == [row.name, f"{row.name}.fine"]
    for headers in ({}, {"Cairn-Format": "2"}):
        assert names(headers) == [row.name]


@pytest.mark.parametrize("geometry", [CLASSED, level_geometry()], ids=["classes", "level"])
def test_a_layer_that_a_client_cannot_read_is_in_none_of_its_lists(live: Live, geometry: Geometry) -> None:
    row = live.new_map()
    assert add(live, row, "new", geometry).status_code == 201
    for path in ("/maps", f"/maps/{row.name}/layers"):
        answers = [live.http.get(path, headers={"Cairn-Format": known}).json() for known in ("4", "5")]
        names = [{each.get("map", each["name"]) for each in answer} for answer in answers]
        assert (f"{row.name}.new" in names[0], f"{row.name}.new" in names[1]) == (False, True)


def test_operators_add_layers_readers_list_them_and_robots_only_map(guarded: Live) -> None:
    row, other = guarded.new_map(), guarded.new_map()
    secrets = {"admin": ADMIN, "enroller": ENROLLER, "robot": robot_token(guarded, row, "mole")}
    for role in ("operator", "reader"):
        body = {"role": role, "map": row.name}
        answer = guarded.http.put(f"/tokens/{role}-of-{row.name}", json=body, headers=bearer(ADMIN))
        secrets[role] = answer.json()["token"]
    for role in ("reader", "robot", "enroller"):
        answer = add(guarded, row, headers=bearer(secrets[role]))
        assert (answer.status_code, kind_of(answer)) == (403, "not_allowed")
    assert add(guarded, row, headers=bearer(secrets["operator"])).status_code == 201
    assert add(guarded, other, headers=bearer(secrets["operator"])).status_code == 401
    fine = layer_of(guarded, row)

    # Not as a commit, either: not in an operator's name, nor in its own.
    for author in ("operator.00112233445566aa", str(MOLE)):
        answer = guarded.push(row, layer_commit(0, "mine", author=author), headers=bearer(secrets["robot"]))
        assert (answer.status_code, kind_of(answer)) == (403, "not_allowed")
    answer = guarded.push(row, layer_commit(0, "mine", author=str(MOLE)), headers=bearer(ADMIN))
    assert (answer.status_code, kind_of(answer)) == (403, "not_allowed")

    # A token of the map counts on its layers, one of a layer on that alone.
    for role in ("reader", "robot", "operator"):
        for path in (f"/maps/{row.name}/layers", f"/maps/{fine.name}", f"/maps/{fine.name}/log"):
            assert guarded.http.get(path, headers=bearer(secrets[role])).status_code == 200
    evidence = pushed(0, 0, geometry=FINE)
    assert guarded.push(fine, evidence, headers=bearer(secrets["robot"])).status_code == 201
    of_layer = robot_token(guarded, fine, "wren")
    assert guarded.http.get(f"/maps/{fine.name}", headers=bearer(of_layer)).status_code == 200
    assert guarded.http.get(f"/maps/{row.name}", headers=bearer(of_layer)).status_code == 401
    # A robot leaves the map alone; whom an admin takes off it is off its layers.
    of_map = robot_token(guarded, row, "wren")
    assert guarded.http.delete(f"/maps/{row.name}/branches/wren", headers=bearer(of_map)).status_code == 204
    assert guarded.http.get(f"/maps/{fine.name}", headers=bearer(of_layer)).status_code == 200
    assert guarded.http.delete(f"/maps/{row.name}/branches/wren", headers=bearer(ADMIN)).status_code == 204
    assert guarded.http.get(f"/maps/{fine.name}", headers=bearer(of_layer)).status_code == 401
    assert guarded.http.get(f"/maps/{fine.name}/branches", headers=bearer(ADMIN)).json() == []


def test_operators_assign_layers_to_robots_who_see_it_on_the_map_and_on_each_layer(guarded: Live) -> None:
    row = guarded.new_map()
    add(guarded, row, headers=bearer(ADMIN))
    fine = layer_of(guarded, row)
    body = {"role": "operator", "map": row.name}
    operator = guarded.http.put(f"/tokens/boss-of-{row.name}", json=body, headers=bearer(ADMIN)).json()["token"]
    robot = robot_token(guarded, fine, "mole")
    path = f"/maps/{row.name}/assignments"
    box = [[0.0, 0.0, -1.0], [4.0, 3.0, 2.0]]
    assignment = {"contributes": [{"layer": "evidence"}, {"layer": "fine", "inside_m": box}], "fetches": []}

    def refused(answer: httpx.Response) -> tuple[int, str]:
        return answer.status_code, kind_of(answer)

    assert guarded.http.get(path, headers=bearer(operator)).json() == []
    assert refused(guarded.http.put(f"{path}/mole", json=assignment, headers=bearer(robot)))[0] in (401, 403)
    # Of layers that are there, each once, on the map; of a robot that can be.
    put = partial(guarded.http.put, headers=bearer(operator))
    for wrong, expected in (
        ({"contributes": [{"layer": "wide"}]}, (404, "no_map")),
        ({"contributes": []}, (422, "bad_message")),
        ({"contributes": [{"layer": "fine"}], "fetches": ["fine"]}, (422, "bad_message")),
        ({"contributes": [{"layer": "fine", "inside_m": box[::-1]}]}, (422, "bad_message")),
        ({"contributes": [{"layer": "fine"}], "more": 1}, (422, "bad_message")),
    ):
        assert refused(put(f"{path}/mole", json=wrong)) == expected
    assert "cairn map layer" in put(f"{path}/mole", json={"contributes": [{"layer": "wide"}]}).text
    assert refused(put(f"{path}/No", json=assignment)) == (400, "bad_name")
    assert refused(put(f"/maps/{fine.name}/assignments/mole", json=assignment)) == (400, "layer_of_map")
    assert put(f"{path}/mole", json=assignment).status_code == 204
    assert put(f"{path}/wren", json={"contributes": [{"layer": "evidence"}]}).status_code == 204
    # A robot with a token of one layer sees its own there; the map's list has all.
    asked = guarded.http.get(f"/maps/{fine.name}/assignments", params={"robot": "mole"}, headers=bearer(robot)).json()
    assert [each["robot"] for each in asked] == ["mole"]
    assert Assignment.model_validate(asked[0]["assignment"]) == Assignment.model_validate(assignment)
    listed = guarded.http.get(path, headers=bearer(ENROLLER)).json()
    assert [each["robot"] for each in listed] == ["mole", "wren"]
    # Taken back, once, on the map.
    taken = guarded.http.delete(f"/maps/{fine.name}/assignments/mole", headers=bearer(ADMIN))
    assert refused(taken) == (400, "layer_of_map")
    for expected in (204, 404):
        assert guarded.http.delete(f"{path}/mole", headers=bearer(operator)).status_code == expected
    assert [each["robot"] for each in guarded.http.get(path, headers=bearer(operator)).json()] == ["wren"]


@one_server("its folder is copied")
def test_a_robot_brings_a_definition_back_to_a_server_that_was_restored(tmp_path: Path) -> None:
    with Live(tmp_path / "before", admin_token=ADMIN, enrolment_token=ENROLLER) as live:
        row = live.new_map()
    shutil.copytree(tmp_path / "before", tmp_path / "restored")
    with Live(tmp_path / "before", admin_token=ADMIN, enrolment_token=ENROLLER) as live:
        added = add(live, row, headers=bearer(ADMIN)).json()
        fetched = live.http.get(f"/maps/{row.name}/commits/{added['commit']}", headers=bearer(ADMIN) | KNOWS_LAYERS)
    with Live(tmp_path / "restored", admin_token=ADMIN, enrolment_token=ENROLLER) as live:
        robot = bearer(robot_token(live, row, "mole"))
        path = f"/maps/{row.name}/commits/{added['commit']}"
        assert live.http.put(path, content=fetched.content, headers=robot).status_code == 403
        sealed = robot | {"Cairn-Seal": fetched.headers["Cairn-Seal"]}
        assert live.http.put(path, content=fetched.content, headers=sealed).status_code == 201
        assert live.push(layer_of(live, row), pushed(0, 0, geometry=FINE), headers=robot).status_code == 201
