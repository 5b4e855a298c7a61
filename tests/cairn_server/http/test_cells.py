"""Cells, index, list and log over HTTP."""

import io
import json
import re
import time

import numpy as np
import pytest
from tests.fixtures.map.made import as_dict
from tests.fixtures.server.answers import first_cell_path, kind_of
from tests.fixtures.server.live import Live
from tests.fixtures.server.pushes import MOLE, pushed, sum_of

from cairn_map.codec.cell_code import decode_cell
from cairn_map.commits.commit import make_commit
from cairn_map.commits.cursor import cursor_from_text
from cairn_map.commits.version_vector import version_vector_from_json
from cairn_map.evidence.fingerprint import fingerprint
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_map.files.cell_files import CELL_MEDIA_TYPE
from cairn_map.wire.messages import CellIndex
from cairn_server.store.store_rows import MapRow
from cairn_server.views import cell_views


@pytest.fixture
def row(live: Live) -> MapRow:
    """A map of one commit."""
    made = live.new_map()
    live.push(made, pushed(0, 0))
    live.folded(made)
    return made


def test_a_cell_comes_with_its_cursor_coverage_and_fingerprint(live: Live, row: MapRow) -> None:
    answer = live.http.get(first_cell_path(row))
    decoded = decode_cell(answer.content)
    assert as_dict(decoded.evidence) == sum_of([pushed(0, 0)])[decoded.key]
    assert answer.headers["ETag"] == f'"{decoded.digest.hex()}"'
    assert answer.headers["Content-Type"] == CELL_MEDIA_TYPE
    assert answer.headers["Cairn-Fingerprint"] == fingerprint(decoded.evidence, decoded.key).hex()
    assert cursor_from_text(answer.headers["Cairn-Cursor"]).seq == 1
    assert pushed(0, 0).id in version_vector_from_json(json.loads(answer.headers["Cairn-Coverage"]))


@pytest.mark.parametrize("suffix", ["", ".npz", ".ply"])
@pytest.mark.parametrize("form", ["{}", '"x", {}', "*"])
def test_304_says_by_its_headers_what_200_would(live: Live, row: MapRow, suffix: str, form: str) -> None:
    whole = live.http.get(first_cell_path(row, suffix))
    etag = whole.headers["ETag"]
    same = live.http.get(first_cell_path(row, suffix), headers={"If-None-Match": form.format(etag)})
    assert (same.status_code, same.content) == (304, b"")
    for name in ("ETag", "Cairn-Cursor", "Cairn-Coverage", "Cairn-Fingerprint"):
        assert same.headers[name] == whole.headers[name]


def test_each_form_of_a_cell_has_its_own_etag(live: Live, row: MapRow) -> None:
    etags = [live.http.get(first_cell_path(row, suffix)).headers["ETag"] for suffix in ("", ".npz", ".ply")]
    assert len(set(etags)) == 3
    assert live.http.get(first_cell_path(row, ".ply"), headers={"If-None-Match": etags[0]}).status_code == 200


@pytest.mark.parametrize("suffix", ["", ".npz", ".ply", ".view?depth=2", ".view?depth=3"])
def test_what_another_sensor_model_makes_of_a_cell_has_another_etag(live: Live, row: MapRow, suffix: str) -> None:
    """As of a server that was started again in an empty folder, where robots brought the same evidence."""
    other = live.new_map(sensor_model=SensorModel(p_hit=0.6))
    live.push(other, pushed(0, 0))
    live.folded(other)
    etag = live.http.get(first_cell_path(row, suffix)).headers["ETag"]
    assert live.http.get(first_cell_path(row, suffix), headers={"If-None-Match": etag}).status_code == 304
    elsewhere = live.http.get(first_cell_path(other, suffix), headers={"If-None-Match": etag})
    assert elsewhere.status_code == (200 if suffix else 304)
    assert (elsewhere.headers["ETag"] == etag) == (not suffix)


def test_a_changed_cell_has_another_etag(live: Live, row: MapRow) -> None:
    etag = live.http.get(first_cell_path(row)).headers["ETag"]
    live.push(row, pushed(1, 0))
    live.folded(row)
    assert live.http.get(first_cell_path(row), headers={"If-None-Match": etag}).status_code == 200


