"""A robot on several layers: each gets its scans at its resolution, one key vouches for all, the finest answers."""

import threading
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.fixtures.client.made import GEOMETRY, MAP
from tests.fixtures.client.robot_program import INTEGRATOR, RIG, scan_of
from tests.fixtures.server.access import ADMIN, ENROLLER
from tests.fixtures.server.live import Live, free_port, until

from cairn_calib.rig.rig import Rig
from cairn_client.robot.layered_robot import ASSIGNMENT_FILE, LayeredRobot
from cairn_client.robot.robot import Robot
from cairn_fusion.mapping.integrate import integrate_scan
from cairn_map.epochs.history_map import HistoryMap
from cairn_map.epochs.layer import EVIDENCE, MapLayer
from cairn_map.errors import BadInputError, DeniedError, NotFoundError, UnreachableError
from cairn_map.evidence.grid import Geometry
from cairn_map.wire.layer_messages import AddLayer, Assignment, MappedLayer
from cairn_map.wire.messages import CreateMap
from cairn_server.access.auth import ADMIN_FILE

GRIDS = {
    EVIDENCE: GEOMETRY,
    "fine": Geometry(voxel_edge_um=25_000, depth=4, channels=GEOMETRY.channels),
    "wide": Geometry(voxel_edge_um=200_000, depth=3, channels=GEOMETRY.channels),
}


@pytest.fixture
def live(tmp_path: Path) -> Iterator[Live]:
    """A server with a map of three layers."""
    with Live(tmp_path / "server", admin_token=ADMIN, enrolment_token=ENROLLER, stable_after_s=0) as server:
        server.service.maps.create(MAP, CreateMap(geometry=GEOMETRY))
        row = server.service.store.map(MAP)
        for name in ("fine", "wide"):
            server.service.sync.layers.add(row, AddLayer(name=name, geometry=GRIDS[name]), by=ADMIN_FILE)
        yield server


def url_of(live: Live, layer: str = EVIDENCE) -> str:
    return f"http://127.0.0.1:{live.port}/maps/{MAP}" + ("" if layer == EVIDENCE else f".{layer}")


def opened(live: Live, folder: Path, contributes: list[str], fetches: list[str], *, name: str = "mole") -> LayeredRobot:
    return LayeredRobot(
        RIG,
        url_of(live),
        directory=folder / name,
        name=name,
        contributes=contributes,
        fetches=fetches,
        token=ENROLLER,
        integrators=dict.fromkeys(GRIDS, INTEGRATOR),
    )


def made(layer: str, *seeds: int) -> HistoryMap:
    """Evidence of some scans at the resolution of a layer."""
    total = HistoryMap(MapLayer(geometry=GRIDS[layer]))
    for seed in seeds:
        total.merge(integrate_scan(scan_of(seed), RIG, GRIDS[layer], integrator=INTEGRATOR))
    return total


def test_scans_go_into_the_layers_that_a_robot_maps_into_and_the_finest_that_knows_answers(
    live: Live, tmp_path: Path
) -> None:
    with opened(live, tmp_path, [EVIDENCE, "fine"], ["wide"]) as mole:
        mole.observe(scan_of(1))
        assert mole.commit().keys() == {EVIDENCE, "fine"}
        mole.observe(scan_of(2), into=[EVIDENCE])
        assert mole.commit().keys() == {EVIDENCE}
        with opened(live, tmp_path, ["wide"], [EVIDENCE, "fine"], name="wren") as wren:
            wren.observe(scan_of(3))
            wren.commit()
            wren.sync(until_folded=True)
            mole.sync(until_folded=True)
            wren.sync()
        expected = {EVIDENCE: made(EVIDENCE, 1, 2), "fine": made("fine", 1), "wide": made("wide", 3)}
        for robot in (mole, wren):
            assert {layer: each.map for layer, each in robot.robots.items()} == expected
        # Each point from the finest layer that knows it.
        layers = mole.snapshot()
        seen = [layers[layer].voxels_in().centres_m for layer in layers.names]
        chance = np.random.default_rng(1)
        points = np.concatenate([*(chance.permutation(each)[:60] for each in seen), np.full((1, 3), 90.0)])
        names = layers.names_at(points)
        assert {*names} == {"fine", EVIDENCE, "wide", None}
        for point, name, state in zip(points, names, layers.state_at(points), strict=True):
            finest = next((each for each in layers.names if layers[each].state_at([point])[0]), None)
            assert (name, state) == (finest, 0 if finest is None else layers[finest].state_at([point])[0])


