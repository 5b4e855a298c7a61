"""A cell that is damaged at rest: healed from the log unseen; or said to be damaged, it alone, through every door."""

from pathlib import Path

import pytest
from tests.fixtures.server.answers import cell_path, kind_of
from tests.fixtures.server.damage import BROKEN, SOUND, broken_map, damage
from tests.fixtures.server.live import Live, until
from tests.fixtures.server.pushes import KEYS, MOLE, pushed, read, sum_of
from tests.naive.asker import NaiveAsker

from cairn_map.evidence.grid import CellKey
from cairn_map.wire.frames import CellFrame, FrameKind, frames_of
from cairn_map.wire.messages import Done
from cairn_server.folding.cells_at_rest import check_stored
from cairn_server.store.sqlite.store import FILE_NAME
from cairn_server.store.store_rows import MapRow

SUFFIXES = ("", ".npz", ".ply", ".view")


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_cell_damaged_for_good_is_500_and_its_neighbour_200(live: Live, suffix: str) -> None:
    row = broken_map(live, keep_diffs=False)
    answer = live.http.get(cell_path(row, BROKEN, suffix))
    assert (answer.status_code, kind_of(answer)) == (500, "damaged_store")
    assert "restore a backup" in answer.json()["detail"]
    assert live.http.get(cell_path(row, BROKEN, suffix), headers={"If-None-Match": "*"}).status_code == 500
    assert live.http.get(cell_path(row, SOUND, suffix)).status_code == 200
    assert live.http.get(cell_path(row, KEYS[2], suffix)).status_code == 404


def test_an_answer_to_missing_brings_all_other_cells_and_names_the_damaged_one(live: Live) -> None:
    row = broken_map(live, keep_diffs=False)
    frames = frames_of(live.http.post(f"/maps/{row.name}/branches/mole/missing", json={}).content)
    cells = {frame.cell: frame for frame in frames if isinstance(frame, CellFrame)}
    assert {frame.kind for frame in cells.values()} == {FrameKind.FULL}
    assert cells[BROKEN].payload == b""
    assert cells[SOUND].payload == live.http.get(cell_path(row, SOUND)).content
    assert isinstance(frames[-1], Done)


def test_other_maps_are_served_and_folded(live: Live) -> None:
    row, other = broken_map(live, keep_diffs=False), live.new_map()
    live.service._fold_thread._local._caches.clear()  # the folder still knows the cell, and would write it again
    assert live.push(row, pushed(1, 0)).status_code == 201
    live.push(other, pushed(0, 0))
    live.folded(other)
    assert live.http.get(cell_path(other, BROKEN)).status_code == 200
    assert live.http.get(cell_path(row, SOUND)).status_code == 200
    assert live.http.get("/readyz").status_code == 200
    assert live.pending(row) == 1
    until(lambda: live.service.readiness._folds.held_up() == {row.name}, "the fold of the damaged map failed")


def body_of(key: CellKey) -> bytes:
    """The cell as a robot still has it: the one commit's own diff."""
    return pushed(0, 0).cells[key]


def test_whoever_still_has_a_damaged_cell_heals_it_and_folding_goes_on(live: Live) -> None:
    row = broken_map(live, keep_diffs=False)
    live.service._fold_thread._local._caches.clear()
    live.push(row, pushed(1, 0))
    until(lambda: live.service.readiness._folds.held_up() >= {row.name}, "the fold of the damaged map failed")
    wrong = live.http.put(cell_path(row, BROKEN), content=pushed(0, 0, scans=7).cells[SOUND])
    assert (wrong.status_code, kind_of(wrong)) == (400, "bad_cell")
    other = live.http.put(cell_path(row, BROKEN), content=pushed(5, 2).cells[BROKEN])
    assert (other.status_code, kind_of(other)) == (409, "other_cell")
    assert live.http.put(cell_path(row, BROKEN), content=b"no cell").status_code == 400
    assert live.http.get(cell_path(row, BROKEN)).status_code == 500
    assert live.http.put(cell_path(row, BROKEN), content=body_of(BROKEN)).status_code == 204
    lines = live.http.get("/audit", params={"limit": 1000}).json()
    assert ("local", "healed_cell") in {(line["who"], line["what"]) for line in lines}
    live.folded(row)
    assert read(live.cells(row)) == sum_of([pushed(0, 0), pushed(1, 0)])


def test_a_sound_cell_cannot_be_put_and_an_unseen_one_is_absent(live: Live) -> None:
    row = live.new_map()
    live.push(row, pushed(0, 0))
    live.folded(row)
    before = live.http.get(cell_path(row, BROKEN)).content
    for body in (b"x", body_of(SOUND), pushed(5, 2).cells[BROKEN]):
        assert live.http.put(cell_path(row, BROKEN), content=body).status_code == 204
    assert live.http.get(cell_path(row, BROKEN)).content == before
    assert live.http.put(cell_path(row, KEYS[2]), content=body_of(SOUND)).status_code == 404


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_damaged_cell_whose_commits_are_kept_is_served_as_if_nothing_were(live: Live, suffix: str) -> None:
    row, sound = broken_map(live, keep_diffs=True), live.new_map()
    live.push(sound, pushed(0, 0))
    live.folded(sound)
    healed, expected = live.http.get(cell_path(row, BROKEN, suffix)), live.http.get(cell_path(sound, BROKEN, suffix))
    assert (healed.status_code, healed.content) == (200, expected.content)
    assert healed.headers["ETag"] == expected.headers["ETag"]
    assert_sound_at_rest(live, row)


def assert_sound_at_rest(live: Live, row: MapRow) -> None:
    with live.service.store.snapshot(row) as snapshot:
        stored = snapshot.cell(BROKEN)
    assert stored
    check_stored(stored, row.layer)


def test_missing_heals_too(live: Live) -> None:
    row = broken_map(live, keep_diffs=True)
    asker = NaiveAsker(MOLE)
    answer = live.http.post(f"/maps/{row.name}/branches/mole/missing", json=asker.request().model_dump())
    assert asker.take(frames_of(answer.content))
    assert asker.map() == sum_of([pushed(0, 0)])
    assert_sound_at_rest(live, row)


def test_pages_that_the_disk_damaged_are_a_damaged_cell(tmp_path: Path) -> None:
    with Live(tmp_path) as live:
        row = live.new_map()
        live.push(row, pushed(0, 0))
        live.folded(row)
        damage(live, "UPDATE cell SET body = zeroblob(200000) WHERE cell = ?", BROKEN)
        damage(live, "UPDATE diff SET body = NULL WHERE cell = ?", BROKEN)
    path = tmp_path / FILE_NAME
    data = bytearray(path.read_bytes())
    # An overflow page of the blob is all zeros but for the number of the next one: point it out of the file.
    pages = [
        at for at in range(0, len(data), 16384) if data[at + 4 : at + 16384] == bytes(16380) and any(data[at : at + 4])
    ]
    assert pages
    for at in pages:
        data[at : at + 4] = b"\xff\xff\xff\x00"
    path.write_bytes(data)
    with Live(tmp_path) as live:
        row = live.service.store.map("map0")
        answer = live.http.get(cell_path(row, BROKEN))
        assert (answer.status_code, kind_of(answer)) == (500, "damaged_store")
        assert live.http.get(cell_path(row, SOUND)).status_code == 200
        frames = frames_of(live.http.post(f"/maps/{row.name}/branches/mole/missing", json={}).content)
        assert sum(bool(frame.payload) for frame in frames if isinstance(frame, CellFrame)) == 1
