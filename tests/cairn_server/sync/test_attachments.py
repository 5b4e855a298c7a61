"""Attachments over HTTP: sent in parts once a mark names them, saved as files; what hostile senders get."""

import hashlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from tests.fixtures.map.marks import attached, mark, mark_commit
from tests.fixtures.server.access import ADMIN, ENROLLER, bearer, robot_token
from tests.fixtures.server.answers import kind_of
from tests.fixtures.server.live import Live
from tests.fixtures.server.pushes import MOLE, WREN

from cairn_map.commits.attachment import ATTACHMENT_BYTES_MAX, attachment_of
from cairn_map.wire.mark_messages import MarkPage
from cairn_server.store.attachments.attachments import PART_BYTES_MIN
from cairn_server.store.store_rows import MapRow
from cairn_server.sync import attachment_transfer

PNG = b"\x89PNG\r\n\x1a\n" + b"p" * (2 * PART_BYTES_MIN)
PAGE = b"<!DOCTYPE html><script>alert(1)</script>"


@pytest.fixture(scope="module")
def guarded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Live]:
    folder: Path = tmp_path_factory.mktemp("guarded-attachments")
    with Live(folder, admin_token=ADMIN, enrolment_token=ENROLLER) as server:
        yield server


def path_of(row: MapRow, data: bytes) -> str:
    return f"/maps/{row.name}/main/attachments/{hashlib.sha256(data).hexdigest()}"


def send(
    live: Live, row: MapRow, data: bytes, *, named: bytes | None = None, offset: int = 0, **options: Any
) -> httpx.Response:
    """Send bytes as one part, or as a part of other bytes, whose name they go under."""
    whole = data if named is None else named
    params = {"total": len(whole), "offset": offset}
    return live.http.patch(path_of(row, whole), params=params, content=data, **options)


def wanted(live: Live, row: MapRow, **params: Any) -> list[str]:
    answer = live.http.get(f"/maps/{row.name}/main/attachments", params=params)
    assert answer.status_code == 200, answer.text
    return [each["sha256"] for each in answer.json()["wanted"]]


def named(live: Live, *found: bytes) -> MapRow:
    """A map with a mark for each attachment."""
    row = live.new_map()
    live.push(row, mark_commit(0, *map(attached, found), author=MOLE)).raise_for_status()
    live.folded(row)
    return row


def test_an_attachment_is_named_first_sent_in_parts_and_saved_by_any_reader(live: Live) -> None:
    row = named(live, PNG)
    sha = hashlib.sha256(PNG).hexdigest()
    assert wanted(live, row) == wanted(live, row, robot="mole") == [sha]
    assert wanted(live, row, robot="wren") == []
    page = MarkPage.model_validate_json(live.http.get(f"/maps/{row.name}/main/marks").content)
    assert page.marks[0].mark.attachment == attachment_of(PNG)
    missing = live.http.get(path_of(row, PNG))
    assert (missing.status_code, kind_of(missing), "later" in missing.text) == (404, "no_attachment", True)

    assert send(live, row, b"", named=PNG).json() == {"held_bytes": 0, "is_whole": False}
    first = send(live, row, PNG[:PART_BYTES_MIN], named=PNG)
    assert first.json() == {"held_bytes": PART_BYTES_MIN, "is_whole": False}
    # The link broke before the answer: the same part again, then an empty one, say where to go on.
    assert send(live, row, PNG[:PART_BYTES_MIN], named=PNG).json() == first.json()
    assert send(live, row, b"", named=PNG).json() == first.json()
    rest = send(live, row, PNG[PART_BYTES_MIN:], named=PNG, offset=PART_BYTES_MIN)
    assert rest.json() == {"held_bytes": len(PNG), "is_whole": True}
    assert wanted(live, row) == []
    assert send(live, row, PNG).json()["is_whole"]

    saved = live.http.get(path_of(row, PNG))
    assert (saved.status_code, saved.content, saved.headers["Content-Type"]) == (200, PNG, "image/png")
    again = live.http.get(path_of(row, PNG), headers={"If-None-Match": saved.headers["ETag"]})
    assert (again.status_code, again.content) == (304, b"")


