"""Attachments of robots' marks: kept until no restore can lose them, sent once the mark is there, in parts, refused."""

import hashlib
import random
from collections.abc import Callable
from pathlib import Path

import pytest
from tests.fixtures.client.live_server import LiveServer
from tests.fixtures.client.made import MAP
from tests.fixtures.client.robots import NOWHERE, robot_in

from cairn_client.http.api import MapApi
from cairn_client.http.attachment_copy import PART_BYTES, fetched_attachment
from cairn_client.replica.attachment_folder import ATTACHMENTS, AttachmentFolder
from cairn_client.robot import rounds
from cairn_client.robot.robot import Robot
from cairn_map.commits.attachment import Attachment, attachment_of
from cairn_map.commits.version_vector import EMPTY
from cairn_map.errors import BadInputError, DamagedDataError, UnreachableError

PLACE = (0.5, -0.25, 1.0)
PICTURE = b"\xff\xd8\xff" + random.Random(3).randbytes(2 * PART_BYTES)
SHA = hashlib.sha256(PICTURE).hexdigest()


def kept(robot: Robot) -> frozenset[str]:
    return robot.replica.attachments.names()


def there(server: LiveServer) -> bytes | None:
    with MapApi(server.url) as api:
        return fetched_attachment(api, MAP, SHA)


def never_stable(server: LiveServer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server.service.sync.replies._stable, "of", lambda snapshot: EMPTY)


def test_a_picture_waits_in_the_folder_and_comes_to_the_server_after_its_mark(
    server: LiveServer, tmp_path: Path
) -> None:
    path = tmp_path / "pipe.jpg"
    path.write_bytes(PICTURE)
    with robot_in(tmp_path, NOWHERE) as robot:
        robot.mark("hot pipe", PLACE, attachment=path)
        assert kept(robot) == {SHA}
        robot.close(flush_s=0)
    path.unlink()
    with robot_in(tmp_path, server.map_url) as robot:
        (entry,) = robot.marks()
        assert entry.mark.attachment == Attachment(sha256=SHA, size_bytes=len(PICTURE))
        robot.sync(until_folded=True)
        robot.sync()
        assert there(server) == PICTURE


