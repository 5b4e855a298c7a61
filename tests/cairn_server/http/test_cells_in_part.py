"""Cells in part: coarser, by ranges of bytes, without body, of a box; and coverage that is too long for a header."""

import hashlib
from typing import Any

import httpx
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.fixtures.server.answers import first_cell_path, kind_of
from tests.fixtures.server.crowded_map import add_commits
from tests.fixtures.server.live import Live
from tests.fixtures.server.pushes import KEYS, MOLE, WREN, pushed

from cairn_client.http.api import MapApi
from cairn_map.codec.cell_code import decode_cell
from cairn_map.codec.view_code import encode_view
from cairn_map.commits.cursor import Cursor, cursor_from_text
from cairn_map.commits.ids import Author, CommitId, Incarnation, RobotName
from cairn_map.commits.version_vector import VersionVector, version_vector_from_json
from cairn_map.errors import BadInputError, DamagedDataError
from cairn_map.evidence.grid import cell_key, cell_of_key
from cairn_map.evidence.view import ViewStyle
from cairn_map.files.cell_files import CELL_MEDIA_TYPE, MEDIA_TYPES
from cairn_map.wire.messages import CellIndex
from cairn_server.http.routes.cell import COVERAGE_BYTES_MAX, part_of
from cairn_server.store.store_rows import MapRow

SAID = ("ETag", "Cairn-Cursor", "Cairn-Coverage", "Cairn-Fingerprint", "Accept-Ranges")


@pytest.fixture(scope="module")
def row(live: Live) -> MapRow:
    """A map of two commits."""
    made = live.new_map()
    for n in range(2):
        live.push(made, pushed(n, n))
    live.folded(made)
    return made


@pytest.mark.parametrize("suffix", ["", ".view"])
def test_a_depth_answers_the_view_of_that_depth(live: Live, row: MapRow, suffix: str) -> None:
    whole = decode_cell(live.http.get(first_cell_path(row)).content)
    etags = {live.http.get(first_cell_path(row, suffix)).headers["ETag"]}
    for depth in range(1, row.geometry.depth + 1):
        answer = live.http.get(first_cell_path(row, suffix), params={"depth": depth})
        style = ViewStyle(depth=depth)
        expected = encode_view(whole.key, whole.evidence, row.geometry, row.sensor_model, style=style)
        assert answer.content == expected
        assert answer.headers["Content-Type"] == MEDIA_TYPES["view"]
        assert all(name in answer.headers for name in SAID)
        etags.add(answer.headers["ETag"])
        same = {"If-None-Match": answer.headers["ETag"]}
        assert live.http.get(first_cell_path(row, suffix), params={"depth": depth}, headers=same).status_code == 304
    assert len(etags) == row.geometry.depth + 1


@pytest.mark.parametrize(
    ("suffix", "depth", "status", "kind"),
    [
        ("", 0, 422, "bad_message"),
        ("", 60, 400, "bad_style"),
        (".view", 10**30, 422, "bad_message"),
        (".npz", 1, 400, "unknown_format"),
        (".ply", 1, 400, "unknown_format"),
    ],
)
def test_a_depth_that_cannot_be_is_refused(
    live: Live, row: MapRow, suffix: str, depth: int, status: int, kind: str
) -> None:
    answer = live.http.get(first_cell_path(row, suffix), params={"depth": depth})
    assert (answer.status_code, kind_of(answer)) == (status, kind)


@pytest.mark.parametrize("suffix", ["", ".npz", ".view"])
def test_a_cell_in_two_ranges_is_the_cell(live: Live, row: MapRow, suffix: str) -> None:
    whole = live.http.get(first_cell_path(row, suffix))
    middle = len(whole.content) // 2
    parts = b""
    for asked, said in (
        (f"bytes=0-{middle - 1}", f"bytes 0-{middle - 1}/{len(whole.content)}"),
        (f"bytes={middle}-", f"bytes {middle}-{len(whole.content) - 1}/{len(whole.content)}"),
    ):
        headers = {"Range": asked, "If-Range": whole.headers["ETag"]}
        answer = live.http.get(first_cell_path(row, suffix), headers=headers)
        assert (answer.status_code, answer.headers["Content-Range"]) == (206, said)
        assert {name: answer.headers[name] for name in SAID} == {name: whole.headers[name] for name in SAID}
        parts += answer.content
    assert parts == whole.content