@pytest.mark.parametrize(
    ("data", "media_type", "suffix"),
    [
        (PNG, "image/png", ".png"),
        (b"\xff\xd8\xff\xe0 JFIF", "image/jpeg", ".jpg"),
        (b"RIFF\x10\x00\x00\x00WEBPVP8 ", "image/webp", ".webp"),
        (b"RIFF\x10\x00\x00\x00WAVEfmt ", "application/octet-stream", ".bin"),
        (PAGE, "application/octet-stream", ".bin"),
        (b"<svg xmlns='http://www.w3.org/2000/svg' onload='alert(1)'/>", "application/octet-stream", ".bin"),
        (b"GIF89a <script>", "application/octet-stream", ".bin"),
    ],
)
def test_whatever_the_bytes_claim_to_be_they_are_a_file_to_be_saved(
    live: Live, data: bytes, media_type: str, suffix: str
) -> None:
    row = named(live, data)
    assert send(live, row, data, headers={"Content-Type": "text/html"}).json()["is_whole"]
    found = live.http.get(path_of(row, data), headers={"Accept": "text/html"})
    name = f"{hashlib.sha256(data).hexdigest()[:16]}{suffix}"
    assert (found.content, found.headers["Content-Type"]) == (data, media_type)
    assert found.headers["Content-Disposition"] == f'attachment; filename="{name}"'
    assert found.headers["X-Content-Type-Options"] == "nosniff"
    assert found.headers["Content-Security-Policy"] == "default-src 'none'; sandbox"


def test_bytes_of_another_hash_are_dropped_and_the_right_ones_are_taken(live: Live) -> None:
    row = named(live, PNG)
    wrong = PNG[:-1] + b"x"
    answer = send(live, row, wrong, named=PNG)
    assert (answer.status_code, kind_of(answer)) == (400, "bad_attachment")
    assert hashlib.sha256(wrong).hexdigest() in answer.text
    assert (send(live, row, b"", named=PNG).json()["held_bytes"], live.http.get(path_of(row, PNG)).status_code) == (
        0,
        404,
    )
    assert send(live, row, PNG).json()["is_whole"]


def test_what_no_mark_names_is_not_taken_nor_given(live: Live) -> None:
    row = named(live, PNG)
    for answer in (send(live, row, PAGE), live.http.get(path_of(row, PAGE))):
        assert (answer.status_code, kind_of(answer)) == (404, "no_attachment")
    send(live, row, PNG)
    live.retract(row, mark_commit(0, attached(PNG), author=MOLE)).raise_for_status()
    live.folded(row)
    assert live.http.get(path_of(row, PNG)).status_code == 404
    # Nor of another map, where no mark names it.
    assert live.http.get(path_of(live.new_map(), PNG)).status_code == 404


@pytest.mark.parametrize(
    ("part", "params", "status", "kind"),
    [
        (b"x", {"total": len(PNG) - 1, "offset": 0}, 400, "bad_attachment"),
        (b"x", {"total": len(PNG), "offset": 0}, 400, "bad_attachment"),
        (b"x", {"total": len(PNG), "offset": len(PNG)}, 413, "too_large"),
        (b"x" * ((1 << 20) + 1), {"total": len(PNG), "offset": 0}, 413, "too_large"),
        (b"x", {"total": 1 << 60, "offset": 0}, 422, "bad_message"),
        (b"x", {"total": -1, "offset": 0}, 422, "bad_message"),
        (b"x", {}, 422, "bad_message"),
    ],
)
def test_a_part_that_cannot_be_of_it_is_refused(
    live: Live, part: bytes, params: dict[str, int], status: int, kind: str
) -> None:
    row = named(live, PNG)
    answer = live.http.patch(path_of(row, PNG), params=params, content=part)
    assert (answer.status_code, kind_of(answer)) == (status, kind), answer.text
    assert send(live, row, b"", named=PNG).json()["held_bytes"] == 0


def test_a_name_that_is_no_hash_is_refused(live: Live) -> None:
    row = live.new_map()
    for sha in ("0", "A" * 64, "0" * 63, "0" * 65):
        for method in ("GET", "PATCH"):
            path = f"/maps/{row.name}/main/attachments/{sha}"
            answer = live.http.request(method, path, params={"total": 1, "offset": 0})
            assert (answer.status_code, kind_of(answer)) == (400, "bad_id")


