"""OctoMap files: occupied, free and unknown space of a map, voxel for voxel, by OctoMap's own tools where they are."""

import shutil
import subprocess
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.fixtures.map.made import PLAIN, SMALL, random_evidence, surface_evidence
from tests.fixtures.map.octomap_files import Cells, known_states, octomap_file
from tests.naive.octomap import read_tree, states_of

from cairn_map.errors import BadInputError
from cairn_map.evidence.evidence import Evidence, packed_evidence
from cairn_map.evidence.grid import Geometry, cell_key
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_map.files import octomap
from cairn_map.files.export_request import ExportRequest
from cairn_map.files.octomap import cells_at_border

CELLS = [(0, 0, 0), (0, 0, 1), (1, 0, 0), (-1, -1, -1), (-1, 2, 0)]
needs_octomap = pytest.mark.skipif(shutil.which("convert_octree") is None, reason="needs Debian's octomap-tools")


def made_cells(geometry: Geometry, seed: int) -> Cells:
    """Cells with a surface, scattered voxels, and some that are free as a whole."""
    made = [
        surface_evidence(seed, geometry),
        random_evidence(seed, geometry),
        all_free(geometry),
        all_free(geometry),
        random_evidence(seed + 1, geometry),
    ]
    return {cell_key(cell): evidence for cell, evidence in zip(CELLS, made, strict=True)}


def all_free(geometry: Geometry) -> Evidence:
    places = np.arange(8**geometry.depth, dtype=np.uint32)
    counts = np.full((len(places), 2), (0, 9))
    return packed_evidence(places, counts, np.zeros((len(places), geometry.plane_count), np.int64), geometry)


@st.composite
def requests(draw: st.DrawFn, geometry: Geometry) -> ExportRequest:
    """A part of `made_cells`, with borders on and between the borders of voxels, nodes and cells."""
    edge_m = geometry.voxel_edge_m
    box = None
    if draw(st.booleans()):
        low = [draw(st.integers(-3 * geometry.side, 5 * geometry.side // 2)) * edge_m / 4 for _ in range(3)]
        sizes = [draw(st.integers(0, 5 * geometry.side)) * edge_m / 4 for _ in range(3)]
        box = ",".join(repr(round(v, 6)) for v in (*low, *(a + s for a, s in zip(low, sizes, strict=True))))
    return ExportRequest(
        format=draw(st.sampled_from(["ot", "bt"])),
        box=box,
        p=draw(st.sampled_from([0.0, 0.75])),
        depth=draw(st.sampled_from([None, geometry.depth, geometry.depth - 1, 1])),
        unknown=draw(st.sampled_from([None, "free", "occupied"])) if box else None,
    )


@settings(max_examples=30)
@given(data=st.data(), seed=st.integers(0, 9), geometry=st.sampled_from([SMALL, PLAIN]))
def test_a_file_holds_the_occupied_and_the_free_voxels_and_no_others(
    data: st.DataObject, seed: int, geometry: Geometry
) -> None:
    cells, asked = made_cells(geometry, seed), data.draw(requests(geometry))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(octomap, "BLOCK_DEPTH", data.draw(st.sampled_from([1, 2, 6])))
        file, leaves = octomap_file(cells, geometry, asked)
    tree = read_tree(file)
    assert states_of(tree) == known_states(cells, geometry, asked)
    assert leaves == len(tree.leaves)
    assert tree.size == len(tree.nodes)
    for node in tree.nodes:
        below = list(node.children.values())
        is_joinable = len(below) == 8 and not any(child.children for child in below)
        assert not is_joinable or len({(child.odds, child.rgb) for child in below}) > 1


@pytest.mark.parametrize("form", ["ot", "bt"])
def test_free_space_of_whole_cells_is_joined_above_the_cells(form: str) -> None:
    cells = {cell_key(cell): all_free(SMALL) for cell in product((0, 1), repeat=3)}
    tree = read_tree(octomap_file(cells, SMALL, ExportRequest.model_validate({"format": form}))[0])
    assert list(tree.leaves) == [((0, 0, 0), 2 * SMALL.side)]


@pytest.mark.parametrize("p_occupied", [0.3, 0.5, 0.8])
def test_octomaps_threshold_finds_the_states_of_any_sensor_model(p_occupied: float) -> None:
    model, asked = SensorModel(p_occupied=p_occupied), ExportRequest(format="ot")
    places = np.arange(64, dtype=np.uint32)
    samples = np.zeros((64, SMALL.plane_count), np.int64)
    cells = {cell_key((0, 0, 0)): packed_evidence(places, np.stack([places % 8, places // 8], axis=1), samples, SMALL)}
    tree = read_tree(octomap_file(cells, SMALL, asked, model)[0])
    assert states_of(tree) == known_states(cells, SMALL, asked, model)


def test_a_tree_is_coloured_where_anything_is() -> None:
    bare, coloured = ({cell_key((0, 0, 0)): surface_evidence(1, geometry)} for geometry in (PLAIN, SMALL))
    assert b"\nid OcTree\n" in octomap_file(bare, PLAIN, ExportRequest(format="ot"))[0]
    assert b"\nid ColorOcTree\n" in octomap_file(coloured, SMALL, ExportRequest(format="ot"))[0]


def test_unknown_space_is_not_filled_beyond_octomaps_tree() -> None:
    asked = ExportRequest(format="bt", box="-1600,0,0,1700,1,1", unknown="free")
    with pytest.raises(BadInputError, match=r"--box=-1638.4,-1638.4,-1638.4,1638.4,1638.4,1638.4"):
        octomap_file({}, SMALL, asked)


def test_a_border_of_too_many_cells_is_refused() -> None:
    asked = ExportRequest(format="bt", box="-900,-900,0,900,900,9", unknown="free")
    with pytest.raises(BadInputError, match="smaller") as refused:
        cells_at_border(SMALL, SensorModel(), asked)
    assert refused.value.kind == "too_large"


@pytest.mark.processes
@needs_octomap
@pytest.mark.parametrize("geometry", [SMALL, PLAIN], ids=["coloured", "plain"])
@pytest.mark.parametrize("unknown", [None, "occupied"])
def test_octomap_reads_both_files_and_writes_the_same(geometry: Geometry, unknown: str | None, tmp_path: Path) -> None:
    cells, edge_m = made_cells(geometry, 1), geometry.cell_edge_m
    box = f"{-edge_m},{-edge_m},{-edge_m / 3},{1.4 * edge_m},{edge_m},{edge_m}" if unknown else None
    asked = ExportRequest.model_validate({"format": "ot", "box": box, "unknown": unknown})
    for form in ("ot", "bt"):
        asked = asked.model_copy(update={"format": form})
        (tmp_path / f"map.{form}").write_bytes(octomap_file(cells, geometry, asked)[0])
        output = subprocess.run(
            ["convert_octree", f"map.{form}", f"{form}.bt"], cwd=tmp_path, capture_output=True, text=True, check=True
        )
        assert "WARNING" not in output.stdout + output.stderr
        assert "ERROR" not in output.stdout + output.stderr
    ours = (tmp_path / "map.bt").read_bytes()
    for form in ("ot", "bt"):
        own = (tmp_path / f"{form}.bt").read_bytes()
        assert states_of(read_tree(own)) == known_states(cells, geometry, asked)
        assert own.partition(b"data\n")[2] == ours.partition(b"data\n")[2]
