"""One voxel, asked of the server: exact against the cell's own evidence, and whose it is."""

import numpy as np
import pytest
from tests.fixtures.server.live import Live
from tests.fixtures.server.pushes import KEYS, MOLE, WREN, pushed

from cairn_map.codec.cell_code import decode_cell
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.grid import cell_of_key, voxels_in_cell
from cairn_map.evidence.voxels import THERMAL_SIGMA_K, voxels_of_evidence
from cairn_server.store.store_rows import MapRow
from cairn_server.views.voxel_report import ENTRIES_MAX


def asked(live: Live, row: MapRow, voxel: object) -> dict[str, object]:
    answer = live.http.get(f"/maps/{row.name}/main/voxels/{voxel}")
    assert answer.status_code == 200, answer.text
    found: dict[str, object] = answer.json()
    return found


def text_of(row: MapRow, key: int, place: int) -> str:
    return ",".join(map(str, voxels_in_cell(np.array([place], np.uint32), key, row.geometry)[0]))


def test_every_voxel_of_a_cell_is_told_exactly(live: Live) -> None:
    row = live.new_map()
    live.push(row, pushed(0, 0))
    live.push(row, pushed(0, 3, WREN))
    key, body = next(iter(live.cells(row).items()))
    evidence = decode_cell(body).evidence
    voxels = voxels_of_evidence(key, evidence, row.geometry, row.sensor_model, occupied_only=False)
    for n in range(0, len(voxels), 7):
        told = asked(live, row, text_of(row, key, int(evidence.voxels[n])))
        assert [told["hits"], told["misses"]] == voxels.counts[n].tolist()
        p = voxels.probability[n]
        assert told["probability"] == (None if np.isnan(p) else p)
        assert told["centre_m"] == voxels.centres_m[n].tolist()
        for channel in told["channels"]:  # type: ignore[attr-defined]
            reading = voxels.readings[channel["name"]]
            assert channel["weight"] == reading.weight[n]
            assert channel["mean"] == (np.ravel(reading.mean[n]).tolist() if channel["weight"] else [])
            if channel["weight"] and reading.spread is not None:
                assert channel["sigma"] == np.hypot(reading.spread[n], THERMAL_SIGMA_K)


def test_those_who_saw_it_are_told_and_what_was_taken_out_is_not(live: Live) -> None:
    row = live.new_map()
    cells = {KEYS[0]: one_voxel(row)}
    commits = [pushed(0, 0, MOLE, cells=cells), pushed(0, 0, WREN, cells=cells), pushed(1, 0, MOLE, cells=cells)]
    for commit in commits:
        live.push(row, commit)
    live.folded(row)
    live.retract(row, commits[0])
    live.folded(row)
    told = asked(live, row, text_of(row, KEYS[0], 5))
    assert (told["hits"], told["misses"]) == (4, 2)
    assert (
        {(c["id"], c["hits"], c["misses"]) for c in told["commits"]}
        == {  # type: ignore[attr-defined]
            (str(commit.id), 2, 1) for commit in commits[1:]
        }
    )
    assert (told["more"], told["gone"]) == (False, False)
    assert asked(live, row, text_of(row, KEYS[0], 6))["commits"] == []


def test_only_the_newest_commits_are_looked_at(live: Live) -> None:
    row = live.new_map()
    for n in range(ENTRIES_MAX + 2):
        live.push(row, pushed(n, 0, cells={KEYS[0]: one_voxel(row)}))
    live.folded(row)
    told = asked(live, row, text_of(row, KEYS[0], 5))
    assert told["more"] is True
    ids = [commit["id"] for commit in told["commits"]]  # type: ignore[attr-defined]
    assert [int(text.rpartition(".")[2]) for text in ids] == list(range(ENTRIES_MAX + 1, 1, -1))


@pytest.mark.parametrize(
    ("voxel", "kind"),
    [("1,2", "bad_cell"), ("1,2,x", "bad_cell"), ("01,0,0", "bad_cell"), ("9999999999,0,0", "cell_range")],
)
def test_what_is_no_voxel_is_refused(live: Live, voxel: str, kind: str) -> None:
    row = live.new_map()
    assert live.http.get(f"/maps/{row.name}/main/voxels/{voxel}").json()["kind"] == kind


def test_a_voxel_of_a_cell_that_nobody_saw_is_not_there(live: Live) -> None:
    row = live.new_map()
    live.push(row, pushed(0, 0))
    live.folded(row)
    assert cell_of_key(KEYS[0]) == (0, 0, 0)
    assert live.http.get(f"/maps/{row.name}/main/voxels/8000,0,0").json()["kind"] == "no_cell"


def one_voxel(row: MapRow) -> Evidence:
    """Two hits and a miss at place 5, without samples."""
    return Evidence(
        np.array([5], np.uint32),
        np.array([[2, 1]], np.int32),
        np.empty(0, np.uint32),
        np.empty((0, row.geometry.plane_count), np.int64),
    )


def test_a_point_in_metres_is_the_voxel_it_lies_in(live: Live) -> None:
    row = live.new_map()
    live.push(row, pushed(0, 0))
    key, body = next(iter(live.cells(row).items()))
    numbers = text_of(row, key, int(decode_cell(body).evidence.voxels[0]))
    centre = asked(live, row, numbers)["centre_m"]
    assert isinstance(centre, list)
    url = f"/maps/{row.name}/main/voxels"
    for shift_m in (-0.4, 0.0, 0.4):
        at = ",".join(f"{value + shift_m * row.geometry.voxel_edge_m:.6f}" for value in centre)
        assert live.http.get(url, params={"at": at}).json() == asked(live, row, numbers)
    for text, kind in (
        ("1,2", "bad_point"),
        ("a,b,c", "bad_point"),
        ("nan,0,0", "bad_point"),
        ("1e5,0,0", "bad_point"),
    ):
        answer = live.http.get(url, params={"at": text})
        assert (answer.status_code, answer.json()["kind"]) == (400, kind)
    assert live.http.get(url, params={"at": "999999999,0,0"}).status_code == 400
