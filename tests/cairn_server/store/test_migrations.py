"""Stores of older versions, as they were written then, open and go on."""

import json
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import apsw
import numpy as np
import pytest
from tests.fixtures.map.made import SMALL
from tests.fixtures.server import signatures
from tests.fixtures.server.answers import kind_of
from tests.fixtures.server.commit_contract import bodies, folded_map
from tests.fixtures.server.epoch_contract import EPOCHS, cell_of, commit_in, fold_by_hand, map_with_epochs, totals_of
from tests.fixtures.server.live import Live
from tests.fixtures.server.old_stores import OLD_COMMITS, OLD_RETRACTS, unpacked
from tests.fixtures.server.pushes import KEYS, MOLE, WREN, pushed, read, sum_of
from tests.fixtures.server.shares_contract import author_of, regions_of
from tests.fixtures.server.store_contract import new_of

from cairn_map.commits.ids import Author, Incarnation
from cairn_map.errors import BadInputError, DeniedError
from cairn_map.evidence.evidence import COUNT_MAX, SUM_MAX, packed_evidence
from cairn_server.folding.cell_cache import CellCache
from cairn_server.folding.folding import fold_pending
from cairn_server.store import shares
from cairn_server.store.admission import Grounds
from cairn_server.store.sqlite import schema
from cairn_server.store.sqlite.schema import STEPS, ensure_schema
from cairn_server.store.sqlite.store import FILE_NAME, SqliteStore
from cairn_server.store.store_rows import CellRow

HEADS = {"v1.sqlite.zst": "4243ca94aa4e5ac2bca4157d97a5ba33.10.0c13ae5711ebe0d9d9c007e2badf0262"}


def rows_of(live: Live) -> list[CellRow]:
    with live.service.store.snapshot(live.service.store.map("lab")) as snapshot:
        return list(snapshot.cells())


@pytest.mark.parametrize("name", HEADS)
def test_an_older_store_opens_with_all_that_it_held_and_goes_on(name: str, tmp_path: Path) -> None:
    unpacked(name, tmp_path)
    more = pushed(4, 2, MOLE, retracts=[OLD_COMMITS[1], OLD_COMMITS[3]])
    with Live(tmp_path) as live:
        row = live.service.store.map("lab")
        with live.service.store.snapshot(row) as snapshot:
            assert str(snapshot.head) == HEADS[name]
            seq = snapshot.head.seq
        assert read(live.cells(row)) == sum_of([*OLD_COMMITS, *OLD_RETRACTS])
        assert {cell.hottest_k for cell in rows_of(live)} == {None}  # no version wrote down how hot they are
        assert (row.epoch_s, {cell.history_bytes for cell in rows_of(live)}) == (None, {0})
        assert [branch.name for branch in live.service.store.branches(row)] == ["mole"]
        assert live.push(row, OLD_COMMITS[2]).status_code == 200
        assert live.push(row, more).status_code == 201
        live.folded(row)
        told = [cell.key for cell in rows_of(live) if cell.hottest_k is not None]
        assert told == [cell.key for cell in rows_of(live) if cell.lm > seq] != []
        assert read(live.cells(row)) == sum_of([*OLD_COMMITS, *OLD_RETRACTS, more])
    with Live(tmp_path) as live:  # and once more, now as a store of this version
        assert read(live.cells(live.service.store.map("lab"))) == sum_of([*OLD_COMMITS, *OLD_RETRACTS, more])


WITHOUT_EPOCHS = """
DROP TABLE assignment;
DROP TABLE attachment;
DROP TABLE attachment_part;
DROP TABLE mark;
ALTER TABLE author DROP COLUMN marks;
DROP TABLE gone_map;
DROP TABLE gone_token;
ALTER TABLE author DROP COLUMN kept_bytes;
DROP INDEX commits_epoch;
ALTER TABLE audit DROP COLUMN client;
ALTER TABLE age DROP COLUMN clock;
DROP INDEX cell_listed;
ALTER TABLE map DROP COLUMN epoch_s;
ALTER TABLE map DROP COLUMN history_bytes;
ALTER TABLE commits DROP COLUMN epoch;
ALTER TABLE cell DROP COLUMN history_bytes;
ALTER TABLE tile DROP COLUMN history_bytes;
CREATE INDEX cell_listed ON cell (map, cell, lm, digest, fingerprint, voxels, size_bytes, gone_seq, hottest_k);
PRAGMA user_version = 15;
"""
"""SQL that takes the steps of epochs, their clock, addresses and deletion (which only has fewer references) back."""


