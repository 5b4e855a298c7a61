"""`cairn serve check`: every kind of damage is found and named; what the log still tells is repaired."""

import hashlib
from collections.abc import Callable
from pathlib import Path

import apsw
import pytest
from tests.fixtures.map.marks import attached, mark, mark_commit
from tests.fixtures.server.live import Live
from tests.fixtures.server.pushes import WREN, pushed, read, sum_of

from cairn_map.commits.ids import Author, Incarnation
from cairn_map.errors import ConflictError, DamagedDataError
from cairn_server.operations.serve import main
from cairn_server.store.sqlite.store import FILE_NAME, SqliteStore

COMMITS = [pushed(n, 0, scans=99) for n in range(3)] + [pushed(0, 1, WREN)]
Check = Callable[..., tuple[int, str]]
RETRACT = pushed(3, 0, cells={}, retracts=[COMMITS[0]])
NAMES = ("map0", "map1")
WREN_AGAIN = Author(WREN.robot, Incarnation("00000000000000cc"))


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A store with two equal maps."""
    folder: Path = tmp_path_factory.mktemp("sound")
    with Live(folder) as live:
        for _ in NAMES:
            row = live.new_map()
            for commit in (*COMMITS, RETRACT):
                live.push(row, commit)
            live.folded(row)
    return (folder / FILE_NAME).read_bytes()


@pytest.fixture
def folder(sound: bytes, tmp_path: Path) -> Path:
    """A copy of it to be damaged."""
    (tmp_path / FILE_NAME).write_bytes(sound)
    return tmp_path


@pytest.fixture
def check(folder: Path, capsys: pytest.CaptureFixture[str]) -> Check:
    """Run the command: 0 or 6, and what it said."""

    def run(*options: str) -> tuple[int, str]:
        code = 0
        try:
            main(["check", "--data", str(folder), *options])
        except DamagedDataError as exc:
            assert exc.kind == "damaged_store"
            code = 6
        return code, capsys.readouterr().out

    return run


def damage(folder: Path, statement: str) -> None:
    connection = apsw.Connection(str(folder / FILE_NAME))
    connection.execute(statement)
    assert connection.changes() == 1
    connection.close()


def cells_of(folder: Path, name: str) -> object:
    with Live(folder) as live:
        return read(live.cells(live.service.store.map(name)))


def test_a_sound_store_is_said_to_be_sound(check: Check, folder: Path) -> None:
    assert check() == (0, "2 maps, 10 commits, 6 cells: all sound\n")
    assert check("--repair")[0] == 0


@pytest.mark.parametrize(
    ("statement", "complaint"),
    [
        ("UPDATE cell SET body = x'00' WHERE number = 1", "map0: cell"),
        ("UPDATE cell SET digest = zeroblob(32) WHERE number = 1", "does not have its digest"),
        ("UPDATE cell SET fingerprint = zeroblob(16) WHERE number = 1", "does not have its fingerprint"),
        (
            "UPDATE cell SET (digest, fingerprint, body) = (SELECT digest, fingerprint, body FROM cell AS c"
            " WHERE c.number = 2) WHERE number = 1",
            "at rest: expected cell",
        ),
    ],
)
def test_a_damaged_cell_is_found_and_made_anew(check: Check, folder: Path, statement: str, complaint: str) -> None:
    damage(folder, statement)
    code, said = check()
    assert code == 6
    assert complaint in said
    assert said.startswith("map0: cell ")
    code, said = check("--repair")
    assert code == 0, said
    assert "rebuilt from its commits" in said
    assert check()[0] == 0
    assert cells_of(folder, "map0") == sum_of([*COMMITS, RETRACT])


@pytest.mark.parametrize(
    ("statement", "complaint"),
    [
        ("INSERT INTO vector_mark VALUES (1, 2, '{}')", "it does not name the commits"),
        ("UPDATE map SET cells = 99 WHERE number = 1", "are not those of its"),
        ("UPDATE map SET corners = NULL WHERE number = 1", "are not those of its"),
        ("UPDATE map SET fingerprint = zeroblob(16) WHERE number = 1", "is not the sum of its cells"),
        (
            "UPDATE tile SET fingerprint = zeroblob(16) WHERE (map, tile) = (SELECT map, max(tile) FROM tile)",
            "has not the sums of its cells",
        ),
    ],
)
def test_a_sum_that_is_wrong_is_found_and_computed_again(
    check: Check, folder: Path, statement: str, complaint: str
) -> None:
    damage(folder, statement)
    code, said = check()
    assert (code, complaint in said) == (6, True), said
    code, said = check("--repair")
    assert (code, "computed again" in said) == (0, True)
    assert check()[0] == 0
    assert cells_of(folder, "map0") == sum_of([*COMMITS, RETRACT])


@pytest.mark.parametrize(
    ("statement", "complaint"),
    [
        (
            "UPDATE mark SET record = replace(record, 'lamp', 'lift') WHERE n = 0 AND record IS NOT NULL",
            "mark {key}:0 is not in the map as",
        ),
        ("UPDATE mark SET record = NULL WHERE n = 1", "mark {key}:1 is not in the map as"),
        ("DELETE FROM mark WHERE n = 1", "mark {key}:1 is not in the map as"),
        ("UPDATE mark SET n = 7 WHERE n = 1", "mark {key}:7 is in the map, and of no commit"),
        ("INSERT INTO retracted VALUES (1, '{key}')", "mark {key}:0 is in the map, and of no commit"),
    ],
)
def test_marks_that_are_not_those_of_their_commits_are_found(
    check: Check, folder: Path, statement: str, complaint: str
) -> None:
    commit = mark_commit(0, mark(), mark("door"), author=WREN_AGAIN)
    gone = mark_commit(1, mark("gone"), author=WREN_AGAIN)
    with Live(folder) as live:
        row = live.service.store.map("map0")
        for each in (commit, gone, mark_commit(2, retracts=(f"{WREN_AGAIN}.1",), author=WREN_AGAIN)):
            live.push(row, each).raise_for_status()
        live.folded(row)
    assert check()[0] == 0
    damage(folder, statement.replace("{key}", str(commit.id)))
    code, said = check()
    assert (code, complaint.replace("{key}", str(commit.id)) in said) == (6, True), said


def test_an_attachment_that_is_damaged_is_found_dropped_and_wanted_again(check: Check, folder: Path) -> None:
    with Live(folder) as live:
        row = live.service.store.map("map0")
        live.push(row, mark_commit(0, attached(b"picture"), attached(b"later"), author=WREN_AGAIN)).raise_for_status()
        sha = hashlib.sha256(b"picture").hexdigest()
        path = f"/maps/map0/main/attachments/{sha}"
        live.http.patch(path, params={"total": 7, "offset": 0}, content=b"picture").raise_for_status()
        live.folded(row)
    assert check() == (0, "2 maps, 11 commits, 6 cells, 1 attachments (1 did not come yet): all sound\n")
    damage(folder, "UPDATE attachment_part SET body = CAST('pictures' AS BLOB)")
    code, said = check()
    assert (code, said) == (6, f"map0: attachment {sha} does not have its SHA-256\n")
    assert check("--repair")[0] == 0
    assert check() == (0, "2 maps, 11 commits, 6 cells, 0 attachments (2 did not come yet): all sound\n")


def test_a_cell_that_lacks_a_commit_is_found_though_its_bytes_are_sound(check: Check, folder: Path) -> None:
    with Live(folder) as live:
        row = live.service.store.map("map1")
        live.push(row, pushed(9, 0))
        live.folded(row)
    damage(
        folder,
        "UPDATE cell SET (digest, fingerprint, body, voxels, size_bytes) = (SELECT digest, fingerprint, body, voxels,"
        " size_bytes FROM cell AS other WHERE other.cell = cell.cell AND other.map = 2) WHERE number = 1",
    )
    code, said = check()
    assert (code, "is not the sum of its commits" in said) == (6, True)
    assert check("--repair")[0] == 0
    assert check()[0] == 0


@pytest.mark.parametrize(
    ("statement", "complaint"),
    [
        ("UPDATE log SET chain = zeroblob(16) WHERE map = 1 AND seq = 2", "entry 2 does not continue the chain"),
        ("DELETE FROM log WHERE map = 1 AND seq = 2", "entry 2 is not there"),
        ("DELETE FROM log WHERE map = 1 AND seq = 6", "it ends at 5, the head is"),
        ("UPDATE map SET chain = zeroblob(16) WHERE number = 1", "the head is"),
        (
            "UPDATE commits SET meta = CAST(CAST(meta AS TEXT) || ' ' AS BLOB) WHERE number = 2",
            "does not have its SHA-256",
        ),
        ("UPDATE diff SET body = x'00' WHERE number = 1", "commit mole."),
    ],
)
def test_what_no_repair_can_heal_is_found_and_stays_found(
    check: Check, folder: Path, statement: str, complaint: str
) -> None:
    damage(folder, statement)
    code, said = check()
    assert code == 6
    assert complaint in said
    assert all(line.startswith("map0: ") for line in said.splitlines())
    assert check("--repair")[0] == 6


def forget(folder: Path) -> int:
    """The store keeps no evidence but the last version of the map; how many commits' went."""
    store = SqliteStore(folder)
    try:
        return sum(store.forget_evidence(row, before_s=float("inf"), limit=100) for row in store.maps())
    finally:
        store.close()