@pytest.mark.parametrize(
    "headers",
    [
        {"Range": "bytes=0-1,3-4"},
        {"Range": "bytes=5-2"},
        {"Range": "bytes=-"},
        {"Range": "bytes=x-"},
        {"Range": "lines=0-1"},
        {"Range": "bytes=0-1," * 500},
        {"Range": "bytes=0-1", "If-Range": '"another"'},
        {"Range": "bytes=0-1", "If-Range": "Sat, 21 Nov 2026 09:00:00 GMT"},
    ],
)
def test_what_is_no_single_range_of_this_cell_is_answered_whole(
    live: Live, row: MapRow, headers: dict[str, str]
) -> None:
    answer = live.http.get(first_cell_path(row), headers=headers)
    assert (answer.status_code, answer.content) == (200, live.http.get(first_cell_path(row)).content)
    assert "Content-Range" not in answer.headers


def test_a_range_behind_the_end_is_416_and_a_known_cell_304(live: Live, row: MapRow) -> None:
    whole = live.http.get(first_cell_path(row))
    answer = live.http.get(first_cell_path(row), headers={"Range": f"bytes={len(whole.content)}-"})
    assert (answer.status_code, kind_of(answer)) == (416, "bad_range")
    assert answer.headers["Content-Range"] == f"bytes */{len(whole.content)}"
    known = {"Range": "bytes=0-1", "If-None-Match": whole.headers["ETag"]}
    assert live.http.get(first_cell_path(row), headers=known).status_code == 304


@given(size=st.integers(1, 40), first=st.integers(0, 50), last=st.integers(0, 50))
def test_ranges_are_those_of_a_slice(size: int, first: int, last: int) -> None:
    places = range(size)

    def asked(text: str) -> list[int] | None:
        try:
            part = part_of(size, f"bytes={text}", etag='"x"', if_range=None)
        except BadInputError:
            return []
        return None if part is None else list(places[part[0] : part[1]])

    assert asked(f"{first}-") == list(places[first:])
    assert asked(f"-{last}") == (list(places[-last:]) if last else [])
    assert asked(f"{first}-{last}") == (None if last < first else list(places[first : last + 1]))


@pytest.mark.parametrize("suffix", ["", ".ply", "?depth=2"])
def test_head_says_what_get_does_without_the_body(live: Live, row: MapRow, suffix: str) -> None:
    whole, head = (live.http.request(method, first_cell_path(row, suffix)) for method in ("GET", "HEAD"))
    assert (head.status_code, head.content) == (200, b"")
    for name in (*SAID, "Content-Length", "Content-Type"):
        assert head.headers[name] == whole.headers[name]
    assert live.http.head(f"/maps/{row.name}/main/cells/9,9,9").status_code == 404
    assert live.http.head(first_cell_path(row), headers={"Range": "bytes=0-1"}).status_code == 200


def test_a_box_is_the_index_without_what_lies_outside(live: Live, row: MapRow) -> None:
    whole = live.http.get(f"/maps/{row.name}/main/cells").json()
    assert {tuple(entry["cell"]) for entry in whole["cells"]} == {cell_of_key(key) for key in KEYS}
    for box, cells in (
        ("-1,0,0,1,0,2", {(0, 0, 0), (-1, 0, 2), (1, 0, 0)}),
        ("0,0,0,1,0,1", {(0, 0, 0), (1, 0, 0)}),
        ("-1,0,2,-1,0,2", {(-1, 0, 2)}),
        ("5,5,5,6,6,6", set()),
    ):
        found = live.http.get(f"/maps/{row.name}/main/cells", params={"box": box}).json()
        assert {tuple(entry["cell"]) for entry in found["cells"]} == cells
        assert found["header"] == whole["header"]


@pytest.mark.parametrize(
    "box", ["", "0,0,0", "0,0,0,1,1", "0,0,0,1,1,1,1", "1,0,0,0,0,0", "a,0,0,1,1,1", "0,0,0,9999999,0,0"]
)
def test_a_box_that_cannot_be_is_refused(live: Live, row: MapRow, box: str) -> None:
    answer = live.http.get(f"/maps/{row.name}/main/cells", params={"box": box})
    assert answer.status_code == 400
    assert kind_of(answer) in ("bad_box", "bad_cell", "cell_range")