def test_a_store_of_before_epochs_opens_as_it_was_and_takes_maps_with_them(tmp_path: Path) -> None:
    def state(store: SqliteStore) -> tuple[object, ...]:
        row = store.map(name)
        with store.snapshot(row) as snapshot:
            cells = [snapshot.cell(cell.key) for cell in snapshot.cells()]
            return row, snapshot.head, cells, snapshot.totals(), store.pending(row, limit=9, size_bytes_max=1 << 30)

    with closing(SqliteStore(tmp_path)) as store:
        row = folded_map(store, pushed(0, 0), pushed(1, 1))
        store.append(row, new_of(pushed(2, 2)))
        name = row.name
        before = state(store)
    connection = apsw.Connection(str(tmp_path / FILE_NAME))
    connection.execute(WITHOUT_EPOCHS)
    connection.close()
    with closing(SqliteStore(tmp_path)) as store:
        assert state(store) == before
        with_epochs = map_with_epochs(store)
        store.append(with_epochs, commit_in(EPOCHS[3], 0))
        fold_by_hand(store, with_epochs, [cell_of(KEYS[0], lm=1, history_bytes=7)])
        store.append(row, new_of(pushed(3, 0)))
        assert fold_pending(store, row, CellCache(SMALL), limit=9) == 2
    with closing(SqliteStore(tmp_path)) as store:
        assert read(bodies(store, row)) == sum_of([pushed(n, n) for n in range(3)] + [pushed(3, 0)])
        assert totals_of(store, store.map(with_epochs.name)).history_bytes == 7


@pytest.mark.parametrize("version", range(len(STEPS)))
def test_a_store_of_any_version_gets_the_tables_of_a_new_one(version: int, tmp_path: Path) -> None:
    new, old = (apsw.Connection(str(tmp_path / name)) for name in ("new", "old"))
    ensure_schema(new)
    for step in STEPS[:version]:
        old.execute(step)
    old.execute(f"PRAGMA user_version = {version}" if version else "")
    ensure_schema(old)
    schemas = [list(c.execute("SELECT type, name, sql FROM sqlite_master ORDER BY name")) for c in (new, old)]
    assert schemas[0] == schemas[1] and schemas[0]


def test_a_map_of_an_older_store_that_only_seemed_full_takes_commits_and_gives_back_what_is_new(tmp_path: Path) -> None:
    connection = apsw.Connection(str(unpacked("v1.sqlite.zst", tmp_path)))
    [(tops,)] = connection.execute("SELECT tops FROM map")
    full = [COUNT_MAX, *json.loads(tops)[1:-1], SUM_MAX]  # as after commits that were taken out long ago
    connection.execute("UPDATE map SET tops = ?", (json.dumps(full),))
    connection.close()
    with Live(tmp_path) as live:
        row = live.service.store.map("lab")
        assert live.service.store.shares.regions(row, "mole") == []
        more = pushed(4, 2, MOLE)
        assert live.push(row, more).status_code == 201
        assert live.service.store.shares.regions(row, "mole") == regions_of(more)
        old = next(
            commit for commit in OLD_COMMITS if commit.id not in {t for r in OLD_RETRACTS for t in r.meta.retracted_ids}
        )
        assert live.retract(row, more, old).status_code == 201
        live.folded(row)
        assert live.service.store.shares.regions(row, "mole") == []
    connection = apsw.Connection(str(tmp_path / FILE_NAME))
    [(measured,)] = connection.execute("SELECT tops FROM map")
    assert all(0 < now < before for now, before in zip(json.loads(measured)[::12], full[::12], strict=True))


