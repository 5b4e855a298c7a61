"""Exports as LAZ and as OctoMap's octrees, read by those who define them, and the band of temperatures."""

import io
import shutil
import subprocess
import tracemalloc
from collections.abc import Iterator
from pathlib import Path

import laspy
import numpy as np
import numpy.typing as npt
import pytest
from laspy import LazBackend
from tests.fixtures.map.made import SMALL, surface_evidence
from tests.fixtures.server.answers import kind_of
from tests.fixtures.server.exports import ask_export, mapped, places, points
from tests.fixtures.server.live import Live
from tests.fixtures.server.pushes import KEYS, pushed
from tests.naive.octomap import read_tree, states_of

from cairn_map.evidence.evidence import packed_evidence
from cairn_map.evidence.grid import cell_key, level_geometry
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_map.files.export_request import ExportRequest
from cairn_map.files.laz import LazHead, laz_parts
from cairn_map.files.octomap import branch_of_cell, tree_file, tree_of_cells
from cairn_map.files.point_clouds import POINT

BACKENDS = [LazBackend.Lazrs, LazBackend.Laszip]


def read_laz(data: bytes, backend: LazBackend = LazBackend.Lazrs) -> laspy.LasData:
    with laspy.open(io.BytesIO(data), laz_backend=backend) as file:
        return file.read()