def test_a_name_is_one_robot_s_on_all_layers(live: Live, tmp_path: Path) -> None:
    with opened(live, tmp_path, ["fine"], [EVIDENCE]) as mole:
        mole.observe(scan_of(1))
        mole.commit()
        mole.sync()
    # A third folder, later, is vouched for by the others.
    with opened(live, tmp_path, ["fine", "wide"], [EVIDENCE]) as mole:
        mole.observe(scan_of(2))
        mole.commit()
        mole.sync(until_folded=True)
        assert [robot.waiting for robot in mole.robots.values()] == [0, 0, 0]
    # Another machine that takes the name is let in nowhere.
    for layer in GRIDS:
        with Robot(
            None, url_of(live, layer), directory=tmp_path / f"thief-{layer}", name="mole", token=ENROLLER
        ) as thief:
            with pytest.raises(DeniedError) as refused:
                thief.sync()
            assert refused.value.kind == "not_admitted"


def assign(live: Live, *contributes: str | MappedLayer, fetches: tuple[str, ...] = ()) -> None:
    mapped = [each if isinstance(each, MappedLayer) else MappedLayer(layer=each) for each in contributes]
    assignment = Assignment(contributes=tuple(mapped), fetches=fetches)
    live.service.sync.layers.assign(live.service.store.map(MAP), "mole", assignment, by=ADMIN_FILE)


def followed(live: Live, folder: Path, *, token: str | None = ENROLLER) -> LayeredRobot:
    """A robot that leaves its layers to operators."""
    standard = dict.fromkeys(GRIDS, INTEGRATOR)
    return LayeredRobot(
        RIG, url_of(live), directory=folder / "mole", name="mole", token=token, integrators=standard, stay=True
    )


def test_operators_assign_layers_and_the_robot_takes_them_with_its_next_round(live: Live, tmp_path: Path) -> None:
    with pytest.raises(NotFoundError, match="cairn map layer assign") as unknown:
        followed(live, tmp_path)
    assert unknown.value.kind == "no_assignment"
    assign(live, EVIDENCE, fetches=("wide",))
    with followed(live, tmp_path) as mole:
        assert (mole.contributes, {*mole.robots}) == ((EVIDENCE,), {EVIDENCE, "wide"})
        mole.observe(scan_of(1))
        assert mole.commit().keys() == {EVIDENCE}
        # Evidence of a layer that it leaves is pushed first; what it fetched it may map into.
        mole.observe(scan_of(2))
        assign(live, "fine", "wide")
        mole.sync()
        assert (mole.contributes, {*mole.robots}) == (("fine", "wide"), {"fine", "wide"})
        mole.observe(scan_of(3))
        # What was open in the layer that it left was committed then, and comes to the caller with the next commit.
        made_now = mole.commit()
        assert made_now.keys() == {"fine", "wide", EVIDENCE}
        assert mole.commit() == {}
        with pytest.raises(BadInputError, match="maps into") as refused:
            mole.amend({EVIDENCE: made_now[EVIDENCE]}, T_map_observed=np.eye(4))
        assert refused.value.kind == "bad_layer"
        mole.sync(until_folded=True)
        live.service.sync.layers.unassign(live.service.store.map(MAP), "mole", by=ADMIN_FILE)
        mole.sync()  # nothing new: it stays as it is
        assert mole.contributes == ("fine", "wide")
    # The next start has them from its folder; and what all pushed is on the server.
    with followed(live, tmp_path) as mole:
        assert mole.contributes == ("fine", "wide")
    with opened(live, tmp_path, ["wide"], [EVIDENCE, "fine"], name="wren") as wren:
        wren.sync()
        expected = {EVIDENCE: made(EVIDENCE, 1, 2), "fine": made("fine", 3), "wide": made("wide", 3)}
        assert {layer: each.map for layer, each in wren.robots.items()} == expected