@pytest.mark.parametrize("box", [None, "-1,0,0,0,0,2"])
def test_pages_of_the_index_are_the_index_in_pieces(live: Live, row: MapRow, box: str | None) -> None:
    url, params = f"/maps/{row.name}/main/cells", {"box": box} if box else {}
    whole = live.http.get(url, params=params).json()["cells"]
    keys = [cell_key(tuple(entry["cell"])) for entry in whole]
    assert keys == sorted(keys)
    found: list[object] = []
    page, after = [], {}
    for _ in range(len(whole) + 1):
        page = live.http.get(url, params={**params, "limit": 1, **after}).json()["cells"]
        assert len(page) == (len(found) < len(whole))
        found += page
        if page:
            after = {"after": ",".join(map(str, page[0]["cell"]))}
    assert found == whole


def test_a_page_that_is_full_and_one_that_is_not(live: Live, row: MapRow) -> None:
    url = f"/maps/{row.name}/main/cells"
    sizes = {limit: len(live.http.get(url, params={"limit": limit}).json()["cells"]) for limit in (1, 2, 3, 10_000)}
    assert sizes == {1: 1, 2: 2, 3: 3, 10_000: 3}


def test_entries_say_how_hot_cells_are_only_to_who_asks(live: Live, row: MapRow) -> None:
    url = f"/maps/{row.name}/main/cells"
    plain, asked = (live.http.get(url, params=params).json()["cells"] for params in ({}, {"hottest": "true"}))
    with live.service.store.snapshot(row) as snapshot:
        assert [entry.pop("hottest_k") for entry in asked] == [cell.hottest_k for cell in snapshot.cells()]
    assert asked == plain


@pytest.mark.parametrize(
    ("params", "status"),
    [({"limit": 0}, 422), ({"limit": 10_001}, 422), ({"after": "0,0"}, 400), ({"after": "9999999,0,0"}, 400)],
)
def test_a_page_that_cannot_be_is_refused(live: Live, row: MapRow, params: dict[str, str | int], status: int) -> None:
    answer = live.http.get(f"/maps/{row.name}/main/cells", params=params)
    assert (answer.status_code, kind_of(answer) in ("bad_message", "bad_cell", "cell_range")) == (status, True)


def vector_url(row: MapRow) -> str:
    return f"/maps/{row.name}/main/vector"


def test_the_vector_of_every_cursor_is_what_was_folded_then(live: Live) -> None:
    row = live.new_map()
    cursors = [live.http.get(f"/maps/{row.name}").json()["cursor"]]
    commits = [pushed(0, 0), pushed(0, 1, WREN), pushed(1, 2)]
    for commit in commits:
        live.push(row, commit)
        live.retract(row, commit)  # takes out; the ids stay folded
        live.folded(row)
        cursors.append(live.http.get(f"/maps/{row.name}").json()["cursor"])
    for n, cursor in enumerate(cursors):
        answer = live.http.get(vector_url(row), params={"at": cursor})
        vector = version_vector_from_json(answer.json())
        assert [commit.id in vector for commit in commits] == [k < n for k in range(len(commits))]
        assert answer.headers["ETag"] == f'"{hashlib.sha256(answer.content).hexdigest()}"'


def test_a_cursor_of_nowhere_has_no_vector(live: Live, row: MapRow) -> None:
    head = cursor_from_text(live.http.get(f"/maps/{row.name}").json()["cursor"])
    for cursor, status, kind in (
        (Cursor(bytes(16), head.seq, head.chain), 410, "other_log"),
        (Cursor(head.log_id, head.seq, bytes(16)), 404, "no_cursor"),
        (Cursor(head.log_id, head.seq + 1, head.chain), 404, "no_cursor"),
    ):
        answer = live.http.get(vector_url(row), params={"at": str(cursor)})
        assert (answer.status_code, kind_of(answer)) == (status, kind)
    assert kind_of(live.http.get(vector_url(row), params={"at": "x"})) == "bad_cursor"
    assert live.http.get(vector_url(row)).status_code == 422


