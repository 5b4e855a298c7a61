"""Errors of the server's commands name their cause and the way out, with the exit code of their family."""

import os
import shutil
import signal
import socket
import sqlite3
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from tests.fixtures.commands import cairn
from tests.fixtures.server.live import NO_MAPS, Live, Process
from tests.fixtures.server.pushes import pushed
from tests.fixtures.server.tiny_disk import TinyDisk, tiny_disk

from cairn_map.errors import BadInputError
from cairn_server.operations.serve import listen
from cairn_server.store.sqlite.schema import STEPS
from cairn_server.store.sqlite.store import FILE_NAME, SqliteStore

pytestmark = pytest.mark.processes

NOBODY = ("setpriv", "--reuid=65534", "--regid=65534", "--clear-groups")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A sound store with a map, stopped."""
    with Live(tmp_path / "data", store=SqliteStore(tmp_path / "data")) as live:
        row = live.new_map()
        for n in range(4):
            live.push(row, pushed(n, n))
        live.folded(row)
    return tmp_path / "data"


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[TinyDisk]:
    """A small disk that is full."""
    with tiny_disk(tmp_path / "disk", size_mb=2) as found:
        yield found


def refused(folder: Path, *options: str, under: tuple[str, ...] = ()) -> tuple[int, str]:
    """Exit code and complaint of a server that does not start."""
    process = Process(folder, *options, under=under)
    assert process.url is None
    return process.end()


def test_a_sound_store_on_a_full_disk_is_no_wrong_store(folder: Path, disk: TinyDisk) -> None:
    shutil.copytree(folder, disk.folder / "data")
    disk.fill()
    code, said = refused(disk.folder / "data")
    assert code == 5
    assert "its disk is full" in said
    assert "[disk_full]" in said
    assert "not a store" not in said


def test_what_is_no_store_is_called_so(tmp_path: Path) -> None:
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / FILE_NAME).write_bytes(b"no database" * 1000)
    code, said = refused(tmp_path / "data")
    assert (code, "is not a store" in said, "[bad_store]" in said) == (1, True, True), said


def test_commands_on_what_is_no_store_call_it_so(folder: Path, tmp_path: Path) -> None:
    cairn("serve", "archive", "map0", "map0.cairn", "--data", folder, folder=tmp_path)
    (tmp_path / "none").mkdir()
    (tmp_path / "none" / FILE_NAME).write_bytes(b"no database" * 1000)
    for words in (["compact"], ["check"], ["archive", "map0", "x.cairn"], ["unarchive", "map0.cairn"]):
        said = cairn("serve", *words, "--data", "none", folder=tmp_path, code=1)
        assert f"none/{FILE_NAME} is not a store: " in said, words
    assert not (tmp_path / "x.cairn").exists()


def test_commands_on_a_full_disk_call_it_so(folder: Path, tmp_path: Path, disk: TinyDisk) -> None:
    cairn("serve", "archive", "map0", "map0.cairn", "--data", folder, folder=tmp_path)
    shutil.copytree(folder, disk.folder / "data")
    disk.fill()
    for words, code in ((["compact"], 5), (["check"], 5), (["unarchive", "map0.cairn"], 1)):
        said = cairn("serve", *words, "--data", disk.folder / "data", folder=tmp_path, code=code)
        assert "its disk is full" in said or "there is no room" in said, words
        assert ".partial" not in said, words


def test_a_store_of_another_user_says_whose_it_must_be(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", "/tmp")
    if shutil.which(NOBODY[0]) is None or os.geteuid():
        pytest.skip("no other user can be taken")
    folder.chmod(0o755)
    for parent in list(folder.parents)[:-1]:
        if not parent.stat().st_mode & 0o001:
            parent.chmod(parent.stat().st_mode | 0o001)
    code, said = refused(folder, under=NOBODY)
    assert (code, "[bad_store]" in said, "Traceback" in said) == (1, True, False), said


@pytest.mark.parametrize("how", ["full", "no permission", "a folder that is not there"])
def test_a_backup_that_cannot_be_written_is_not_called_damaged(folder: Path, disk: TinyDisk, how: str) -> None:
    target = disk.folder / "nightly.cairn"
    if how == "full":
        disk.fill()
    elif how == "no permission":
        target = Path("/proc/nightly.cairn")  # where not even root makes files
    else:
        target = disk.folder / "none" / "nightly.cairn"
    said = cairn("serve", "backup", "--data", folder, target, folder=folder, code=1)
    assert f"{target} cannot be written" in said
    assert "[bad_backup]" in said
    assert ("its disk is full" in said) == (how == "full")


def test_a_backup_that_outgrows_its_disk_says_that_the_disk_is_full(folder: Path, disk: TinyDisk) -> None:
    live = sqlite3.connect(folder / FILE_NAME)
    live.execute("CREATE TABLE large AS SELECT zeroblob(4000000) AS body")
    live.commit()
    live.close()
    said = cairn("serve", "backup", "--data", folder, disk.folder / "nightly.cairn", folder=folder, code=1)
    assert "nightly.cairn cannot be written: its disk is full [bad_backup]" in said
    assert list(disk.folder.iterdir()) == []


def test_a_store_of_a_newer_version_says_to_update_this_program(folder: Path, tmp_path: Path) -> None:
    cairn("serve", "backup", "--data", folder, tmp_path / "b.cairn", folder=tmp_path)
    for path in (folder / FILE_NAME, tmp_path / "b.cairn"):
        connection = sqlite3.connect(path)
        connection.execute(f"PRAGMA user_version = {len(STEPS) + 1}")
        connection.close()
    said = [
        cairn("serve", "check", "--data", folder, folder=tmp_path, code=1),
        cairn("serve", "check", "--data", folder, "--repair", folder=tmp_path, code=1),
        cairn("serve", "restore", tmp_path / "b.cairn", "--data", tmp_path / "new", folder=tmp_path, code=1),
        cairn("serve", "archive", "map0", "map0.cairn", "--data", folder, folder=tmp_path, code=1),
        cairn("serve", "compact", "--data", folder, folder=tmp_path, code=1),
        refused(folder)[1],
    ]
    for text in said:
        assert f"of a newer cairn: it has version {len(STEPS) + 1}" in text
        assert "update it [store_version]" in text
        assert "start the server once" not in text
    said_of_name = cairn("serve", "backup", "--data", folder, tmp_path / "b.cairn", folder=tmp_path, code=1)
    assert "choose another name" in said_of_name


@pytest.mark.parametrize("part", [0.0, 0.02, 0.5, 0.999])
def test_a_backup_that_was_cut_off_says_how_much_of_it_is_there(folder: Path, tmp_path: Path, part: float) -> None:
    whole = tmp_path / "b.cairn"
    cairn("serve", "backup", "--data", folder, whole, folder=tmp_path)
    data = whole.read_bytes()
    whole.write_bytes(data[: int(part * len(data))])
    said = cairn("serve", "restore", whole, "--data", tmp_path / "new", folder=tmp_path, code=6)
    assert "is cut off: " in said
    assert (
        f"of {len(data) / 1e6:.1f} MB ({100 * whole.stat().st_size // len(data)} %) are there"
        if part
        else "nothing of it is there"
    ) in said
    assert not (tmp_path / "new").exists()


def test_a_restore_that_may_not_be_written_says_so(folder: Path, tmp_path: Path) -> None:
    cairn("serve", "backup", "--data", folder, tmp_path / "b.cairn", folder=tmp_path)
    said = cairn("serve", "restore", tmp_path / "b.cairn", "--data", "/proc/new", folder=tmp_path, code=1)
    assert "cannot keep a store in /proc/new" in said
    assert "[bad_store]" in said


def test_a_repair_of_what_is_not_there_makes_no_store(tmp_path: Path) -> None:
    said = cairn("serve", "check", "--data", tmp_path / "typo", "--repair", folder=tmp_path, code=3)
    assert "there is no store" in said
    assert list(tmp_path.iterdir()) == []


def test_an_address_of_another_machine_is_called_so(tmp_path: Path) -> None:
    (secret := tmp_path / "secret").write_text("s" * 20)
    secret.chmod(0o600)
    code, said = refused(tmp_path / "data", "--host", "192.0.2.1", "--admin-token-file", str(secret))
    assert (code, "192.0.2.1 is no address of this machine" in said) == (1, True), said
    assert "port" not in said
    with pytest.raises(BadInputError, match="is no address of this machine"):
        listen("no-such-host.invalid", 0)
    assert not (tmp_path / "data").exists()


def test_a_port_that_is_taken_says_so(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        code, said = refused(tmp_path / "data", "--port", str(taken.getsockname()[1]))
    assert (code, "another program does; stop it, or take another --port" in said) == (1, True), said


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--tls-cert", "none.pem", "--tls-key", "none.key"], "--tls-cert none.pem, --tls-key none.key: "),
        (["--upstream", "base:8750"], "a server's URL is http://HOST:PORT, got 'base:8750'"),
    ],
)
def test_a_start_that_is_refused_makes_no_store(options: list[str], said: str, tmp_path: Path) -> None:
    assert said in cairn("serve", "--data", "data", *options, folder=tmp_path, code=1)
    assert list(tmp_path.iterdir()) == []


def test_a_new_store_is_announced_and_one_with_maps_is_not(tmp_path: Path, folder: Path) -> None:
    (empty := tmp_path / "empty").mkdir()
    for place, words in (
        (tmp_path / "new", f"{tmp_path / 'new'} is new, and so is the store in it, without maps: {NO_MAPS} --data"),
        (tmp_path / "new", f"the store in {tmp_path / 'new'} has no maps: {NO_MAPS}"),
        (empty, f"the store in {empty} is new, without maps: {NO_MAPS}"),
        (folder, ""),
    ):
        process = Process(place)
        assert httpx.get(f"{process.url}/healthz").status_code == 200
        assert words in process.log()
        assert (NO_MAPS in process.log()) == bool(words)
        process.send(signal.SIGTERM)
        assert process.end() == (0, "")


def test_a_folder_of_something_else_is_refused_and_stays_as_it_is(tmp_path: Path) -> None:
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "cat.jpg").write_bytes(b"cat")
    code, said = refused(tmp_path / "photos")
    assert code == 4
    assert "has no store, but other files (cat.jpg)" in said
    assert f"--data {tmp_path / 'photos' / 'cairn-data'}" in said
    assert [path.name for path in (tmp_path / "photos").iterdir()] == ["cat.jpg"]


@pytest.mark.parametrize(
    ("words", "way"),
    [
        (["backup", "nightly.cairn"], "pg_basebackup"),
        (["restore", "nightly.cairn"], "pg_basebackup"),
        (["compact"], "VACUUM FULL"),
    ],
)
def test_commands_for_a_folder_say_what_to_do_with_a_database(words: list[str], way: str, tmp_path: Path) -> None:
    said = cairn("serve", *words, "--store", "postgresql://cairn@database/cairn", folder=tmp_path, code=1)
    assert f"`cairn serve {words[0]}` works on a folder (--data): " in said
    assert way in said