def test_a_robot_switches_layers_by_place(live: Live, tmp_path: Path) -> None:
    x = float(scan_of(1).T_map_rig[0, 3])
    house = ((-9.0, -9.0, -9.0), (x + 1e-6, 9.0, 9.0))
    assign(live, MappedLayer(layer=EVIDENCE, inside_m=house), MappedLayer(layer="wide", outside_m=house), "fine")
    farther = next(seed for seed in range(2, 50) if scan_of(seed).T_map_rig[0, 3] > x + 0.01)
    with followed(live, tmp_path) as mole:
        mole.observe(scan_of(1))
        mole.observe(scan_of(farther))
        assert mole.commit().keys() == {EVIDENCE, "wide", "fine"}
        expected = {EVIDENCE: (1,), "wide": (farther,), "fine": (1, farther)}
        for layer, seeds in expected.items():
            assert mole.robots[layer].map == made(layer, *seeds)
        with pytest.raises(BadInputError, match="maps into"):
            mole.observe(scan_of(1), into=["far"])


def test_layers_that_are_assigned_while_it_syncs_in_the_background_are_opened_there(
    live: Live, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened_by: dict[str, threading.Thread] = {}

    class Noted(Robot):
        def __init__(self, rig: Rig | None, map_url: str, **options: Any) -> None:
            opened_by[map_url] = threading.current_thread()
            super().__init__(rig, map_url, **options)

    monkeypatch.setattr("cairn_client.robot.layered_robot.Robot", Noted)
    assign(live, EVIDENCE)
    with followed(live, tmp_path) as mole:
        mole.start_sync(every_s=0.05)
        mole.observe(scan_of(1))
        assign(live, "fine")
        until(lambda: (mole.snapshot(), {*mole.robots})[1] == {"fine"}, "it maps into the other layer")
        mole.observe(scan_of(2))
        assert mole.commit().keys() == {"fine", EVIDENCE}
    here = threading.current_thread()
    assert [opened_by[url_of(live, layer)] is here for layer in (EVIDENCE, "fine")] == [True, False]


def test_a_layer_that_is_left_and_joined_again_loses_no_commit_to_its_caller(live: Live, tmp_path: Path) -> None:
    assign(live, EVIDENCE)
    with followed(live, tmp_path) as mole:
        for seed, layer in ((1, "fine"), (2, EVIDENCE)):
            mole.observe(scan_of(seed))
            assign(live, layer)
            mole.sync()
        first = mole.observe(scan_of(3))
        second = mole.commit()
        assert (first.keys(), second.keys()) == ({EVIDENCE}, {EVIDENCE, "fine"})
        assert first[EVIDENCE].id.n < second[EVIDENCE].id.n


def test_a_new_layer_is_let_in_where_nothing_waits_in_the_one_that_is_left(live: Live, tmp_path: Path) -> None:
    assign(live, EVIDENCE)
    with followed(live, tmp_path) as mole:
        mole.sync()
        assign(live, "fine")
        assert {*mole.sync()} == {"fine"}
    # And where that one is not open at all.
    assign(live, "wide")
    with followed(live, tmp_path) as mole:
        assert {*mole.sync()} == {"wide"}


def test_a_layer_that_refuses_the_robot_stops_no_other(live: Live, tmp_path: Path) -> None:
    assign(live, EVIDENCE, fetches=("wide",))
    with followed(live, tmp_path) as mole:
        mole.sync()
    # By its own token of the map it asks for its layers and for the grid of a new one, which it may not register on.
    assign(live, "fine", EVIDENCE)
    with followed(live, tmp_path, token=None) as mole:
        assert mole.contributes == ("fine", EVIDENCE)
        mole.observe(scan_of(1))
        assert mole.commit().keys() == {"fine", EVIDENCE}
        with pytest.raises(DeniedError):
            mole.sync()
        assert {layer: robot.waiting for layer, robot in mole.robots.items()} == {"fine": 1, EVIDENCE: 0}
    # Its token of a layer does not count on another one: that is opened when it can be.
    assign(live, "wide")
    with followed(live, tmp_path) as mole:
        mole.sync()
    (tmp_path / "mole" / EVIDENCE).rename(tmp_path / "elsewhere")
    (tmp_path / "mole" / "fine").rename(tmp_path / "elsewhere too")
    assign(live, "wide", EVIDENCE)
    with followed(live, tmp_path, token=None) as mole:
        mole.observe(scan_of(2))
        assert mole.commit().keys() == {"wide"}
        assert {*mole.sync()} == {"wide"}
    with followed(live, tmp_path) as mole:
        assert mole.contributes == ("wide", EVIDENCE)


def test_a_start_without_a_link_opens_the_layers_that_are_known(live: Live, tmp_path: Path) -> None:
    assign(live, EVIDENCE)
    with followed(live, tmp_path) as mole:
        mole.sync()
    with followed(live, tmp_path, token="another map's") as mole:
        assert mole.contributes == (EVIDENCE,)
    known = tmp_path / "mole" / ASSIGNMENT_FILE
    for layers, refusal in ((("fine", EVIDENCE), None), (("fine",), UnreachableError)):
        known.write_text(Assignment(contributes=tuple(MappedLayer(layer=each) for each in layers)).model_dump_json())
        url = f"http://127.0.0.1:{free_port('127.0.0.1')}/maps/{MAP}"
        with (
            pytest.raises(refusal) if refusal else nullcontext(),
            LayeredRobot(RIG, url, directory=tmp_path / "mole", name="mole") as mole,
        ):
            assert (mole.contributes, mole.assignment.layers) == ((EVIDENCE,), layers)


def test_a_measurement_is_amended_and_taken_back_in_all_its_layers(live: Live, tmp_path: Path) -> None:
    moved = np.eye(4)
    moved[0, 3] = 0.5
    with LayeredRobot(
        RIG,
        url_of(live),
        directory=tmp_path / "mole",
        name="mole",
        contributes=[EVIDENCE, "fine"],
        token=ENROLLER,
        integrators=dict.fromkeys(GRIDS, INTEGRATOR),
        keep_scans_bytes=1 << 20,
    ) as mole:
        mole.observe(scan_of(1))
        first = mole.commit()
        mole.observe(scan_of(2))
        second = mole.commit()
        mole.sync(until_folded=True)
        amended = mole.amend(first, T_map_observed=moved)
        assert amended.keys() == {EVIDENCE, "fine"}
        mole.retract(second, note="in the dark")
        mole.sync(until_folded=True)
        there = replace(scan_of(1), T_map_rig=moved @ scan_of(1).T_map_rig)
        for layer, robot in mole.robots.items():
            total = HistoryMap(MapLayer(geometry=GRIDS[layer]))
            total.merge(integrate_scan(there, RIG, GRIDS[layer], integrator=INTEGRATOR))
            assert robot.map == total
        with pytest.raises(BadInputError, match="maps into"):
            mole.amend({"wide": first["fine"]}, T_map_observed=moved)


def test_what_no_layered_robot_can_be_is_refused(live: Live, tmp_path: Path) -> None:
    for contributes, fetches in (([], ["wide"]), (["fine", "fine"], []), (["fine"], ["fine"])):
        with pytest.raises(BadInputError, match="one layer at least, each named once"):
            opened(live, tmp_path, contributes, fetches)
    with pytest.raises(BadInputError, match="take the map's URL"):
        LayeredRobot(
            RIG, url_of(live, "fine"), directory=tmp_path / "a", name="a", contributes=["wide"], token=ENROLLER
        )
    with opened(live, tmp_path, ["fine"], ["wide"]) as mole:
        with pytest.raises(BadInputError, match="maps into"):
            mole.observe(scan_of(1), into=["wide"])
        with pytest.raises(BadInputError, match="marks are the map's"):
            mole.robots["fine"].mark("lamp", (0, 0, 0))
        with pytest.raises(BadInputError, match="marks are the map's"):
            mole.robots["fine"].marks()
    # The folder of one robot lends its keys to no other.
    with pytest.raises(BadInputError) as refused:
        LayeredRobot(
            RIG, url_of(live), directory=tmp_path / "mole", name="wren", contributes=["fine", "wide"], token=ENROLLER
        )
    assert refused.value.kind == "other_replica"
