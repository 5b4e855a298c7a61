"""`cairn map create --from DIR`: whatever is in the folder, the map has all of it, or there is no map."""

import os
from collections.abc import Callable, Iterator
from itertools import count
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.fixtures.client.live_server import LiveServer
from tests.fixtures.client.made import GEOMETRY, seen

from cairn_client.cli.maps.create import push_prior_data
from cairn_client.http.api import MapApi
from cairn_client.main import main
from cairn_map.codec.cell_code import encode_cell
from cairn_map.errors import BadInputError, CairnError, DamagedDataError, NotFoundError
from cairn_map.evidence.evidence import packed_evidence
from cairn_map.evidence.grid import Cell, cell_key
from cairn_map.files.cell_folder import FolderHead, read_cells, read_head, write_cell, write_head

CELLS = [Cell(0, 0, 0), Cell(-1, 0, 2), *(Cell(n, 5, -5) for n in range(18))]
"""More than one commit's."""
FIRST = "0_0_0.cell"
Damage = Callable[[Path], None]


def body_of(cell: Cell, *places: int) -> bytes:
    return encode_cell(cell_key(cell), seen(*places, kelvin_steps=7), GEOMETRY).data


def write_folder(folder: Path) -> Path:
    write_head(folder, FolderHead(geometry=GEOMETRY))
    for n, cell in enumerate(CELLS):
        write_cell(folder, cell, body_of(cell, n, n + 20))
    return folder


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """Files of a sound folder by their names."""
    folder = write_folder(tmp_path_factory.mktemp("sound"))
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.fixture(scope="module")
def api(tmp_path_factory: pytest.TempPathFactory) -> Iterator[MapApi]:
    live = LiveServer(tmp_path_factory.mktemp("server"))
    with MapApi(live.url) as api:
        yield api
    live.stop()


@st.composite
def damaged(draw: st.DrawFn, data: bytes) -> bytes:
    """Bytes with one to three faults."""
    for _ in range(draw(st.integers(1, 3))):
        at = draw(st.integers(0, max(len(data) - 1, 0)))
        fault = draw(st.sampled_from(["cut", "change", "insert", "twice", "other"]))
        if fault == "cut":
            data = data[:at]
        elif fault == "change":
            data = data[:at] + draw(st.binary(min_size=1, max_size=4)) + data[at + 1 :]
        elif fault == "insert":
            data = data[:at] + draw(st.binary(max_size=20)) + data[at:]
        elif fault == "twice":
            data = data + data[at:]
        else:
            data = draw(st.binary(max_size=100))
    return data


@pytest.mark.slow
@settings(max_examples=30)
@given(st.data())
def test_a_damaged_folder_gives_the_whole_map_or_none(
    tmp_path_factory: pytest.TempPathFactory, sound: dict[str, bytes], api: MapApi, data: st.DataObject
) -> None:
    folder = tmp_path_factory.mktemp("damaged")
    files = dict(sound)
    for name in data.draw(st.lists(st.sampled_from(sorted(sound)), min_size=1, max_size=2, unique=True)):
        files[name] = data.draw(damaged(files[name]))
    if data.draw(st.integers(0, 3)) == 0:
        a, b = data.draw(st.lists(st.sampled_from(sorted(sound)), min_size=2, max_size=2, unique=True))
        files[a], files[b] = files[b], files[a]
    for name, body in files.items():
        (folder / name).write_bytes(body)
    check_all_or_none(folder, api)


NAMES = count()


def check_all_or_none(folder: Path, api: MapApi) -> CairnError | None:
    """Create a map from a folder: all its cells are in it or, with the error that comes back, there is no map."""
    name = f"map{next(NAMES)}"
    try:
        _, cells, added = push_prior_data(api, name, str(folder))
    except CairnError as exc:
        assert str(folder) in exc.message
        with pytest.raises(NotFoundError):
            api.map_info(name)
        return exc
    assert cells == added == len(list(read_cells(folder, read_head(folder).layer)))
    return None


