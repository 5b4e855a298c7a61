"""Backup next to a running server, and restore."""

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import IO

import apsw
import pytest
from tests.fixtures.server.live import Live
from tests.fixtures.server.old_stores import OLD_COMMITS, OLD_RETRACTS, unpacked
from tests.fixtures.server.pushes import WREN, pushed, read, sum_of
from tests.fixtures.server.tiny_disk import tiny_disk

from cairn_map.errors import BadInputError, CairnError, ConflictError, DamagedDataError, NotFoundError
from cairn_server.operations.serve import main
from cairn_server.store.sqlite import backup as sqlite_backup
from cairn_server.store.sqlite.backup import back_up
from cairn_server.store.sqlite.store import FILE_NAME
from cairn_server.store.store_rows import MapRow

COMMITS = [pushed(n, n) for n in range(4)]


def ignore(done: int, total: int) -> None:
    """No progress to show."""


@pytest.fixture
def live(tmp_path: Path) -> Iterator[Live]:
    """A server at work."""
    with Live(tmp_path / "data") as server:
        yield server


@pytest.fixture
def row(live: Live) -> MapRow:
    made = live.new_map()
    for commit in COMMITS:
        live.push(made, commit)
    live.folded(made)
    return made


def test_a_backup_restored_is_the_map_as_it_was(
    live: Live, row: MapRow, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, folder = tmp_path / "nightly.cairn", tmp_path / "restored"
    before = live.http.get(f"/maps/{row.name}").json()
    assert main(["backup", "--data", str(tmp_path / "data"), str(file)]) == 0
    live.push(row, pushed(9, 0))
    assert main(["restore", str(file), "--data", str(folder)]) == 0
    said = capsys.readouterr().out
    assert f"{file}: 0." in said
    assert f"{folder}: restored and checked: 1 maps, 4 commits, 3 cells" in said
    assert "push again what is newer" in said
    assert sorted(path.name for path in tmp_path.iterdir()) == ["data", "nightly.cairn", "restored"]
    modes = {path.name: path.stat().st_mode & 0o777 for path in tmp_path.iterdir()}
    assert modes == {"data": 0o700, "nightly.cairn": 0o600, "restored": 0o700}  # as secret as the maps
    with Live(folder) as other:
        assert other.http.get(f"/maps/{row.name}").json() == before
        assert read(other.cells(other.service.store.map(row.name))) == sum_of(COMMITS)


def test_a_backup_is_one_state_and_ends_though_somebody_always_writes(
    live: Live, row: MapRow, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sqlite_backup, "STEP_PAGES", 1)
    file, written = tmp_path / "file", iter(range(1000))

    def write_meanwhile(done: int, total: int) -> None:
        assert live.push(row, pushed(n := next(written), n, WREN)).status_code == 201

    size_bytes = back_up(tmp_path / "data", file, write_meanwhile)
    assert size_bytes == file.stat().st_size
    assert 5 < next(written) == size_bytes // 16384 + 0, "each page was copied once"
    assert main(["restore", str(file), "--data", str(tmp_path / "restored")]) == 0
    with Live(tmp_path / "restored") as other:
        assert read(other.cells(other.service.store.map(row.name))) == sum_of(COMMITS)


def test_a_backup_has_its_name_only_when_it_is_whole(live: Live, row: MapRow, tmp_path: Path) -> None:
    file = tmp_path / "file"
    back_up(tmp_path / "data", file, ignore)
    first = file.read_bytes()

    def stop(done: int, total: int) -> None:
        assert file.read_bytes() == first
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        back_up(tmp_path / "data", file, stop)
    assert file.read_bytes() == first
    assert sorted(path.name for path in tmp_path.iterdir()) == ["data", "file"]


def test_a_backup_is_flushed_before_it_has_its_name(
    live: Live, row: MapRow, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file, events = tmp_path / "file", []
    fsync, replace = os.fsync, Path.replace

    def noted_fsync(descriptor: int) -> None:
        events.append(f"fsync {Path(f'/proc/self/fd/{descriptor}').readlink().name.partition('.')[0]}")
        fsync(descriptor)

    def noted_replace(path: Path, target: Path) -> Path:
        events.append("rename")
        return replace(path, target)

    monkeypatch.setattr(os, "fsync", noted_fsync)
    monkeypatch.setattr(Path, "replace", noted_replace)
    back_up(tmp_path / "data", file, ignore)
    assert events == ["fsync file", "rename", f"fsync {tmp_path.name}"]


def test_operators_take_a_new_incarnation_so_that_no_number_is_given_out_twice(
    live: Live, row: MapRow, tmp_path: Path
) -> None:
    back_up(tmp_path / "data", tmp_path / "file", ignore)
    lost = live.retract(row, COMMITS[0]).json()["id"]
    assert main(["restore", str(tmp_path / "file"), "--data", str(tmp_path / "restored")]) == 0
    with Live(tmp_path / "restored") as other:
        made = other.retract(other.service.store.map(row.name), COMMITS[1]).json()["id"]
        assert made.split(".")[0] == lost.split(".")[0] == "operator"
        assert made.split(".")[1] != lost.split(".")[1]


@pytest.mark.processes
def test_a_backup_goes_into_a_pipe_and_comes_back_from_it(live: Live, row: MapRow, tmp_path: Path) -> None:
    file = tmp_path / "piped.cairn"
    with file.open("wb") as out:
        done = in_process("backup", "--data", str(tmp_path / "data"), "-", stdout=out)
    assert (done.returncode, done.stderr.count("standard output: 0.")) == (0, 1), done.stderr
    assert sorted(path.name for path in (tmp_path / "data").iterdir() if "backup" in path.name) == []
    assert main(["restore", str(file), "--data", str(tmp_path / "restored")]) == 0
    with Live(tmp_path / "restored") as other:
        assert read(other.cells(other.service.store.map(row.name))) == sum_of(COMMITS)


@pytest.mark.processes
def test_a_backup_of_which_the_reader_went_away_has_failed(live: Live, row: MapRow, tmp_path: Path) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    done = in_process("backup", "--data", str(tmp_path / "data"), "-", stdout=writer)
    os.close(writer)
    assert done.returncode != 0 and "the backup is not whole" in done.stderr


def test_a_backup_is_not_written_to_a_terminal(
    live: Live, row: MapRow, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True, raising=False)
    with pytest.raises(BadInputError) as refused:
        main(["backup", "--data", str(tmp_path / "data"), "-"])
    assert refused.value.kind == "bad_backup"


@pytest.mark.processes
def test_a_backup_says_in_json_when_it_began_and_what_it_wrote(live: Live, row: MapRow, tmp_path: Path) -> None:
    file = tmp_path / "nightly.cairn"
    done = in_process("backup", "--data", str(tmp_path / "data"), str(file), "--log-format", "json")
    begun, ended = (json.loads(line) for line in f"{done.stdout}{done.stderr}".splitlines())
    assert (begun["message"], begun["file"]) == ("backup begun", str(file))
    assert (ended["message"], ended["size_bytes"]) == ("backup done", file.stat().st_size)
    assert 0 <= ended["seconds"] < 60
    lost = in_process("backup", "--data", str(tmp_path / "none"), str(file), "--log-format", "json")
    assert lost.returncode != 0
    assert "[no_store]" in json.loads(lost.stderr.splitlines()[-1])["message"]


def in_process(*arguments: str, stdout: IO[bytes] | int = subprocess.PIPE) -> subprocess.CompletedProcess[str]:
    """A command of `cairn serve` as a process of its own."""
    command = [sys.executable, "-m", "cairn_client.main", "serve", *arguments]
    return subprocess.run(command, stdout=stdout, stderr=subprocess.PIPE, text=True, timeout=60, check=False)


def test_what_is_no_backup_is_neither_replaced_nor_restored(live: Live, row: MapRow, tmp_path: Path) -> None:
    other = tmp_path / "notes.txt"
    other.write_text("mine")
    database = apsw.Connection(str(tmp_path / "other.sqlite"))
    database.execute("CREATE TABLE map (x); PRAGMA user_version = 1")
    database.close()
    for path in (other, tmp_path / "other.sqlite", tmp_path / "data" / FILE_NAME):
        before = path.read_bytes()
        with pytest.raises(BadInputError) as refused:
            back_up(tmp_path / "data", path, ignore)
        assert refused.value.kind == "bad_backup"
        assert path.read_bytes() == before
    for path in (other, tmp_path / "other.sqlite"):
        with pytest.raises(BadInputError) as refused:
            main(["restore", str(path), "--data", str(tmp_path / "new")])
        assert refused.value.kind == "bad_backup"


def test_what_is_not_there_is_not_made(tmp_path: Path) -> None:
    for command in (["backup", "--data", str(tmp_path), str(tmp_path / "file")], ["check", "--data", str(tmp_path)]):
        with pytest.raises(NotFoundError) as refused:
            main(command)
        assert refused.value.kind == "no_store"
    with pytest.raises(NotFoundError):
        main(["restore", str(tmp_path / "file"), "--data", str(tmp_path / "new")])
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("obstacle", ["in use", "a store", "a file"])
def test_a_folder_with_something_in_it_is_left_as_it_is(live: Live, row: MapRow, tmp_path: Path, obstacle: str) -> None:
    back_up(tmp_path / "data", tmp_path / "file", ignore)
    folder = tmp_path / ("data" if obstacle == "in use" else "other")
    if obstacle == "a store":
        Live(folder).__exit__(None, None, None)
    elif obstacle == "a file":
        folder.mkdir()
        (folder / "notes.txt").write_text("mine")
    before = sorted(path.name for path in folder.iterdir())
    with pytest.raises(ConflictError) as refused:
        main(["restore", str(tmp_path / "file"), "--data", str(folder)])
    assert refused.value.kind == ("store_in_use" if obstacle == "in use" else "not_empty")
    assert {path.name for path in folder.iterdir()} - {"cairn.lock"} == set(before) - {"cairn.lock"}


def test_a_damaged_backup_is_not_restored_and_leaves_nothing(live: Live, row: MapRow, tmp_path: Path) -> None:
    file = tmp_path / "file"
    back_up(tmp_path / "data", file, ignore)
    connection = apsw.Connection(str(file))
    connection.execute("UPDATE cell SET body = x'00' WHERE number = 2")
    connection.close()
    with pytest.raises(DamagedDataError, match="the backup is damaged"):
        main(["restore", str(file), "--data", str(tmp_path / "new")])
    assert {path.name for path in (tmp_path / "new").iterdir()} == {"cairn.lock"}


@pytest.mark.processes
def test_a_backup_of_a_disk_that_is_full_leaves_nothing(live: Live, row: MapRow, tmp_path: Path) -> None:
    with tiny_disk(tmp_path / "disk", size_mb=1) as disk:
        disk.fill()
        with pytest.raises(CairnError) as refused:
            back_up(tmp_path / "data", disk.folder / "file", ignore)
        assert refused.value.kind == "bad_backup"
        assert {path.name for path in disk.folder.iterdir()} == {"filler"}


def test_a_store_of_an_older_version_is_brought_up_to_date_on_the_way(tmp_path: Path) -> None:
    path = unpacked("v1.sqlite.zst", tmp_path)
    assert main(["restore", str(path), "--data", str(tmp_path / "new")]) == 0
    with Live(tmp_path / "new") as other:
        assert read(other.cells(other.service.store.map("lab"))) == sum_of([*OLD_COMMITS, *OLD_RETRACTS])


ENDLESS = "WITH RECURSIVE c(n) AS (SELECT 1 UNION ALL SELECT n + 1 FROM c) SELECT token_1.* FROM c, token_1"
TAMPERED = {
    "a view that never ends": ["ALTER TABLE token RENAME TO token_1", f"CREATE VIEW token AS {ENDLESS}"],
    "a trigger": ["CREATE TRIGGER t AFTER UPDATE ON robot_key BEGIN DELETE FROM token; END"],
    "a column that is computed": ["ALTER TABLE token ADD COLUMN more TEXT AS (name)"],
    "a table that is not there": ["DROP TABLE audit"],
    "a table too many": ["CREATE TABLE more (n INTEGER)"],
    "a text in a column of numbers": ["UPDATE map SET seq = 'many'"],
    "a number in a column of bytes": ["UPDATE commits SET sha = 7"],
    "a vector that is no JSON": ["INSERT INTO vector_mark VALUES (1, 1, 'none')"],
    "a wrong vector": ["INSERT INTO vector_mark VALUES (1, 1, '{}')"],
    "corners that are no JSON": ["UPDATE map SET corners = 'none'"],
    "totals of other cells": ["UPDATE map SET cells = 77"],
    "a tile of other cells": ["UPDATE tile SET fingerprint = x'00000000000000000000000000000001'"],
    "a tile that seems older": ["UPDATE tile SET lm = 0"],
    "a tile that is not there": ["DELETE FROM tile"],
    "a cell below 0": ["UPDATE OR IGNORE cell SET cell = -1 - cell"],
    "a diff of a cell below 0": ["UPDATE diff SET cell = -1 - cell"],
}


@pytest.mark.parametrize("statements", TAMPERED.values(), ids=TAMPERED)
def test_a_database_that_only_looks_like_a_store_is_refused_and_nothing_is_left(
    live: Live, row: MapRow, tmp_path: Path, statements: list[str]
) -> None:
    file, folder, other = tmp_path / "b.cairn", tmp_path / "restored", tmp_path / "other"
    back_up(tmp_path / "data", file, ignore)
    connection = apsw.Connection(str(file))
    for statement in statements:
        connection.execute(statement)
    connection.close()
    other.mkdir()
    (other / FILE_NAME).write_bytes(file.read_bytes())
    for command in (["restore", str(file), "--data", str(folder)], ["check", "--data", str(other)]):
        with pytest.raises(DamagedDataError) as refused:
            main(command)
        assert refused.value.kind == "damaged_store"
    assert not (folder / FILE_NAME).exists()


def test_a_time_that_no_calendar_has_is_told_as_the_latest_one(
    live: Live, row: MapRow, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "b.cairn"
    back_up(tmp_path / "data", file, ignore)
    connection = apsw.Connection(str(file))
    connection.execute("UPDATE commits SET received_s = 1e300")
    connection.close()
    assert main(["restore", str(file), "--data", str(tmp_path / "restored")]) == 0
    assert "after 5138-" in capsys.readouterr().out
