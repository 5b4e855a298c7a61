"""Layers on servers that are joined: one definition is one layer on all, and two under one name stay apart."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.fixtures.client.joined import Server, mapped, settled
from tests.fixtures.client.made import GEOMETRY, MAP, seen
from tests.fixtures.map.classed import CLASSED, classed_evidence
from tests.fixtures.server.live import until
from tests.fixtures.server.stores import one_server

from cairn_client.replica.outbox import CommitFacts
from cairn_client.robot.robot import Robot
from cairn_map.codec.cell_code import cell_digest
from cairn_map.commits.commit import CommitMeta
from cairn_map.epochs.layer import LayerDefinition
from cairn_map.evidence.brick_cell import sum_evidence
from cairn_map.evidence.grid import Geometry, cell_key
from cairn_map.wire.layer_messages import AddLayer
from cairn_server.access.auth import ADMIN_FILE

FINE = Geometry(voxel_edge_um=10_000, depth=GEOMETRY.depth, channels=GEOMETRY.channels)
WIDE = Geometry(voxel_edge_um=200_000, depth=GEOMETRY.depth, channels=GEOMETRY.channels)
LAYER = f"{MAP}.fine"


@pytest.fixture
def base(tmp_path: Path) -> Iterator[Server]:
    with Server(tmp_path / "base") as server:
        server.create_map()
        yield server


@pytest.fixture
def field(tmp_path: Path, base: Server) -> Iterator[Server]:
    """A server that is not joined yet; it trusts the base, and the base trusts it."""
    with Server(tmp_path / "field", trusted_servers=base.key) as server:
        server.create_map()
        base.service.settings = base.service.settings.model_copy(update={"trusted_servers": server.key})
        base.service.sync.pushes._settings = base.service.settings
        yield server


def add(server: Server, geometry: Geometry = FINE) -> None:
    server.service.sync.layers.add(server.row, AddLayer(name="fine", geometry=geometry), by=ADMIN_FILE)


def layers(server: Server) -> list[tuple[str, Geometry]]:
    return [(row.name, row.geometry) for row in server.service.store.layers(server.row)]


def definitions(server: Server) -> list[LayerDefinition]:
    """Layers as the commits of a server's map define them."""
    found = [server.service.store.commit(server.row, commit) for commit in sorted(server.ids())]
    metas = [CommitMeta.model_validate_json(each.text, strict=True) for each in found if each]
    return [meta.layer for meta in metas if meta.layer is not None]


def map_into(server: Server, folder: Path, name: str, geometry: Geometry, *seeds: int) -> None:
    """A robot maps something into the layer at a server, with its token of the map, and goes away."""
    token = server.token(f"{name}-of-layer", role="robot", map=MAP, robot=name)
    url = f"{server.url}/maps/{LAYER}"
    with Robot(None, url, directory=folder, name=name, token=token, geometry=geometry) as robot:
        for seed in seeds:
            robot.replica.commit({cell_key((seed, 0, 0)): seen(seed, 70)})
        robot.sync()


def digests(server: Server) -> dict[int, bytes]:
    """Cells of the layer, when all is folded."""
    row = server.service.store.map(LAYER)
    server.folded(row)
    with server.service.store.snapshot(row) as snapshot:
        return {cell.key: cell.digest for cell in snapshot.cells() if cell.voxels}


@one_server("one of them is given other settings")
@pytest.mark.parametrize("at", ["base", "field", "both"])
def test_a_layer_that_is_added_at_one_server_is_on_all_and_so_is_its_evidence(
    base: Server, field: Server, tmp_path: Path, at: str
) -> None:
    for name, server in (("base", base), ("field", field)):
        if at in (name, "both"):
            add(server)
    field.join(base)
    settled(base, field)
    until(lambda: layers(base) == layers(field) == [(LAYER, FINE)], "both have the layer")
    assert (
        definitions(base) == definitions(field) == [LayerDefinition(name="fine", geometry=FINE)] * (1 + (at == "both"))
    )
    map_into(field, tmp_path / "near", "near", FINE, 1, 2)
    map_into(base, tmp_path / "far", "far", FINE, 3)
    until(lambda: len(digests(base)) == len(digests(field)) == 3, "the evidence of the layer is on both")
    assert digests(base) == digests(field)
    assert base.digests() == field.digests() == {}


@one_server("one of them is given other settings")
def test_layers_of_one_name_that_differ_stay_apart_and_all_else_goes_on(
    base: Server, field: Server, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    add(base)
    add(field, WIDE)
    map_into(field, tmp_path / "near", "near", WIDE, 1)
    field.join(base)
    mapped(field, tmp_path / "robot", "robot", 1)
    mapped(base, tmp_path / "other", "other", 2)
    until(lambda: base.digests() == field.digests() and len(base.digests()) > 1, "the map's evidence is on both")
    until(lambda: "definition never changes" in caplog.text, "the relay says why the layer stays")
    # Nothing of it came: no layer, no commit, no evidence.
    assert (layers(base), layers(field)) == ([(LAYER, FINE)], [(LAYER, WIDE)])
    assert (definitions(base), definitions(field)) == (
        [LayerDefinition(name="fine", geometry=FINE)],
        [LayerDefinition(name="fine", geometry=WIDE)],
    )
    assert (len(digests(base)), len(digests(field))) == (0, 1)


@one_server("one of them is given other settings")
def test_votes_for_classes_add_up_on_all_servers(base: Server, field: Server, tmp_path: Path) -> None:
    add(base, CLASSED)
    field.join(base)
    settled(base, field)
    until(lambda: layers(base) == layers(field) == [(LAYER, CLASSED)], "both have the layer")
    votes = [classed_evidence(seed, CLASSED) for seed in (1, 2)]
    for server, name, evidence in ((field, "near", votes[0]), (base, "far", votes[1])):
        token = server.token(f"{name}-of-layer", role="robot", map=MAP, robot=name)
        url = f"{server.url}/maps/{LAYER}"
        with Robot(None, url, directory=tmp_path / name, name=name, token=token, geometry=CLASSED) as robot:
            robot.replica.commit({cell_key((0, 0, 0)): evidence}, CommitFacts(sensors=("a", "b", "c")))
            robot.sync()
    whole = cell_digest(cell_key((0, 0, 0)), sum_evidence(votes, CLASSED), CLASSED)
    until(lambda: [*digests(base).values()] == [*digests(field).values()] == [whole], "both have all votes")
