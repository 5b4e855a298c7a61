"""A robot's file that somebody else wrote: refused in one sentence that names it, before it is read through."""

from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import apsw
import pytest

from cairn_client.folders.sqlite_glance import glance
from cairn_client.replica.replica_schema import COLUMNS_SINCE, STEPS, VERSION
from cairn_client.replica.replica_state import ReplicaState, RobotKeys, Successors
from cairn_client.replica.replica_store import FILE_NAME, ReplicaStore
from cairn_map.commits.ids import Author, CommitId, Incarnation, RobotName
from cairn_map.errors import BadInputError, DamagedDataError

MOLE = Author(RobotName("mole"), Incarnation("0123456789abcdef"))
ENDLESS = "WITH RECURSIVE c(n) AS (SELECT 1 UNION ALL SELECT n + 1 FROM c)"
COMMIT = (
    "INSERT INTO commits (robot, incarnation, n, sha, cells, data)"
    " VALUES ('mole', '0123456789abcdef', 0, x'00', {}, {})"
)


def changed(folder: Path, *statements: str) -> Path:
    """A robot's folder, and what somebody did to its file."""
    ReplicaStore(folder).close()
    with closing(apsw.Connection(str(folder / FILE_NAME))) as connection:
        for statement in statements:
            connection.execute(statement)
    return folder


def open_and_read(folder: Path) -> None:
    store = ReplicaStore(folder)
    try:
        store.commits()
        store.cells()
    finally:
        store.close()


def assert_refused(folder: Path, read: Callable[[Path], object]) -> None:
    with pytest.raises(DamagedDataError) as caught:
        read(folder)
    assert caught.value.kind == "damaged_store"
    assert str(folder / FILE_NAME) in caught.value.message


@pytest.mark.parametrize("read", [open_and_read, glance])
@pytest.mark.parametrize(
    "change",
    [
        f"ALTER TABLE meta RENAME TO other; CREATE VIEW meta AS {ENDLESS} SELECT n AS key, n AS value FROM c",
        "CREATE TRIGGER z BEFORE INSERT ON cell BEGIN DELETE FROM commits; END",
        "ALTER TABLE commits ADD COLUMN more AS (zeroblob(90))",
        "DROP TABLE cell",
        COMMIT.format("'[]'", "'text'"),
    ],
)
def test_a_file_of_another_form_is_refused(read: Callable[[Path], object], change: str, tmp_path: Path) -> None:
    assert_refused(changed(tmp_path / "robot", change), read)


@pytest.mark.parametrize(
    "change",
    [
        COMMIT.format("'[1'", "NULL"),
        COMMIT.format("'7'", "NULL"),
        COMMIT.format("'[{}]'", "NULL"),
        COMMIT.format("CAST(x'80' AS TEXT)", "NULL"),
        "INSERT INTO meta VALUES ('age_s', 'x')",
        "INSERT INTO coverage VALUES (1, replace(hex(zeroblob(50000)), '0', '['))",
        "INSERT INTO coverage VALUES (1, '[[]]')",
    ],
)
def test_a_value_that_cannot_be_read_is_said_with_its_file(change: str, tmp_path: Path) -> None:
    assert_refused(changed(tmp_path / "robot", change), open_and_read)


def test_a_text_that_cannot_be_read_is_said_with_its_file(tmp_path: Path) -> None:
    folder = changed(
        tmp_path / "robot",
        "INSERT INTO meta VALUES ('geometry', '{'), ('mode', 'x'), ('limits', '[]'), ('drawn', 'NaN')",
    )
    store = ReplicaStore(folder)
    try:
        state = ReplicaState(store)
        for name in ("geometry", "mode", "limits", "drawn"):
            assert_refused(folder, lambda _, name=name: getattr(state, name))
        store.put(f"signing_key.{MOLE.incarnation}", "no key")
        assert_refused(folder, lambda _: RobotKeys(state, MOLE.robot).has(MOLE.incarnation))
    finally:
        store.close()


def test_commits_that_come_after_each_other_end_in_an_error(tmp_path: Path) -> None:
    store = ReplicaStore(tmp_path / "robot")
    try:
        one, other = CommitId(MOLE, 1), CommitId(MOLE, 2)
        store.put(f"successor:{one}", str(other))
        assert Successors(store).latest(one) == other
        store.put(f"successor:{other}", str(one))
        assert_refused(tmp_path / "robot", lambda _: Successors(store).latest(one))
    finally:
        store.close()


def test_files_of_all_versions_have_the_form_that_is_checked(tmp_path: Path) -> None:
    assert set(STEPS) == set(range(1, VERSION))
    for version in range(1, VERSION + 1):
        later = [(table, name) for (table, name), since in COLUMNS_SINCE.items() if since > version]
        drops = [f"ALTER TABLE commits DROP COLUMN {name}" for table, name in later if table == "commits"]
        drops += ["DROP TABLE delta"] if any(table == "delta" for table, _ in later) else []
        folder = changed(tmp_path / str(version), *drops, f"PRAGMA user_version = {version}")
        assert glance(folder).commits == ()
        open_and_read(folder)
    with pytest.raises(BadInputError, match=f"has version {VERSION + 1}"):
        open_and_read(changed(tmp_path / "new", f"PRAGMA user_version = {VERSION + 1}"))
