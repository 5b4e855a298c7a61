"""`cairn map hotspots`: the same list of a server and of a folder, as lines, JSON, a table and GeoJSON."""

import csv
import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from tests.fixtures.client.served_map import served_map
from tests.fixtures.commands import cairn
from tests.fixtures.map.changing import GEOMETRY, scans

from cairn_map.codec.cell_code import encode_cell
from cairn_map.epochs.epoch import Epoch
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.grid import CellKey, cell_of_key
from cairn_map.files.cell_folder import FolderHead, write_cell, write_head

HITS = 2
HOT, WARM = np.array([[15, y, 3] for y in range(4)]), np.array([[40, 0, 0], [41, 0, 0], [42, 0, 0]])


def cells() -> dict[CellKey, Evidence]:
    """A plate of 330 K, and a strip of 310 K."""
    parts = (scans(HOT, 0, hits=HITS, kelvin=330.0), scans(WARM, 0, hits=HITS, kelvin=310.0))
    return {key: history.rows[Epoch(0)] for part in parts for key, history in part.items()}


@pytest.fixture(scope="module")
def url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with served_map(tmp_path_factory.mktemp("server"), cells(), GEOMETRY, scans=HITS) as url:
        yield url


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    path = tmp_path / "lab"
    write_head(path, FolderHead(geometry=GEOMETRY))
    for key, evidence in cells().items():
        write_cell(path, cell_of_key(key), encode_cell(key, evidence, GEOMETRY).data)
    return path


def test_a_server_and_a_folder_list_the_same_spots(url: str, folder: Path, tmp_path: Path) -> None:
    lines = cairn("map", "hotspots", url, folder=tmp_path).splitlines()
    place = "at 0.78, 0.03, 0.17 m, 4 voxels"
    assert lines[0] == f"  1   56.9 C +- 1.0  {place}  mole, at an unknown time"
    assert lines[1].startswith("  2   36.9 C +- 1.0  at 2.02, 0.03, 0.03 m, 3 voxels")
    assert lines[2] == "2 hot spots"
    assert place in cairn("map", "hotspots", folder, folder=tmp_path)
    found = {
        where: json.loads(cairn("map", "hotspots", where, "--json", folder=tmp_path)) for where in (url, str(folder))
    }
    of_server, of_folder = (
        [{name: value for name, value in spot.items() if name not in ("commit", "captured_s")} for spot in spots]
        for spots in found.values()
    )
    assert of_server == of_folder
    assert found[url][0]["commit"].startswith("mole.")


def test_a_threshold_a_size_a_box_and_a_count_choose(url: str, folder: Path, tmp_path: Path) -> None:
    for where in (url, folder):
        for choice in (("--over", "40"), ("--min-voxels", "4"), ("--box", "0,0,0,1,1,1")):
            assert cairn("map", "hotspots", where, *choice, folder=tmp_path).splitlines()[-1] == "1 hot spots"
        assert cairn("map", "hotspots", where, "--over", "80", folder=tmp_path) == "(nothing is warmer than 80 C)\n"
        assert "bad_range" in cairn("map", "hotspots", where, "--count", "0", folder=tmp_path, code=1)
    assert "1 of 2 hot spots; --count N" in cairn("map", "hotspots", url, "--count", "1", folder=tmp_path)


def test_tables_and_geojson_are_in_metres_of_the_map(url: str, tmp_path: Path) -> None:
    cairn("map", "hotspots", url, "--csv", "spots.csv", folder=tmp_path)
    with (tmp_path / "spots.csv").open(newline="", encoding="utf-8") as file:
        table = list(csv.DictReader(file))
    assert [float(table[0][f"{axis}_m"]) for axis in "xyz"] == [0.775, 0.025, 0.175]
    assert [float(table[0][f"high_{axis}_m"]) for axis in "xyz"] == pytest.approx([0.8, 0.2, 0.2])
    cairn("map", "hotspots", url, "--geojson", "spots.geojson", folder=tmp_path)
    spots = json.loads((tmp_path / "spots.geojson").read_text())
    assert spots["features"][0]["geometry"]["coordinates"] == [0.775, 0.025, 0.175]
    assert "metres" in spots["coordinates"]