def link_to_itself(path: Path) -> None:
    path.unlink()
    path.symlink_to(path)


def pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def folder_of(path: Path) -> None:
    path.unlink()
    path.mkdir()


STRANGE: dict[str, Damage] = {
    "a pipe": pipe,
    "a folder": folder_of,
    "a link to itself": link_to_itself,
    "empty": lambda path: os.truncate(path, 0),
    "too large": lambda path: os.truncate(path, 1 << 29),
}


@pytest.mark.parametrize("name", [FIRST, "17_5_-5.cell", "map.json"])
@pytest.mark.parametrize("strange", STRANGE)
def test_what_is_no_file_of_a_cell_is_refused_by_its_name(tmp_path: Path, api: MapApi, strange: str, name: str) -> None:
    folder = write_folder(tmp_path)
    STRANGE[strange](folder / name)
    found = check_all_or_none(folder, api)
    assert isinstance(found, BadInputError | DamagedDataError)
    assert name in found.message


@pytest.mark.parametrize("name", ["00_0_0.cell", "-0_0_0.cell", "0_0_000.cell", "9999999_0_0.cell"])
def test_a_cell_under_a_second_name_is_not_added_twice(tmp_path: Path, api: MapApi, name: str) -> None:
    folder = write_folder(tmp_path)
    (folder / name).write_bytes((folder / FIRST).read_bytes())
    found = check_all_or_none(folder, api)
    assert found is not None
    assert name in found.message


def test_evidence_that_no_server_takes_leaves_no_map(tmp_path: Path, api: MapApi) -> None:
    folder = write_folder(tmp_path)
    less = packed_evidence(np.array([3], np.uint32), np.array([[-1, 0]]), np.zeros((1, 3), np.int64), GEOMETRY)
    write_cell(folder, CELLS[-1], encode_cell(cell_key(CELLS[-1]), less, GEOMETRY).data)
    assert check_all_or_none(folder, api) is not None


def test_a_grid_beside_a_source_is_that_of_the_source_or_refused_with_both(
    tmp_path: Path, api: MapApi, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, name = write_folder(tmp_path), f"map{next(NAMES)}"
    create = ["map", "create", f"{api.origin}/maps/{name}", "--from", str(folder)]
    for asked in (["--voxel", "0.02"], ["--channels", ""]):
        assert main([*create, *asked]) == 1
        assert f"the source of --from has {GEOMETRY}" in capsys.readouterr().err
    with pytest.raises(NotFoundError):
        api.map_info(name)
    assert main([*create, "--voxel", f"{GEOMETRY.voxel_edge_m}"]) == 0
    assert api.map_info(name).geometry == GEOMETRY


def test_other_files_of_a_folder_are_left_alone(tmp_path: Path, api: MapApi) -> None:
    folder = write_folder(tmp_path)
    for name in ("README.md", "0_0_0.cell.new", "0_0_0.CELL", "x.cell"):
        (folder / name).write_bytes(b"x")
    assert check_all_or_none(folder, api) is None


@pytest.mark.parametrize(
    ("name", "kind"),
    [("lab.bt", "an OctoMap octree"), ("lab.PLY", "a point cloud"), ("0_0_0.cell", "one cell"), ("lab.zip", "a file")],
)
def test_any_other_file_is_refused_by_its_kind_with_what_can_be_given(
    api: MapApi, tmp_path: Path, name: str, kind: str
) -> None:
    path = tmp_path / name
    path.write_bytes(b"# Octomap OcTree binary file")
    with pytest.raises(BadInputError, match=f"{name} is {kind}.*export --cells DIR.*URL.*replay") as refused:
        push_prior_data(api, "lab-of-files", str(path))
    assert refused.value.kind == "no_map_folder"
    with pytest.raises(NotFoundError):
        api.map_info("lab-of-files")