def parts_of(count: int) -> Iterator[npt.NDArray[np.void]]:
    """Tables of 10 000 points, as cells give them, smooth enough to be compressed."""
    for start in range(0, count, 10_000):
        table = np.zeros(min(10_000, count - start), POINT)
        table["x"] = (np.arange(start, start + len(table)) // 100 + 0.5) * 0.04
        table["y"] = (np.arange(start, start + len(table)) % 100 - 49.5) * 0.04
        table["z"] = 0.02
        table["temperature"] = 290 + table["y"]
        yield table


@pytest.mark.parametrize("backend", BACKENDS)
def test_laz_says_the_same_as_the_arrays(live: Live, backend: LazBackend) -> None:
    row = mapped(live)
    table, answer = points(ask_export(live, row, format="npz")), ask_export(live, row, format="laz")
    assert answer.headers["Content-Type"] == "application/vnd.laszip"
    found = read_laz(answer.content, backend)
    assert len(found) == int(answer.headers["Cairn-Points"]) == len(table)
    edge_m = row.geometry.voxel_edge_m
    assert (np.array(found.X) % 2 == 1).all()
    np.testing.assert_allclose(found.xyz, (np.floor(places(table) / edge_m) + 0.5) * edge_m, rtol=1e-12, atol=1e-9)
    for name in ("probability", "temperature", "hottest"):
        np.testing.assert_array_equal(found[name], table[name])
    for name in ("red", "green", "blue"):
        np.testing.assert_array_equal(np.array(found[name]) >> 8, table[name])
    np.testing.assert_allclose([found.header.mins, found.header.maxs], [found.xyz.min(axis=0), found.xyz.max(axis=0)])
    said = {extra.name: extra.description for extra in found.point_format.extra_dimensions}
    assert "kelvin" in said["temperature"]
    assert found.header.number_of_points_by_return[0] == len(table)
    assert 'UNIT["metre",1]' in found.header.vlrs.get("WktCoordinateSystemVlr")[0].string


def test_heights_of_a_level_are_those_of_the_arrays(live: Live) -> None:
    level = level_geometry().model_copy(update={"depth": 4})
    row = live.new_map(level)
    assert live.push(
        row, pushed(0, 0, geometry=level, cells={KEYS[1]: surface_evidence(1, level)}, scans=64)
    ).is_success
    live.folded(row)
    table = points(ask_export(live, row, format="npz"))
    found = read_laz(ask_export(live, row, format="laz").content)
    assert len(np.unique(table["z"])) > 1
    np.testing.assert_allclose(found.xyz, places(table), atol=1e-5)
    np.testing.assert_allclose(found.header.scales, [0.1, 0.1, 0.025])
    assert b"nodes of 0.2 m and 0.05 m height" in ask_export(live, row, format="ply").content


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("count", [0, 1, 130_000])
def test_laz_of_any_size_is_read_from_its_beginning_to_its_end(count: int, backend: LazBackend) -> None:
    head = LazHead(count, np.zeros(3), np.ones(3), (0.04,) * 3, "map lab")
    found = read_laz(b"".join(laz_parts(head, parts_of(count))), backend)
    expected = np.concatenate([np.zeros(0, POINT), *parts_of(count)])
    np.testing.assert_array_equal(found["temperature"], expected["temperature"])
    np.testing.assert_allclose(found.xyz, places(expected), atol=1e-5)


def test_any_chunk_of_a_laz_is_found_by_its_table() -> None:
    head = LazHead(130_000, np.zeros(3), np.ones(3), (0.04,) * 3, "map lab")
    with laspy.open(io.BytesIO(b"".join(laz_parts(head, parts_of(130_000)))), laz_backend=LazBackend.Lazrs) as file:
        file.seek(110_000)
        np.testing.assert_allclose(file.read_points(1).x, (110_000 // 100 + 0.5) * 0.04)


def test_a_laz_is_made_with_the_memory_of_a_chunk() -> None:
    tracemalloc.start()
    head = LazHead(1_000_000, np.zeros(3), np.ones(3), (0.04,) * 3, "map lab")
    size = sum(len(part) for part in laz_parts(head, parts_of(1_000_000)))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert size > 100_000
    assert peak < 4 << 20


@pytest.mark.parametrize("form", ["ot", "bt"])
@pytest.mark.parametrize("up", [0, 1])
def test_an_octree_has_the_nodes_of_the_arrays_and_what_they_hold(live: Live, form: str, up: int) -> None:
    row = mapped(live)
    depth = row.geometry.depth - up
    table, answer = (
        points(ask_export(live, row, format="npz", depth=depth)),
        ask_export(live, row, format=form, depth=depth),
    )
    tree = read_tree(answer.content)
    assert tree.edge_m == row.geometry.voxel_edge_m
    assert tree.size == len(tree.nodes)
    side = 1 << up
    lowest = np.floor(places(table) / (tree.edge_m * side)).astype(int) * side
    occupied = {where: leaf for where, leaf in tree.leaves.items() if (leaf.odds or 0.0) >= 0}
    assert len(tree.leaves) == int(answer.headers["Cairn-Points"]) > len(occupied) > 0
    nodes = {tuple(low) for low in lowest.tolist()}
    if form == "bt":
        assert {v for low, edge in occupied for v in nodes_in(low, edge, side)} == nodes
        return
    assert {(low, side) for low in nodes} == occupied.keys()
    for place, point in zip(lowest.tolist(), table, strict=True):
        leaf = tree.leaves[tuple(place), side]
        assert leaf.odds is not None
        assert 1 / (1 + np.exp(-leaf.odds)) == pytest.approx(point["probability"], abs=1e-6)
        rgb = [int(point[name]) for name in ("red", "green", "blue")]
        assert list(leaf.rgb) == rgb or (leaf.rgb == (255,) * 3 and rgb == [128] * 3)
    assert len({leaf.rgb for leaf in tree.leaves.values()}) > 10


def nodes_in(low: tuple[int, ...], edge: int, side: int) -> set[tuple[int, ...]]:
    """Nodes of a leaf that eight or more were joined to."""
    return {tuple(int(v) for v in low + np.array(step) * side) for step in np.ndindex((edge // side,) * 3)}


def test_inner_nodes_of_an_octree_are_as_octomap_makes_them(live: Live) -> None:
    tree = read_tree(ask_export(live, mapped(live), format="ot").content)
    inner = [node for node in tree.nodes if node.children]
    assert len(inner) > len(tree.leaves) / 8
    for node in inner:
        children = list(node.children.values())
        assert node.odds == max(child.odds for child in children if child.odds is not None)
        coloured = [child.rgb for child in children if child.rgb != (255, 255, 255)]
        assert node.rgb == tuple(sum(part) // len(coloured) for part in zip(*coloured, strict=True) if coloured) or (
            not coloured and node.rgb == (255, 255, 255)
        )


def test_white_is_told_from_no_colour() -> None:
    samples = np.zeros((2, SMALL.plane_count), np.int64)
    samples[0, SMALL.planes_of("colour")] = (255, 255, 255, 1)
    evidence = packed_evidence(np.array([3, 4], np.uint32), np.full((2, 2), (3, 0), np.int64), samples, SMALL)
    key = cell_key((0, 0, 0))
    asked = ExportRequest(format="ot")
    found = branch_of_cell(key, evidence, SMALL, SensorModel(), asked)
    assert found is not None
    nodes = tree_of_cells([found[0]], SMALL, SensorModel(), asked)
    tree = read_tree(b"".join(tree_file("ot", nodes, [found[1]], SMALL, "a white voxel and a bare one")))
    assert {low: leaf.rgb for (low, _), leaf in tree.leaves.items()} == {(1, 1, 0): (254,) * 3, (0, 0, 1): (255,) * 3}


@pytest.mark.processes
@pytest.mark.skipif(shutil.which("convert_octree") is None, reason="needs Debian's octomap-tools")
def test_octomaps_own_tools_take_both_and_find_the_same_in_them(live: Live, tmp_path: Path) -> None:
    row = mapped(live)
    for form in ("ot", "bt"):
        (tmp_path / f"lab.{form}").write_bytes(ask_export(live, row, format=form).content)
    said = subprocess.run(
        ["convert_octree", "lab.ot", "own.bt"], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert "WARNING" not in said.stdout + said.stderr
    own, ours = (read_tree((tmp_path / name).read_bytes()) for name in ("own.bt", "lab.bt"))
    assert states_of(own) == states_of(ours)
    assert all(len(voxels) > 20 for voxels in states_of(ours))


def test_an_octree_ends_where_octomaps_ends(live: Live) -> None:
    row = live.new_map()
    far = cell_key((1 << 12, 0, 0))  # 2^15 voxels
    near = cell_key(((1 << 12) - 1, 0, 0))
    cells = {key: surface_evidence(1, SMALL) for key in (near, far)}
    assert live.push(row, pushed(0, 0, cells=cells, scans=1000)).status_code == 201
    live.folded(row)
    answer = ask_export(live, row, format="bt")
    assert kind_of(answer) == "bad_box"
    assert "1638.4 m" in answer.json()["detail"]
    assert "--box=-1638.4," in answer.json()["detail"]
    box = ask_export(live, row, format="bt", box="0,-10,-10,1638.3,10,10")
    assert len(read_tree(box.content).leaves) == int(box.headers["Cairn-Points"]) > 0


def test_unknown_space_is_filled_in_the_box_between_and_beyond_the_cells(live: Live) -> None:
    row = mapped(live)
    edge_m = row.geometry.cell_edge_m
    box = {"box": ",".join(f"{v * edge_m:g}" for v in (-1.3, -0.7, -0.2, 1.8, 2.1, 1.4))}
    seen_occupied, seen_free = states_of(read_tree(ask_export(live, row, format="bt", **box).content))
    for form in ("ot", "bt"):
        answer = ask_export(live, row, format=form, unknown="occupied", **box)
        tree = read_tree(answer.content)
        occupied, free = states_of(tree)
        assert len(tree.leaves) == int(answer.headers["Cairn-Points"])
        assert free == seen_free
        assert occupied > seen_occupied
        low, high = (np.array([v * 8 for v in corner]) for corner in ((-1.3, -0.7, -0.2), (1.8, 2.1, 1.4)))
        counts = np.floor(high - 0.5 + 1e-6) - np.ceil(low - 0.5 - 1e-6) + 1
        assert len(occupied) + len(free) == counts.prod()


@pytest.mark.parametrize("query", [{"format": "bt"}, {"format": "ply", "box": "0,0,0,1,1,1"}])
def test_unknown_space_is_filled_in_a_box_of_an_octree_alone(live: Live, query: dict[str, str]) -> None:
    assert ask_export(live, live.new_map(), unknown="free", **query).status_code == 422


@pytest.mark.parametrize("form", ["laz", "ot", "bt"])
def test_nothing_there_is_an_empty_file(live: Live, form: str) -> None:
    answer = ask_export(live, live.new_map(), format=form)
    assert answer.status_code == 200
    if form == "laz":
        assert len(read_laz(answer.content)) == 0
    else:
        assert read_tree(answer.content).size == 0


@pytest.mark.parametrize("up", [0, 1])
def test_a_band_leaves_what_is_as_hot_and_as_cold(live: Live, up: int) -> None:
    row = mapped(live)
    depth = row.geometry.depth - up
    table = points(ask_export(live, row, format="npz", depth=depth))
    warm = table[np.isfinite(table["temperature"])]
    least, most = (float(end) for end in np.quantile(warm["temperature"], [0.3, 0.7]).round(2))
    for asked, stays in (
        ({"hotter_k": least}, warm["hottest"] >= least - 1e-3),
        ({"colder_k": most}, warm["temperature"] <= most + 1e-3),
        (
            {"hotter_k": least, "colder_k": most},
            (warm["hottest"] >= least - 1e-3) & (warm["temperature"] <= most + 1e-3),
        ),
    ):
        found = points(ask_export(live, row, format="npz", depth=depth, **asked))
        np.testing.assert_array_equal(found, warm[stays])
        assert 0 < len(found) < len(warm) <= len(table)