@pytest.fixture(scope="module")
def crowded(live: Live) -> MapRow:
    """A map that says of itself that a thousand robots made it."""
    made = live.new_map()
    live.push(made, pushed(0, 0))
    live.folded(made)
    many = (Author(RobotName(f"robot{n}"), Incarnation(f"{n:016x}")) for n in range(1000))
    add_commits(live.service.store, made, [CommitId(author, 0) for author in many])
    return made


def test_a_thousand_authors_do_not_fit_into_a_header_and_come_by_digest(live: Live, crowded: MapRow) -> None:
    answer = live.http.get(first_cell_path(crowded))
    assert answer.status_code == 200
    assert "Cairn-Coverage" not in answer.headers
    assert sum(len(name) + len(value) + 4 for name, value in answer.headers.raw) < COVERAGE_BYTES_MAX
    same = live.http.get(first_cell_path(crowded), headers={"If-None-Match": answer.headers["ETag"]})
    assert same.headers["Cairn-Coverage-Digest"] == answer.headers["Cairn-Coverage-Digest"]
    vector = live.http.get(vector_url(crowded), params={"at": answer.headers["Cairn-Cursor"]})
    assert hashlib.sha256(vector.content).hexdigest() == answer.headers["Cairn-Coverage-Digest"]
    assert len(vector.json()) == 1001


def test_a_robot_gets_the_coverage_of_its_cells_whatever_happens_meanwhile(live: Live, crowded: MapRow) -> None:
    cell = cell_of_key(next(iter(pushed(0, 0).cells)))
    asked: list[str] = []
    with MapApi(f"http://127.0.0.1:{live.port}") as api:
        api._client.event_hooks["request"].append(lambda request: asked.append(request.url.path))
        index = api.cell_index(crowded.name)
        known = api.cell(crowded.name, cell)
        assert known.coverage == index.header.coverage
        assert len(known.coverage.intervals) == 1001
        assert vector_url(crowded) not in asked  # the index had it
        live.push(crowded, pushed(1, 0))
        live.folded(crowded)
        fresh = api.cell(crowded.name, cell)
        assert asked.count(vector_url(crowded)) == 1
        assert pushed(1, 0).id in fresh.coverage and pushed(1, 0).id not in known.coverage
        assert api.cell(crowded.name, cell, etag=fresh.etag).coverage == fresh.coverage
        assert asked.count(vector_url(crowded)) == 1


def test_a_vector_that_does_not_have_its_digest_is_not_taken(
    live: Live, crowded: MapRow, monkeypatch: pytest.MonkeyPatch
) -> None:
    cell = cell_of_key(next(iter(pushed(0, 0).cells)))
    with MapApi(f"http://127.0.0.1:{live.port}") as api:

        def lie(*args: Any) -> VersionVector:
            return VersionVector({MOLE: ((0, 99),)})

        monkeypatch.setattr(api, "vector_at", lie)
        with pytest.raises(DamagedDataError):
            api.cell(crowded.name, cell)


def test_a_short_coverage_stays_in_its_header(live: Live, row: MapRow) -> None:
    answer: httpx.Response = live.http.get(first_cell_path(row))
    assert "Cairn-Coverage-Digest" not in answer.headers
    assert answer.headers["Content-Type"] == CELL_MEDIA_TYPE
    at = live.http.get(vector_url(row), params={"at": answer.headers["Cairn-Cursor"]})
    assert answer.headers["Cairn-Coverage"] == at.text


def test_the_index_tells_whose_evidence_is_still_there_if_it_is_asked(live: Live) -> None:
    row = live.new_map()
    commits = [pushed(n, 0, author) for n, author in ((0, WREN), (0, MOLE), (1, MOLE))]
    for commit in commits:
        live.push(row, commit)
    live.folded(row)

    def held() -> list[int | None]:
        answer = live.http.get(f"/maps/{row.name}/main/cells", params={"held": "true"})
        found = CellIndex.model_validate_json(answer.content).cells
        assert {entry.cell for entry in found} == {cell_of_key(key) for key in KEYS[:2]}
        return [entry.held_lm for entry in found]

    assert held() == [3, 3]
    assert "held_lm" not in live.http.get(f"/maps/{row.name}/main/cells").json()["cells"][0]
    for commit, left in ((commits[2], 2), (commits[0], 2), (commits[1], None)):
        live.retract(row, commit)
        live.folded(row)
        assert held() == [left, left]