@pytest.mark.parametrize("suffix", [".npz", ".ply"])
def test_a_cell_of_too_many_voxels_comes_as_no_file_and_files_are_made_one_by_one(
    live: Live, row: MapRow, suffix: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = first_cell_path(row, suffix)
    assert live.http.get(path).status_code == 200
    monkeypatch.setattr(cell_views, "FILE_VOXELS_MAX", 3)
    answer = live.http.get(path)
    assert (answer.status_code, kind_of(answer)) == (400, "too_costly")
    assert live.http.get(first_cell_path(row)).status_code == 200
    lanes = live.app.state.lanes
    assert lanes.of(path) is not lanes.of(first_cell_path(row))


def test_npz_is_read_by_numpy(live: Live, row: MapRow) -> None:
    decoded = decode_cell(live.http.get(first_cell_path(row)).content)
    with np.load(io.BytesIO(live.http.get(first_cell_path(row, ".npz")).content), allow_pickle=False) as arrays:
        assert np.array_equal(arrays["counts"], decoded.evidence.counts)
        assert arrays["centres_m"].shape == (len(decoded.evidence), 3)


def test_ply_holds_the_vertices_that_its_header_says(live: Live, row: MapRow) -> None:
    answer = live.http.get(first_cell_path(row, ".ply"))
    head, _, body = answer.content.partition(b"end_header\n")
    count = re.search(rb"element vertex (\d+)", head)
    sizes = {b"float": 4, b"uchar": 1, b"int": 4}
    vertex_bytes = sum(sizes[kind] for kind in re.findall(rb"property (\w+) ", head))
    assert head.startswith(b"ply\nformat binary_little_endian 1.0\n")
    assert count
    assert len(body) == int(count[1]) * vertex_bytes
    assert answer.headers["Content-Disposition"].startswith("attachment; ")


@pytest.mark.parametrize("suffix", [".", ".exe", ".ply.ply", ".%0d%0aX: 1", ".%C4%80", ".npz%00"])
@pytest.mark.parametrize("headers", [{}, {"If-None-Match": "*"}])
def test_an_unknown_suffix_is_refused_whatever_is_asked_with_it(
    live: Live, row: MapRow, suffix: str, headers: dict[str, str]
) -> None:
    answer = live.http.get(first_cell_path(row, suffix), headers=headers)
    assert (answer.status_code, kind_of(answer)) == (400, "unknown_format")


@pytest.mark.parametrize("cell", ["0,0", "a,b,c", "0,0,0,0", "00,0,0", "1048576,0,0", "0,0,%D9%A1"])
def test_a_cell_that_cannot_be_is_bad_input_not_absent(live: Live, row: MapRow, cell: str) -> None:
    answer = live.http.get(f"/maps/{row.name}/main/cells/{cell}")
    assert (answer.status_code, kind_of(answer)) in [(400, "bad_cell"), (400, "cell_range")]


def test_the_index_lists_every_touched_cell_from_one_state(live: Live, row: MapRow) -> None:
    live.retract(row, pushed(0, 0))
    live.push(row, pushed(1, 1))
    live.folded(row)
    index = CellIndex.model_validate_json(live.http.get(f"/maps/{row.name}/main/cells?author={MOLE}").content)
    assert len(index.cells) == 3
    assert sorted(cell.voxels > 0 for cell in index.cells) == [False, True, True]
    assert index.header.tip is not None
    assert index.header.tip[0] == 1
    assert index.header.to_cursor.seq == max(cell.lm for cell in index.cells) == 4


def test_the_list_of_maps_tells_extent_and_sizes(live: Live, row: MapRow) -> None:
    info = next(info for info in live.http.get("/maps").json() if info["name"] == row.name)
    assert info == live.http.get(f"/maps/{row.name}").json()
    assert (info["cells"], info["commits"], info["branches"]) == (2, 1, 0)
    edge_m = row.geometry.cell_edge_m
    assert info["box_m"] == [[-edge_m, 0.0, 0.0], [edge_m, edge_m, 3 * edge_m]]


def test_the_log_comes_in_pages_with_capture_times(live: Live, row: MapRow) -> None:
    for n in (1, 2):
        live.push(row, pushed(n, n))
    live.folded(row)
    page = live.http.get(f"/maps/{row.name}/log", params={"after": 1, "limit": 1}).json()
    assert [(entry["seq"], entry["id"], entry["captured_s"]) for entry in page] == [
        (2, str(pushed(1, 1).id), [1.5e9, 1.5e9 + 1])
    ]
    assert live.http.get(f"/maps/{row.name}/log", params={"after": 10**30}).status_code == 422


def test_an_equal_map_is_found_and_another_of_its_name_refused(live: Live, row: MapRow) -> None:
    body = {"geometry": row.geometry.model_dump(mode="json")}
    assert live.http.put(f"/maps/{row.name}", json=body).status_code == 200
    other = live.http.put(f"/maps/{row.name}", json={"geometry": {"voxel_edge_um": 10_000}})
    assert (other.status_code, kind_of(other)) == (409, "map_exists")


def test_log_entries_tell_their_parent_and_what_their_author_had_seen(live: Live) -> None:
    made = live.new_map()
    first = pushed(0, 0)
    seen = live.http.get(f"/maps/{made.name}").json()["cursor"]
    meta = pushed(1, 1).meta.model_copy(update={"parent": first.sha.hex(), "seen": seen})
    for commit in (first, make_commit(meta, {}, made.geometry)):
        live.push(made, commit)
    live.push(made, make_commit(meta.model_copy(update={"retracts": (str(first.id),)}), {}, made.geometry))
    live.folded(made)
    entries = live.http.get(f"/maps/{made.name}/log", headers={"Cairn-Format": "5"}).json()
    assert [(entry["parent"], entry["seen"]) for entry in entries][:2] == [(None, None), (first.sha.hex(), seen)]
    assert [entry["place_m"] for entry in entries] == [[0.0, 0.0, 0.4]] * len(entries)
    assert all(abs(entry["pushed_s"] - time.time()) < 600 for entry in entries), "when the server received each"
    assert all(entry["pushed_utc"].endswith("Z") for entry in entries)
    for entry in live.http.get(f"/maps/{made.name}/log", headers={"Cairn-Format": "4"}).json():
        assert not {"pushed_s", "pushed_utc"} & entry.keys(), "which clients of before refuse"