def test_it_stays_until_a_restore_cannot_lose_the_mark(
    server: LiveServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    never_stable(server, monkeypatch)
    with robot_in(tmp_path, server.map_url) as robot:
        commit = robot.mark("hot pipe", PLACE, attachment=PICTURE)
        robot.sync(until_folded=True)
        row = server.service.store.map(MAP)
        server.service.store.attachments.drop(row.number, bytes.fromhex(SHA))
        assert there(server) is None
        robot.sync()
        assert (there(server), kept(robot)) == (PICTURE, {SHA})
        # Its bytes go with those of the commit.
        robot.replica.outbox.forget([commit.id])
        robot.sync()
        assert (there(server), kept(robot)) == (PICTURE, frozenset())


def test_a_robot_that_leaves_sends_it_first(server: LiveServer, tmp_path: Path) -> None:
    with robot_in(tmp_path, server.map_url) as robot:
        robot.mark("hot pipe", PLACE, attachment=PICTURE)
    assert there(server) == PICTURE


def test_a_cut_leaves_what_came_and_the_next_round_goes_on(
    server: LiveServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with robot_in(tmp_path, server.map_url) as robot:
        sent: list[int] = []
        send = MapApi.put_attachment_part

        def cut_after(count: int) -> Callable[..., object]:
            def part(api: MapApi, name: str, attached: Attachment, data: bytes, *, offset: int) -> object:
                if len(sent) == count:
                    raise UnreachableError("no_link", "cut")
                sent.append(len(data))
                return send(api, name, attached, data, offset=offset)

            return part

        robot.mark("hot pipe", PLACE, attachment=PICTURE)
        monkeypatch.setattr(MapApi, "put_attachment_part", cut_after(2))
        with pytest.raises(UnreachableError):
            robot.sync()
        monkeypatch.setattr(MapApi, "put_attachment_part", cut_after(99))
        robot.sync()
        assert sent == [0, PART_BYTES, 0, PART_BYTES, 3]
    assert there(server) == PICTURE


def test_a_round_sends_some_of_it_and_the_next_ones_the_rest(
    server: LiveServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rounds, "AT_ONCE_BYTES", PART_BYTES)
    with robot_in(tmp_path, server.map_url) as robot:
        robot.mark("hot pipe", PLACE, attachment=PICTURE)
        found = []
        for _ in range(3):
            robot.sync()
            found.append(there(server))
        assert found == [None, None, PICTURE]


def test_the_same_bytes_at_two_marks_are_kept_and_sent_once(server: LiveServer, tmp_path: Path) -> None:
    with robot_in(tmp_path, server.map_url) as robot:
        for name in ("hot pipe", "hot pipe again"):
            robot.mark(name, PLACE, attachment=PICTURE)
        assert kept(robot) == {SHA}
        robot.sync(until_folded=True)
        assert [entry.mark.attachment for entry in robot.marks()] == [attachment_of(PICTURE)] * 2
    assert there(server) == PICTURE


def test_what_no_mark_needs_any_more_goes(server: LiveServer, tmp_path: Path) -> None:
    with robot_in(tmp_path, server.map_url) as robot:
        # A kill between the bytes and the mark leaves bytes that nothing names.
        robot.replica.attachments.keep(PICTURE)
        robot.sync()
        assert kept(robot) == frozenset()


def test_a_server_that_refuses_it_has_the_mark_and_the_robot_keeps_the_bytes(
    server: LiveServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cairn_server.sync.attachment_transfer.OF_ROBOT_BYTES_MAX", 10)
    with robot_in(tmp_path, server.map_url) as robot:
        robot.mark("hot pipe", PLACE, attachment=PICTURE)
        robot.sync(until_folded=True)
        robot.sync()
        assert ([entry.mark.name for entry in robot.marks()], kept(robot)) == (["hot pipe"], {SHA})
    assert there(server) is None


def test_what_is_no_attachment_is_refused_and_leaves_nothing(tmp_path: Path) -> None:
    large = tmp_path / "large"
    large.write_bytes(b"")
    with large.open("r+b") as file:
        file.truncate((1 << 24) + 1)
    with robot_in(tmp_path, NOWHERE) as robot:
        for attachment, kind in (
            (b"", "bad_attachment"),
            (large, "too_large"),
            (tmp_path / "none.jpg", "bad_attachment"),
            (tmp_path, "bad_attachment"),
        ):
            with pytest.raises(BadInputError) as refused:
                robot.mark("hot pipe", PLACE, attachment=attachment)
            assert refused.value.kind == kind
        assert (robot.waiting, kept(robot)) == (0, frozenset())
        robot.replica.attachments = AttachmentFolder(tmp_path / "mole" / ATTACHMENTS, size_bytes_max=len(PICTURE) - 1)
        with pytest.raises(UnreachableError) as full:
            robot.mark("hot pipe", PLACE, attachment=PICTURE)
        assert (full.value.kind, robot.waiting) == ("outbox_full", 0)
        robot.close(flush_s=0)


def test_bytes_that_are_damaged_on_the_disk_are_not_sent(server: LiveServer, tmp_path: Path) -> None:
    with robot_in(tmp_path, server.map_url) as robot:
        robot.mark("hot pipe", PLACE, attachment=PICTURE)
        (tmp_path / "mole" / ATTACHMENTS / SHA).write_bytes(PICTURE[:-1] + b"?")
        robot.sync()
        assert there(server) is None
        # The same picture again mends it.
        robot.mark("hot pipe", PLACE, attachment=PICTURE)
        robot.sync()
        assert there(server) == PICTURE


def test_a_server_that_gives_other_bytes_is_found_out(
    server: LiveServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(MapApi, "attachment", lambda api, name, sha256: b"<script>")
    with pytest.raises(DamagedDataError) as refused:
        there(server)
    assert refused.value.kind == "bad_attachment"
