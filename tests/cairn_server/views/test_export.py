"""`GET .../main/export`: exactly the nodes that are asked for, in files that others read, made while they are sent."""

import tracemalloc
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from tests.fixtures.map.made import PLAIN
from tests.fixtures.server.answers import kind_of
from tests.fixtures.server.damage import broken_map
from tests.fixtures.server.exports import ask_export, mapped, places, points
from tests.fixtures.server.live import Live

from cairn_map.codec.cell_code import decode_cell
from cairn_map.evidence.grid import CellKey
from cairn_map.evidence.voxels import joined_voxels, voxels_of_evidence
from cairn_map.files.export_request import ExportRequest
from cairn_map.files.point_clouds import PCD_POINT, POINT, found_in_cell
from cairn_server.store.store_rows import MapRow
from cairn_server.views import map_exports


def expected(live: Live, row: MapRow) -> Any:
    parts = [
        voxels_of_evidence(CellKey(key), decode_cell(body).evidence, row.geometry, row.sensor_model, occupied_only=True)
        for key, body in live.cells(row).items()
    ]
    return joined_voxels(parts)


def test_all_of_it_is_every_occupied_voxel(live: Live) -> None:
    row = mapped(live)
    table, voxels = points(ask_export(live, row, format="npz")), expected(live, row)
    order, other = np.lexsort(places(table).T), np.lexsort(voxels.centres_m.T)
    np.testing.assert_allclose(places(table)[order], voxels.centres_m[other], atol=1e-5)
    np.testing.assert_allclose(table["probability"][order], voxels.probability[other], atol=5e-4)
    heat = voxels.readings["temperature"].mean[other]
    np.testing.assert_allclose(table["temperature"][order], heat, atol=0.006)
    assert len(table) > 20
    assert np.isfinite(heat).any()


def test_a_box_two_heights_and_a_probability_leave_what_lies_within(live: Live) -> None:
    row = mapped(live)
    voxels = expected(live, row)
    low, high = np.quantile(voxels.centres_m, [0.2, 0.8], axis=0).round(2)
    floor_m, ceiling_m = (float(end) for end in np.quantile(voxels.centres_m[:, 2], [0.3, 0.6]).round(2))
    box = ",".join(map(str, [*low, *high]))
    p = 0.8
    asked = ask_export(live, row, format="npz", box=box, floor_m=floor_m, ceiling_m=ceiling_m, p=p)
    z = voxels.centres_m[:, 2]
    inside = ((voxels.centres_m >= low) & (voxels.centres_m <= high)).all(axis=1) & (z >= floor_m) & (z <= ceiling_m)
    inside &= np.rint(voxels.probability * 255) / 255 >= p
    assert 0 < inside.sum() < len(voxels)
    assert len(points(asked)) == inside.sum()


def test_a_coarser_level_covers_the_same_space(live: Live) -> None:
    row = mapped(live)
    voxels, depth = expected(live, row), row.geometry.depth - 1
    table = points(ask_export(live, row, format="npz", depth=depth))
    edge_m = 2 * row.geometry.voxel_edge_m
    found = {tuple(place) for place in np.floor(places(table) / edge_m).astype(int).tolist()}
    assert found == {tuple(place) for place in np.floor_divide(voxels.numbers, 2).tolist()}
    assert len(found) == len(table)


def test_ply_and_pcd_say_the_same_as_the_arrays(live: Live) -> None:
    row = mapped(live)
    table = points(ask_export(live, row, format="npz"))
    ply, pcd = ask_export(live, row, format="ply"), ask_export(live, row, format="pcd")
    for answer in (ply, pcd):
        assert int(answer.headers["Content-Length"]) == len(answer.content)
        assert f'filename="{row.name}.' in answer.headers["Content-Disposition"]
    head, _, body = ply.content.partition(b"end_header\n")
    assert f"element vertex {len(table)}\n".encode() in head
    assert [line.split()[2] for line in head.decode().splitlines() if line[:8] == "property"] == list(POINT.names or ())
    assert body == table.tobytes()
    head, _, body = pcd.content.partition(b"DATA binary\n")
    assert f"POINTS {len(table)}\n".encode() in head
    rows: npt.NDArray[np.void] = np.frombuffer(body, PCD_POINT)
    np.testing.assert_array_equal(rows["hottest"], table["hottest"])
    rgb = rows["rgb"].copy().view(np.uint32)
    np.testing.assert_array_equal(rgb, table["red"].astype(int) << 16 | table["green"].astype(int) << 8 | table["blue"])


def test_nothing_there_is_an_empty_file(live: Live) -> None:
    row = live.new_map(PLAIN)
    for form in ("ply", "pcd"):
        assert ask_export(live, row, format=form).status_code == 200
    assert len(points(ask_export(live, row, format="npz"))) == 0


@pytest.mark.parametrize(
    ("query", "kind"),
    [
        ({"box": "1,2,3"}, "bad_box"),
        ({"box": "0,0,0,1,nan,1"}, "bad_box"),
        ({"box": "1,0,0,0,1,1"}, "bad_box"),
        ({"depth": 60}, "bad_style"),
        ({"format": "las"}, "bad_message"),
        ({"p": 2}, "bad_message"),
        ({"colour": 1}, "bad_message"),
    ],
)
def test_what_cannot_be_asked_is_refused(live: Live, query: dict[str, Any], kind: str) -> None:
    assert kind_of(ask_export(live, mapped(live), **query)) == kind


def test_a_damaged_cell_is_not_left_out(live: Live) -> None:
    row = broken_map(live, keep_diffs=False)
    assert kind_of(ask_export(live, row)) == "damaged_store"


def test_an_export_holds_one_cell_at_a_time(live: Live) -> None:
    row = mapped(live)
    made = live.service.views.exports.asked(row, ExportRequest(format="pcd"))
    assert made.size_bytes is not None
    tracemalloc.start()
    sizes = [len(part) for part in made.parts]
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert len(sizes) > 2
    assert sum(sizes) == made.size_bytes
    assert max(sizes) < made.size_bytes / 2
    assert peak < 100 * max(sizes) + (8 << 20)


def test_compiling_kernels_is_no_part_of_an_exports_time(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    row, now_s, looked = mapped(live), [0.0], list[int]()

    def slow_on(cell: int) -> None:
        def found(*args: Any) -> Any:
            looked.append(0)
            now_s[0] += 2 * map_exports.COUNT_S if len(looked) == cell else 0.0
            return found_in_cell(*args)

        looked.clear()
        monkeypatch.setattr(map_exports, "found_in_cell", found)

    monkeypatch.setattr(map_exports, "time", SimpleNamespace(monotonic=lambda: now_s[0]))
    slow_on(1)
    assert ask_export(live, row, format="npz").status_code == 200 and len(looked) > 2
    slow_on(2)
    answer = ask_export(live, row, format="npz")
    assert (answer.status_code, kind_of(answer)) == (400, "too_costly")