def test_a_map_of_an_older_store_that_is_full_takes_no_evidence_until_some_is_retracted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    connection = apsw.Connection(str(unpacked("v1.sqlite.zst", tmp_path)))
    connection.execute("UPDATE map SET tops = ?", (json.dumps([COUNT_MAX] * (2 + SMALL.plane_count)),))
    connection.close()
    monkeypatch.setattr(shares, "ROBOTS_MAX", 1)
    monkeypatch.setattr(shares, "COUNT_MAX", 2)  # half of it is less than what the cells hold
    seen_once = packed_evidence(np.array([9], np.uint32), np.array([[1, 0]]), np.zeros((1, SMALL.plane_count)), SMALL)
    small = pushed(4, 2, MOLE, cells={KEYS[0]: seen_once})
    with Live(tmp_path) as live:
        row = live.service.store.map("lab")
        refused = live.push(row, small)
        assert kind_of(refused) == "evidence_overflow" and "start the server again" in refused.json()["detail"]
        assert live.retract(row, *OLD_COMMITS).status_code == 201
        live.folded(row)
    with Live(tmp_path) as live:
        assert live.push(row, small).status_code == 201


def test_a_store_with_more_robots_than_there_are_shares_begins_their_numbers_again(tmp_path: Path) -> None:
    connection = apsw.Connection(str(unpacked("v1.sqlite.zst", tmp_path)))
    connection.executemany(
        "INSERT INTO author (map, robot, incarnation, top, intervals) VALUES (1, ?, '00', 0, 1)",
        [(f"robot{n}",) for n in range(shares.ROBOTS_MAX)],
    )
    connection.close()
    with Live(tmp_path) as live:
        row = live.service.store.map("lab")
        assert [share.robot for share in live.service.store.shares.of(row)] == [shares.RESERVE]
        assert kind_of(live.push(row, pushed(4, 2, MOLE))) == "author_closed"
        assert live.push(row, pushed(0, 2, author_of("mole", 9))).status_code == 201


def test_a_store_of_a_newer_version_is_refused_and_left_alone(tmp_path: Path) -> None:
    path = unpacked("v1.sqlite.zst", tmp_path)
    connection = apsw.Connection(str(path))
    connection.execute(f"PRAGMA user_version = {len(STEPS) + 1}")
    connection.close()
    before = path.read_bytes()
    with pytest.raises(BadInputError, match="update it"):
        SqliteStore(tmp_path)
    assert path.read_bytes() == before


def test_a_robot_of_an_older_store_keeps_its_token(tmp_path: Path) -> None:
    connection = apsw.Connection(str(unpacked("v1.sqlite.zst", tmp_path)))
    [(kept,)] = connection.execute("SELECT token_hash FROM branch")
    connection.close()
    store = SqliteStore(tmp_path)
    token = store.tokens.of_hash(kept)
    assert token is not None
    assert (token.name, token.role, token.map_name, token.robot) == ("lab:mole", "robot", "lab", "mole")
    store.deregister(store.map("lab"), "mole")
    assert store.tokens.of_hash(kept) is None
    store.close()


def test_the_names_of_an_older_store_are_bound_to_the_keys_that_they_have(tmp_path: Path) -> None:
    unpacked("v1.sqlite.zst", tmp_path)
    store = SqliteStore(tmp_path)
    row = store.map("lab")
    known = {key.author for key in store.keys.all(row)}
    assert known >= {MOLE, WREN}
    assert not any(key.is_proven or key.may_return for key in store.keys.all(row))  # no commit was signed then
    stranger = Author(MOLE.robot, Incarnation("e" * 16))
    relayed = replace(new_of(pushed(0, 0, stranger)), grounds=Grounds(signers=frozenset({stranger.incarnation})))
    with pytest.raises(DeniedError):
        store.append(row, relayed)
    own = replace(relayed, grounds=Grounds(is_own=True))  # of a robot that did not sign, and begins to
    assert store.append(row, own)
    store.close()


def test_a_key_that_signed_is_bound_as_one_when_the_store_is_brought_up_to_date(tmp_path: Path) -> None:
    with Live(tmp_path) as live:
        row = live.new_map()
        live.push(row, pushed(0, 0, signatures.MOLE), headers=signatures.signed(row, pushed(0, 0, signatures.MOLE)))
        live.push(row, pushed(0, 0, WREN))
    connection = apsw.Connection(str(tmp_path / FILE_NAME))
    connection.execute(f"DROP TABLE robot_key; {schema.KEYS}")
    connection.close()
    store = SqliteStore(tmp_path)
    assert {key.author: key.is_proven for key in store.keys.all(store.map(row.name))} == {
        signatures.MOLE: True,
        WREN: False,
    }
    store.close()