def test_a_cell_whose_commits_are_gone_too_is_set_aside(check: Check, folder: Path) -> None:
    damage(folder, "UPDATE cell SET body = x'00' WHERE number = 1")
    forget(folder)
    code, said = check("--repair")
    assert code == 6
    assert "cannot be rebuilt from the log" in said
    assert "not kept any more" in said


def test_evidence_that_is_not_kept_any_more_is_no_damage(check: Check, folder: Path) -> None:
    gone = forget(folder)
    code, said = check()
    assert code == 0
    assert f"{gone} commits' evidence is not kept any more" in said


def test_damaged_pages_are_found(check: Check, folder: Path) -> None:
    path = folder / FILE_NAME
    data = bytearray(path.read_bytes())
    connection = apsw.Connection(str(path))
    page = int(connection.execute("SELECT rootpage FROM sqlite_master WHERE name = 'commits_folded'").get)
    connection.close()
    data[(page - 1) * 16384 + 8 : (page - 1) * 16384 + 64] = bytes(56)
    path.write_bytes(data)
    code, said = check()
    assert code == 6
    assert said.startswith("file: ")


def test_it_looks_beside_a_running_server_but_repairs_only_a_stopped_one(check: Check, folder: Path) -> None:
    with Live(folder) as live:
        row = live.service.store.map("map0")
        for n in range(10, 20):
            live.push(row, pushed(n, n))
        assert check()[0] == 0
        with pytest.raises(ConflictError) as refused:
            check("--repair")
        assert refused.value.kind == "store_in_use"