def test_a_mark_names_no_attachment_that_is_too_large(live: Live) -> None:
    row = live.new_map()
    for attachment in (
        {"sha256": "0" * 64, "size_bytes": ATTACHMENT_BYTES_MAX + 1},
        {"sha256": "0" * 64, "size_bytes": 0},
        {"sha256": "../etc", "size_bytes": 1},
        {"sha256": "0" * 64, "size_bytes": 1, "type": "text/html"},
    ):
        body = {"mark": {"kind": "door", "name": "door", "place_m": [0, 0, 0], "attachment": attachment}}
        answer = live.http.post(f"/maps/{row.name}/main/marks", json=body)
        assert (answer.status_code, kind_of(answer)) == (422, "bad_message")


def test_a_robot_has_so_much_room_for_attachments(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(attachment_transfer, "OF_ROBOT_BYTES_MAX", 10)
    row = named(live, b"123456", b"67890")
    assert send(live, row, b"123456").json()["is_whole"]
    answer = send(live, row, b"67890")
    assert (answer.status_code, kind_of(answer)) == (400, "too_many_attachments")
    # The mark is there without it, and an operator's has a room of its own.
    body = {"mark": {"kind": "door", "name": "door", "place_m": [0, 0, 0], "attachment": _fields(b"operator's")}}
    live.http.post(f"/maps/{row.name}/main/marks", json=body).raise_for_status()
    assert send(live, row, b"operator's").json()["is_whole"]


def _fields(data: bytes) -> dict[str, Any]:
    return attachment_of(data).model_dump()


def test_who_may_not_is_refused(guarded: Live) -> None:
    row = guarded.new_map()
    tokens = {robot: bearer(robot_token(guarded, row, robot)) for robot in ("mole", "wren")}
    for role in ("reader", "operator", "relay"):
        answer = guarded.http.put(f"/tokens/{role}", json={"role": role, "map": row.name}, headers=bearer(ADMIN))
        tokens[role] = bearer(answer.json()["token"])
    guarded.push(row, mark_commit(0, attached(PAGE), author=MOLE), headers=bearer(ADMIN)).raise_for_status()
    guarded.push(row, mark_commit(0, mark(), author=WREN), headers=bearer(ADMIN)).raise_for_status()
    for name, status in {"reader": 403, "wren": 403, "mole": 200, "operator": 200, "relay": 200}.items():
        answer = send(guarded, row, b"", named=PAGE, headers=tokens[name])
        assert (name, answer.status_code) == (name, status)
    # What one sends in part, no other one goes on with, nor spoils.
    assert send(guarded, row, b"x" * len(PAGE), named=PAGE, headers=tokens["relay"]).status_code == 400
    assert send(guarded, row, PAGE, headers=tokens["mole"]).json()["is_whole"]
    for name, headers in tokens.items():
        assert (name, guarded.http.get(path_of(row, PAGE), headers=headers).content) == (name, PAGE)
    assert guarded.http.get(path_of(row, PAGE)).status_code == 401


def test_a_robot_sends_what_an_operator_took_over_from_its_mark(guarded: Live) -> None:
    row = guarded.new_map()
    robot = bearer(robot_token(guarded, row, "mole"))
    guarded.push(row, mark_commit(0, attached(PAGE), author=MOLE), headers=bearer(ADMIN)).raise_for_status()
    fields = {"kind": "door", "name": "door", "place_m": [0, 0, 0], "attachment": _fields(PAGE)}
    body = {"of": f"{MOLE}.0:0", "mark": fields}
    guarded.http.post(f"/maps/{row.name}/main/marks", json=body, headers=bearer(ADMIN)).raise_for_status()
    guarded.folded(row)
    answer = guarded.http.get(f"/maps/{row.name}/main/attachments", params={"robot": "mole"}, headers=robot)
    assert answer.json()["wanted"] == [_fields(PAGE)]
    assert send(guarded, row, PAGE, headers=robot).json()["is_whole"]
