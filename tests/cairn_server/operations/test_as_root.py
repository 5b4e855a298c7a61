"""Commands that root runs on a store of a service user leave all files to that user, whose server opens them."""

import os
from pathlib import Path

import pytest
from tests.fixtures.commands import cairn
from tests.fixtures.server.live import Live
from tests.fixtures.server.pushes import pushed

from cairn_server.store.private_files import give_to_owner
from cairn_server.store.sqlite.store import SqliteStore

pytestmark = pytest.mark.skipif(os.geteuid() != 0, reason="only root may act for another user")

OWNER = (65534, 65534)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A stopped server's folder, of another user."""
    with Live(tmp_path / "data", store=SqliteStore(tmp_path / "data")) as live:
        row = live.new_map()
        live.push(row, pushed(0, 0))
        live.folded(row)
    for path in (tmp_path / "data", *(tmp_path / "data").iterdir()):
        os.chown(path, *OWNER)
    return tmp_path / "data"


def owner_of(path: Path) -> tuple[int, int]:
    """User and group of a file, or of a link itself."""
    found = path.lstat()
    return found.st_uid, found.st_gid


def test_every_command_on_a_folder_leaves_it_to_its_owner(folder: Path, tmp_path: Path) -> None:
    (new := tmp_path / "new").mkdir()
    os.chown(new, *OWNER)
    for words in (
        ["backup", "b.cairn", "--data", folder],
        ["archive", "map0", "map0.cairn", "--data", folder],
        ["check", "--repair", "--data", folder],
        ["compact", "--data", folder],
        ["restore", "b.cairn", "--data", new, "--old", folder],
    ):
        cairn("serve", *words, folder=tmp_path)
        assert {owner_of(path) for place in (folder, new) for path in place.iterdir()} == {OWNER}, words
    assert owner_of(tmp_path / "b.cairn") == (0, 0)


def test_an_archive_that_comes_back_is_the_owner_s(folder: Path, tmp_path: Path) -> None:
    cairn("serve", "archive", "map0", "map0.cairn", "--data", folder, folder=tmp_path)
    with Live(tmp_path / "other", store=SqliteStore(tmp_path / "other")):
        pass
    for path in (tmp_path / "other", *(tmp_path / "other").iterdir()):
        os.chown(path, *OWNER)
    cairn("serve", "unarchive", "map0.cairn", "--data", tmp_path / "other", folder=tmp_path)
    assert {owner_of(path) for path in (tmp_path / "other").iterdir()} == {OWNER}


def test_links_and_files_of_two_names_stay_root_s(tmp_path: Path) -> None:
    (tmp_path / "secret").write_text("of root")
    (place := tmp_path / "data").mkdir()
    (place / "mine").touch()
    (place / "link").symlink_to(tmp_path / "secret")
    (place / "second").hardlink_to(tmp_path / "secret")
    os.chown(place, *OWNER)
    give_to_owner([place / name for name in ("mine", "link", "second", "none")])
    assert {path.name for path in place.iterdir() if owner_of(path) == OWNER} == {"mine"}
    assert owner_of(tmp_path / "secret") == (0, 0)
