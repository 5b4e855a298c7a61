"""After everything of a map was deleted and compacted, the file is as if the map had never been."""

from collections.abc import Iterator
from pathlib import Path

import apsw
import pytest
from tests.fixtures.server.commit_contract import bodies, folded_map
from tests.fixtures.server.deletion_contract import cleared, head_of
from tests.fixtures.server.pushes import WREN, pushed
from tests.fixtures.server.store_contract import new_of
from tests.fixtures.server.tiny_disk import tiny_disk

from cairn_map.errors import BadInputError, ConflictError, NotFoundError
from cairn_server.operations.serve import main
from cairn_server.store.sqlite import store as sqlite_store
from cairn_server.store.sqlite.files.compaction import compact
from cairn_server.store.sqlite.retention import clear_part
from cairn_server.store.sqlite.store import FILE_NAME, SqliteStore
from cairn_server.store.store_rows import MapRow

PAGE_BYTES = 16384
COMMITS = [pushed(n, n) for n in range(4)]


def of_size(n: int, size_bytes: int) -> bytes:
    """Bytes that no compression makes smaller; as a cell's would be."""
    return bytes(n + k & 255 for k in range(64)) * (size_bytes // 64)


def filled(store: SqliteStore, row: MapRow, *, pieces: int, first: int = 0, size_bytes: int = 200_000) -> None:
    """Put pieces of evidence of some size under a map's first commit."""

    def job(connection: apsw.Connection) -> None:
        number = connection.execute("SELECT min(number) FROM commits WHERE map = ?", (row.number,)).get
        connection.executemany(
            "INSERT INTO diff (commit_number, cell, body) VALUES (?, ?, ?)",
            [(number, 1000 + n, of_size(n, size_bytes)) for n in range(first, first + pieces)],
        )

    store._writer.run(job)


@pytest.fixture
def store(tmp_path: Path) -> Iterator[SqliteStore]:
    made = SqliteStore(tmp_path)
    yield made
    made.close()


def test_a_compacted_store_is_as_large_as_if_the_deleted_map_had_never_been(tmp_path: Path) -> None:
    sizes, held = {}, {}
    for name in ("with", "without"):
        store = SqliteStore(tmp_path / name)
        other = folded_map(store, *COMMITS)
        if name == "with":
            row = folded_map(store, *COMMITS)
            filled(store, row, pieces=40)
            store.delete_map(row, by="admin")
        held[name] = bodies(store, other)
        store.close()
        found = compact(tmp_path / name)
        sizes[name] = (tmp_path / name / FILE_NAME).stat().st_size
        assert found.after_bytes == sizes[name]
        assert found.before_bytes >= found.after_bytes
        store = SqliteStore(tmp_path / name)
        assert bodies(store, other) == held[name] == held["with"]
        store.close()
    assert abs(sizes["with"] - sizes["without"]) <= 4 * PAGE_BYTES


def test_a_kill_while_a_map_is_cleared_leaves_the_rest_to_the_next_start(tmp_path: Path) -> None:
    store = SqliteStore(tmp_path)
    row, other = folded_map(store, *COMMITS), folded_map(store, *COMMITS)
    held, head = bodies(store, other), head_of(store, other)
    store.delete_map(row, by="admin")
    steps = 0
    while store.clear_deleted(size_bytes_max=4000):
        store.close()  # each part is a transaction of its own: nothing is left half done
        store = SqliteStore(tmp_path)
        steps += 1
        assert (bodies(store, other), head_of(store, other)) == (held, head)
    assert steps > 5
    with pytest.raises(NotFoundError):
        head_of(store, row)
    store.close()


def test_a_running_server_gives_unused_room_back_step_by_step(
    store: SqliteStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sqlite_store, "UNUSED_PAGES_MAX", 32)
    row, other = folded_map(store, *COMMITS), folded_map(store, *COMMITS)
    held = bodies(store, other)
    filled(store, row, pieces=20)
    assert not store.health.shrink()  # nothing is unused
    store.delete_map(row, by="admin")
    cleared(store)
    unused = store.health.figures().unused_bytes
    assert unused > 4_000_000
    steps = 0
    while store.health.shrink():
        left = store.health.figures().unused_bytes
        assert unused - left <= sqlite_store.SHRINK_PAGES * PAGE_BYTES
        unused, steps = left, steps + 1
    assert (unused, steps > 2) == (0, True)
    assert bodies(store, other) == held
    store._writer.checkpoints._try(1000)
    assert (tmp_path / FILE_NAME).stat().st_size < 1_000_000


def test_a_little_unused_room_is_left_for_what_comes(store: SqliteStore) -> None:
    row = folded_map(store, *COMMITS)
    filled(store, row, pieces=10)
    store.delete_map(row, by="admin")
    cleared(store)
    assert store.health.figures().unused_bytes > 1_000_000
    assert not store.health.shrink()


def test_the_command_says_both_sizes_and_leaves_a_sound_store_of_its_owner_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    store = SqliteStore(tmp_path)
    row = folded_map(store, *COMMITS)
    filled(store, row, pieces=20)
    store.delete_map(row, by="admin")
    with pytest.raises(ConflictError, match=r"gives unused room back by itself; stop it") as refusal:
        main(["compact", "--data", str(tmp_path)])
    assert refusal.value.kind == "store_in_use"
    store.close()
    capsys.readouterr()
    assert main(["compact", "--data", str(tmp_path)]) == 0
    assert " before, 0." in capsys.readouterr().out
    assert (tmp_path / FILE_NAME).stat().st_mode & 0o777 == 0o600
    assert {path.name for path in tmp_path.iterdir()} == {FILE_NAME, "cairn.lock", "ended-tokens"}
    assert main(["check", "--data", str(tmp_path)]) == 0
    with pytest.raises(NotFoundError, match="has no store"):
        main(["compact", "--data", str(tmp_path / "nowhere")])


def test_an_older_store_gives_room_back_by_itself_once_it_was_compacted(tmp_path: Path) -> None:
    store = SqliteStore(tmp_path)
    row = folded_map(store, *COMMITS)
    store.close()
    connection = apsw.Connection(str(tmp_path / FILE_NAME))
    connection.execute("PRAGMA journal_mode = DELETE; PRAGMA auto_vacuum = NONE; VACUUM").fetchall()
    assert connection.pragma("auto_vacuum") == 0
    connection.close()
    compact(tmp_path)
    store = SqliteStore(tmp_path)
    with store._readers.reading() as reader:
        assert reader.pragma("auto_vacuum") == sqlite_store.INCREMENTAL
    assert store.append(row, new_of(pushed(0, 7, WREN)))
    store.close()


@pytest.mark.processes
def test_compacting_on_a_full_disk_changes_nothing(tmp_path: Path) -> None:
    with tiny_disk(tmp_path / "disk", size_mb=8) as disk:
        data = disk.folder / "data"
        store = SqliteStore(data)
        row = folded_map(store, *COMMITS)
        held = bodies(store, row)
        for n in (0, 10):  # half at a time, as the log needs room, too
            filled(store, row, pieces=10, first=n)
            store.close()
            store = SqliteStore(data)
        store.close()
        with pytest.raises(BadInputError, match="no room") as refusal:
            compact(data)
        assert refusal.value.kind == "disk_full"
        store = SqliteStore(data)
        assert bodies(store, row) == held
        store.close()


def test_a_part_of_a_map_is_no_larger_than_it_may_be(store: SqliteStore) -> None:
    row = folded_map(store, *COMMITS)
    filled(store, row, pieces=30)
    store.delete_map(row, by="admin")

    def count(connection: apsw.Connection) -> int:
        return int(connection.execute("SELECT count(*) FROM diff").get)

    before = store._writer.run(count)
    while store._writer.run(lambda connection: clear_part(connection, size_bytes_max=1_000_000)):
        after = store._writer.run(count)
        assert before - after <= 5 + len(COMMITS) * 9
        before = after
