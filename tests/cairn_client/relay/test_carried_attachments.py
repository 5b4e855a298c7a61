"""Attachments on their way between servers: joined, in a folder that somebody carries, and after a copy."""

import hashlib
from pathlib import Path

import pytest
from tests.fixtures.client.joined import ADMIN, Server, opened
from tests.fixtures.client.made import MAP
from tests.fixtures.commands import cairn
from tests.fixtures.map.marks import attached, mark_commit
from tests.fixtures.server.live import until

from cairn_client.http.attachment_copy import fetched_attachment
from cairn_client.relay.carried_attachments import hand_over_attachments
from cairn_client.relay.carried_commits import ATTACHMENTS_SHARE, CarriedCommits
from cairn_client.replica.attachment_folder import AttachmentFolder
from cairn_map.commits.attachment import Attachment, attachment_of
from cairn_map.commits.ids import Author, RobotName
from cairn_map.commits.signature import SigningKey, signatures_to_text
from cairn_map.errors import UnreachableError
from cairn_map.wire.relay_peer import SignedCommit

PICTURE = b"\x89PNG\r\n\x1a\n" + b"p" * 70_000
SHA = hashlib.sha256(PICTURE).hexdigest()
PLACE = (0.5, -0.25, 1.0)


def data_at(server: Server) -> bytes | None:
    with server.api() as api:
        return fetched_attachment(api, MAP, SHA)


def marked(server: Server, folder: Path, attachment: bytes | None = PICTURE) -> None:
    with opened(server, folder, "mole") as robot:
        robot.mark("hot pipe", PLACE, attachment=attachment)


def test_joined_servers_have_what_one_of_them_was_given(tmp_path: Path) -> None:
    with Server(tmp_path / "base") as base:
        base.create_map()
        with Server(tmp_path / "field", trusted_servers=base.key) as field:
            field.join(base)
            until(lambda: field.service.store.maps() != [], "the map is made")
            marked(field, tmp_path / "robot")
            until(lambda: data_at(base) == PICTURE, "the picture is at the base")
            # And the other way, of what the field server lost.
            field.service.store.attachments.drop(field.row.number, bytes.fromhex(SHA))
            until(lambda: data_at(field) == PICTURE, "the picture is at the field server again")


def test_a_folder_carries_them_and_a_copy_takes_them_along(tmp_path: Path) -> None:
    with Server(tmp_path / "field") as field, Server(tmp_path / "base") as base, Server(tmp_path / "new") as new:
        for server in (field, base):
            server.create_map()
        marked(field, tmp_path / "robot")
        field.folded(field.row)
        folder = str(tmp_path / "carried")
        here, there = (f"{server.url}/maps/{MAP}" for server in (field, base))
        options = ("--token", ADMIN, "--token-there", ADMIN)
        cairn("relay", here, folder, *options, folder=tmp_path)
        cairn("relay", folder, there, *options, folder=tmp_path)
        assert data_at(base) == PICTURE
        tokens = (f"--token={base.url}={ADMIN}", f"--token={new.url}={ADMIN}")
        cairn("map", "copy", there, f"{new.url}/maps/{MAP}", *tokens, folder=tmp_path)
        assert data_at(new) == PICTURE


KEY = SigningKey(bytes(32))
AUTHOR = Author(RobotName("other"), KEY.incarnation)


def carried_mark(n: int, data: bytes) -> SignedCommit:
    commit = mark_commit(n, attached(data), author=AUTHOR)
    return SignedCommit(commit.id, commit.data, signatures_to_text([KEY.sign(MAP, commit.sha)]))


def test_a_folder_wants_what_its_marks_name_and_keeps_the_newest(tmp_path: Path) -> None:
    room = 3000
    carried = CarriedCommits(tmp_path / "carried", MAP, size_bytes_max=ATTACHMENTS_SHARE * room)
    pictures = [bytes([n]) * 1400 for n in range(3)]
    for n, data in enumerate(pictures):
        carried.push(carried_mark(n, data))
    found = [attachment_of(data) for data in pictures]
    assert {each.sha256 for each in carried.wanted_attachments()} == {each.sha256 for each in found}
    assert not carried.has_attachments()
    for attachment, data in zip(found, pictures, strict=True):
        carried.keep_attachment(attachment, data)
    assert [carried.attachment(each) for each in found] == [None, *pictures[1:]]
    # What gave way is not fetched again, and what is there is not wanted.
    assert carried.wanted_attachments() == []
    with pytest.raises(UnreachableError) as full:
        carried.keep_attachment(found[0], bytes(room + 1))
    assert full.value.kind == "outbox_full"


class Liar:
    """A place that gives other bytes than are asked for, and wants what nobody has."""

    def has_attachments(self) -> bool:
        return True

    def wanted_attachments(self) -> list[Attachment]:
        return [attachment_of(b"of nobody")]

    def attachment(self, attachment: Attachment) -> bytes | None:
        return b"x" * (attachment.size_bytes + 1)

    def keep_attachment(self, attachment: Attachment, data: bytes) -> None:
        raise AssertionError("nothing is there to give")


def test_bytes_of_another_size_go_nowhere(tmp_path: Path) -> None:
    carried = CarriedCommits(tmp_path / "carried", MAP, size_bytes_max=10**6)
    carried.push(carried_mark(0, b"true"))
    assert hand_over_attachments(Liar(), carried) == 0  # type: ignore[arg-type]
    assert not carried.has_attachments()


def test_files_of_others_in_the_folder_are_no_attachments(tmp_path: Path) -> None:
    folder = AttachmentFolder(tmp_path / "attachments", size_bytes_max=1000)
    assert (folder.names(), folder.awaited(), folder.size_bytes()) == (frozenset(), [], 0)
    kept = folder.keep(b"true")
    for name in ("notes.txt", "0" * 64 + ".99999999", f"{'0' * 64}.0", f"{'0' * 64}.coming"):
        (tmp_path / "attachments" / name).touch()
    assert (folder.names(), folder.awaited()) == ({kept.sha256}, [])
    (tmp_path / "attachments" / kept.sha256).write_bytes(b"fals")
    assert folder.read(kept.sha256) is None
