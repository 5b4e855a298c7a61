"""Settling: bytes move to an object store and are what they were, through kills, races, losses and restores."""

from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from tests.fixtures.map.made import SMALL, random_evidence
from tests.fixtures.server.commit_contract import folded_map
from tests.fixtures.server.crowd_contract import all_at_once
from tests.fixtures.server.deadline import until
from tests.fixtures.server.deletion_contract import cleared
from tests.fixtures.server.evidence_contract import SOON, cells_of, fold, kept_bytes
from tests.fixtures.server.object_store import READER, ObjectPlace
from tests.fixtures.server.postgres import Database, PostgresServer, new_database
from tests.fixtures.server.pushes import KEYS, WREN, pushed
from tests.fixtures.server.settled_store import PLACE, ColdStore, SwitchedBucket, drain

from cairn_map.errors import BadInputError, UnreachableError
from cairn_map.evidence.grid import Cell, CellKey, cell_key
from cairn_server.folding.cells_at_rest import sound_cell
from cairn_server.settings import Settings
from cairn_server.store.objects.bucket import Bucket, open_bucket
from cairn_server.store.objects.cold_bytes import MARK, AwayError
from cairn_server.store.postgres.connections import Connection, Connections
from cairn_server.store.postgres.schema import BOUND_OLDEST, STEPS
from cairn_server.store.postgres.store import PgStore
from cairn_server.store.settling import settler
from cairn_server.store.settling.settler import Settler
from cairn_server.store.store_rows import CellRow, MapRow

pytestmark = [pytest.mark.processes, pytest.mark.slow]

COMMITS = [pushed(0, 0), pushed(0, 1, WREN), pushed(1, 2), pushed(1, 4, WREN)]


@pytest.fixture
def database(newest_postgres: PostgresServer) -> Database:
    """A database for one test."""
    return new_database(newest_postgres)


@pytest.fixture
def store(database: Database) -> Iterator[ColdStore]:
    """A store of one test."""
    with closing(ColdStore(database.url, SwitchedBucket())) as made:
        yield made


def contents(store: PgStore, row: MapRow) -> tuple[dict[CellKey, CellRow], dict[CellKey, list[bytes | None]]]:
    """All cells, and what each commit added to them."""
    return cells_of(store, row), {key: kept_bytes(store, row, key) for key in KEYS}


def named(database: Database) -> set[str]:
    """Objects that rows name."""
    found = database.execute("SELECT object FROM cell WHERE object IS NOT NULL UNION SELECT name FROM segment")
    assert set(found) >= set(database.execute("SELECT DISTINCT segment FROM diff WHERE segment IS NOT NULL"))
    return {str(name) for (name,) in found}


def dead(database: Database) -> set[str]:
    """Objects that are noted as dead."""
    return {str(name) for (name,) in database.execute("SELECT name FROM dead_object")}


def bytes_in_rows(database: Database) -> int:
    """Bytes of cells and evidence that are still in the database."""
    query = "SELECT (SELECT count(body) FROM cell) + (SELECT count(body) FROM diff)"
    return int(str(database.execute(query)[0][0]))


# What is moved


def test_what_is_at_rest_moves_and_is_read_as_before(store: ColdStore, database: Database) -> None:
    row = folded_map(store, *COMMITS)
    before = contents(store, row)
    assert bytes_in_rows(database) == 3 + 8
    store.settle(row)
    assert bytes_in_rows(database) == 0
    assert contents(store, row) == before
    assert store.bucket.objects() == named(database)
    assert not dead(database)
    for commit in COMMITS:
        found = store.folded(row, commit.id)
        assert found is not None
        assert dict(found.diff) == dict(commit.cells)


def test_only_tiles_that_did_not_change_after_an_entry_move(store: ColdStore, database: Database) -> None:
    row = folded_map(store, pushed(0, 0))
    with store.snapshot(row) as snapshot:
        to_seq = snapshot.head.seq
    fold(store, row, pushed(1, 0))
    drain(store.settler.settle_cells(row, to_seq=to_seq, age_s=0.0))
    assert not named(database)


def test_only_evidence_folded_before_an_age_moves(store: ColdStore, database: Database) -> None:
    row = folded_map(store, pushed(0, 0))
    drain(store.settler.settle_evidence(row, before_s=0.0, age_s=0.0))
    assert not named(database)


def test_a_map_at_rest_is_not_looked_at_again(store: ColdStore) -> None:
    row = folded_map(store, *COMMITS)
    assert row in store.settler.maps_at_rest(evidence_before_s=SOON)
    store.settle(row)
    assert not store.settler.maps_at_rest(evidence_before_s=SOON)
    fold(store, row, pushed(2, 0))
    assert store.settler.maps_at_rest(evidence_before_s=SOON) == [row]


def test_a_cell_that_changes_comes_back_and_its_object_is_dead(store: ColdStore, database: Database) -> None:
    row = folded_map(store, pushed(0, 0))
    store.settle(row)
    old = named(database)
    fold(store, row, pushed(1, 0))
    assert dead(database) == {name for name in old if name.startswith("cells/")}
    assert store.settler.delete_dead(before_s=0.0) == 0
    assert store.settler.delete_dead(before_s=SOON) == 2
    assert store.bucket.objects() == named(database) == {name for name in old if name.startswith("segments/")}


def test_a_segment_goes_with_its_last_piece(store: ColdStore, database: Database) -> None:
    row = folded_map(store, *COMMITS)
    store.settle(row)
    (segment,) = {name for name in named(database) if name.startswith("segments/")}
    assert store.forget_evidence(row, before_s=SOON, limit=3) == 3
    assert segment not in dead(database)
    assert store.forget_evidence(row, before_s=SOON, limit=3) == 1
    assert dead(database) == {segment}


def test_objects_of_a_deleted_map_are_dead_with_its_rows_and_go_in_time(store: ColdStore, database: Database) -> None:
    row, other = folded_map(store, *COMMITS), folded_map(store, *COMMITS)
    store.settle(other)
    kept = named(database)
    store.settle(row)
    own = named(database) - kept
    store.delete_map(row, by="admin")
    assert store.bucket.objects() == kept | own
    cleared(store, 1)
    assert (named(database), dead(database)) == (kept, own)
    before = contents(store, other)
    while store.settler.delete_dead(before_s=SOON):
        pass
    assert store.bucket.objects() == kept
    assert contents(store, other) == before


def test_evidence_that_was_pushed_again_is_here_again(store: ColdStore, database: Database) -> None:
    row = folded_map(store, pushed(0, 0))
    store.settle(row)
    store.forget_evidence(row, before_s=SOON, limit=9)
    fold(store, row, pushed(0, 0))
    found = store.folded(row, pushed(0, 0).id)
    assert found is not None
    assert dict(found.diff) == dict(pushed(0, 0).cells)


def test_a_large_map_moves_in_several_steps(
    store: ColdStore, database: Database, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cairn_server.store.settling.settler.SEGMENT_BYTES", 1)
    monkeypatch.setattr("cairn_server.store.settling.settler.CELLS_BYTES", 1)
    row = folded_map(store, *COMMITS)
    before = contents(store, row)
    store.settle(row)
    assert contents(store, row) == before
    assert len([name for name in store.bucket.objects() if name.startswith("segments/")]) == len(COMMITS)


def test_a_stop_costs_the_tiles_under_way_and_not_all_that_moved(
    store: ColdStore, database: Database, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cairn_server.store.settling.settler.TILES_AT_ONCE", 1)
    row = folded_map(store, pushed(0, 0))
    for n in range(1, 4):
        fold(store, row, pushed(n, n, cells={cell_key(Cell(40 * n, 0, 0)): random_evidence(n, SMALL, voxels=2)}))
    with store.snapshot(row) as snapshot:
        to_seq = snapshot.head.seq
    moves = store.settler.settle_cells(row, to_seq=to_seq, age_s=0.0)
    for _ in range(3):
        next(moves)
    ((mark,),) = database.execute("SELECT seq FROM settled")
    assert 0 < int(str(mark)) < to_seq
    drain(store.settler.settle_cells(row, to_seq=to_seq, age_s=0.0))
    assert database.execute("SELECT count(body) FROM cell") == [(0,)]
    assert database.execute("SELECT seq FROM settled") == [(to_seq,)]


# Kills and races


class KilledError(BaseException):
    """The end of a process at this point."""


@dataclass
class Kill:
    """A kill at the k-th step."""

    at: int
    steps: int = field(default=0)

    def step(self) -> None:
        """Count a step."""
        self.steps += 1
        if self.steps == self.at:
            raise KilledError


class DyingConnections(Connections):
    """Connections of a process that is killed."""

    def __init__(self, url: str, kill: Kill) -> None:
        super().__init__(url, limit=2)
        self._kill = kill

    @contextmanager
    def lent(self) -> Iterator[Connection]:
        """A connection, if the process lives."""
        self._kill.step()
        with super().lent() as connection:
            yield connection
        self._kill.step()


class DyingBucket(SwitchedBucket):
    """The bucket of a process that is killed."""

    def __init__(self, bucket: Bucket, kill: Kill) -> None:
        super().__init__()
        self._store = bucket._store
        self._kill = kill

    def put(self, name: str, data: bytes) -> None:
        """Write an object, if the process lives."""
        self._kill.step()
        super().put(name, data)
        self._kill.step()

    def delete(self, name: str) -> None:
        """Delete an object, if the process lives."""
        self._kill.step()
        super().delete(name)
        self._kill.step()


def test_a_kill_at_any_step_loses_nothing_and_leaves_no_object_that_is_not_noted(
    store: ColdStore, database: Database
) -> None:
    row = folded_map(store, *COMMITS[:2])
    expected = contents(store, row)
    kills = 0
    while True:
        kill = Kill(kills + 1)
        with closing(DyingConnections(database.url, kill)) as connections:
            settler = Settler(connections, DyingBucket(store.bucket, kill), holder="dying")
            try:
                store.settle(row, settler)
                settler.delete_dead(before_s=SOON)
                break
            except KilledError:
                kills += 1
        assert contents(store, row) == expected
        assert store.bucket.objects() <= named(database) | dead(database)
        # From the beginning each time, or all but the first steps would be done.
        database.execute("DELETE FROM settled")
        if kills % 3 == 0:
            fold(store, row, pushed(kills, kills))
            expected = contents(store, row)
        if kills % 24 == 0:
            # Or each kill would leave more to be deleted than the next one takes steps.
            store.settler.delete_dead(before_s=SOON)
    assert kills > 20
    store.settler.delete_dead(before_s=SOON)
    assert store.bucket.objects() == named(database)
    assert contents(store, row) == expected


def test_two_settlers_at_a_time_do_no_harm(store: ColdStore, database: Database) -> None:
    row = folded_map(store, *COMMITS)
    before = contents(store, row)
    others = [Settler(Connections(database.url, limit=2), store.bucket, holder=f"{n}") for n in range(4)]
    all_at_once([lambda other=other: store.settle(row, other) for other in others])
    assert contents(store, row) == before
    assert bytes_in_rows(database) == 0
    assert store.bucket.objects() == named(database) | dead(database)
    assert not named(database) & dead(database)
    for other in others:
        other.close()


def test_cells_that_another_settler_moved_between_two_looks_are_left_out(
    store: ColdStore, database: Database, monkeypatch: pytest.MonkeyPatch
) -> None:
    row = folded_map(store, *COMMITS)
    listed = settler._groups

    def moved_meanwhile(sizes: list[tuple[int, int]], bytes_max: int) -> Iterator[list[int]]:
        monkeypatch.setattr(settler, "_groups", listed)
        with closing(Settler(Connections(database.url, limit=2), store.bucket, holder="other")) as other:
            store.settle(row, other)
        return listed(sizes, bytes_max)

    monkeypatch.setattr(settler, "_groups", moved_meanwhile)
    before = contents(store, row)
    store.settle(row)
    assert contents(store, row) == before
    assert bytes_in_rows(database) == 0


def test_one_settler_works_at_a_time(store: ColdStore, database: Database) -> None:
    with closing(Settler(Connections(database.url, limit=2), store.bucket, holder="other")) as other:
        assert other.claim()
        assert other.claim()
        assert not store.settler.claim()
        other.release()
        assert store.settler.claim()


def test_a_program_that_is_too_old_for_its_database_settles_no_more(store: ColdStore, database: Database) -> None:
    assert store.settler.claim()
    database.execute(f"UPDATE cairn_schema SET oldest = {len(STEPS) + 1}")
    assert not store.settler.claim()


class PausedBucket(SwitchedBucket):
    """A bucket that does something else before it says that an object is written."""

    def __init__(self) -> None:
        super().__init__()
        self.meanwhile = lambda: None

    def put(self, name: str, data: bytes) -> None:
        """Write an object, and pause."""
        super().put(name, data)
        self.meanwhile()


def test_a_cell_that_changed_while_its_object_was_written_stays_here(database: Database) -> None:
    bucket = PausedBucket()
    with closing(ColdStore(database.url, bucket)) as store:
        row = folded_map(store, pushed(0, 0))
        with store.snapshot(row) as snapshot:
            to_seq = snapshot.head.seq
        rest = iter([lambda: fold(store, row, pushed(1, 0))])
        bucket.meanwhile = lambda: next(rest, lambda: None)()
        drain(store.settler.settle_cells(row, to_seq=to_seq, age_s=0.0))
        assert not named(database)
        assert bucket.objects() == dead(database)


def test_a_settler_that_slept_longer_than_the_grace_names_no_object_that_is_deleted(database: Database) -> None:
    bucket = PausedBucket()
    with closing(ColdStore(database.url, bucket)) as store:
        row = folded_map(store, *COMMITS)
        before = contents(store, row)
        bucket.meanwhile = lambda: drain(iter([store.settler.delete_dead(before_s=SOON)]))
        store.settle(row)
        assert not named(database)
        assert contents(store, row) == before
        # What was put after its note was gone is found by the listing.
        bucket.meanwhile = lambda: None
        drain(store.settler.note_unknown(age_s=0.0))
        store.settler.delete_dead(before_s=SOON)
        assert not bucket.objects()


def test_who_reads_an_older_state_finds_its_objects_within_the_grace(store: ColdStore) -> None:
    row = folded_map(store, pushed(0, 0))
    store.settle(row)
    before = cells_of(store, row)
    with store.snapshot(row) as snapshot:
        assert snapshot.head
        fold(store, row, pushed(1, 0))
        store.settler.delete_dead(before_s=0.0)
        assert {key: snapshot.cell(key) for key in before} == before
        # Without the grace it is lost; what is read is as damaged as it is.
        store.settler.delete_dead(before_s=SOON)
        assert {cell.body for key in before if (cell := snapshot.cell(key))} == {b""}


# Losses


def test_a_cell_whose_object_is_lost_is_rebuilt_from_the_log(store: ColdStore, database: Database) -> None:
    row = folded_map(store, *COMMITS)
    before = cells_of(store, row)
    drain(store.settler.settle_cells(row, to_seq=99, age_s=0.0))
    lost = min(named(database))
    store.bucket.delete(lost)
    healed: list[CellRow] = []
    with store.snapshot(row) as snapshot:
        for key in before:
            sound_cell(snapshot, key, row.layer, healed)
    assert [cell.body for cell in healed] == [before[healed[0].key].body]
    assert store.health.heal(row, healed[0])
    assert {key: cell.body for key, cell in cells_of(store, row).items()} == {k: c.body for k, c in before.items()}
    assert lost in dead(database)


def test_objects_that_a_restored_database_does_not_know_are_deleted_in_time(
    store: ColdStore, database: Database
) -> None:
    row = folded_map(store, *COMMITS)
    store.settle(row)
    before = contents(store, row)
    known = store.bucket.objects()
    store.bucket.put(f"cells/{row.number}/5/1.{'0' * 64}.0000000000000000", b"later")
    store.bucket.put(f"segments/{row.number}/{'0' * 32}", b"later")
    store.bucket.put("cells/of another program", b"not ours")
    assert sum(store.settler.note_unknown(age_s=10.0)) == 2
    assert sum(store.settler.note_unknown(age_s=99.0)) == 0
    assert store.settler.delete_dead(before_s=10.0) == 0
    assert store.settler.delete_dead(before_s=11.0) == 2
    assert store.bucket.objects() == {*known, "cells/of another program"}
    assert contents(store, row) == before


def test_a_cold_cell_is_found_to_be_read(store: ColdStore) -> None:
    assert store.settler.cold_cell(0.0) is None
    row = folded_map(store, *COMMITS)
    assert store.settler.cold_cell(0.0) is None
    store.settle(row)
    assert {store.settler.cold_cell(0.0) for _ in range(3)} == {(row, min(KEYS))}
    assert store.settler.cell_count() == len(KEYS)


def test_in_a_bucket_that_lost_everything_nothing_is_known_to_be_lost(store: ColdStore) -> None:
    row = folded_map(store, *COMMITS)
    store.settle(row)
    store.bucket.delete(MARK)
    for name in store.bucket.objects():
        store.bucket.delete(name)
    with store.snapshot(row) as snapshot, pytest.raises(AwayError):
        snapshot.cell(KEYS[0])
    with pytest.raises(AwayError):
        store.folded(row, COMMITS[0].id)


# Start


def refusal_of(url: str, bucket: Bucket, place: str = PLACE) -> BadInputError:
    """Error of a start."""
    with pytest.raises(BadInputError) as caught:
        ColdStore(url, bucket, place=place)
    return caught.value


def test_a_server_without_the_object_store_does_not_start_on_its_database(database: Database) -> None:
    ColdStore(database.url, SwitchedBucket()).close()
    with pytest.raises(BadInputError, match=f"start with --objects {PLACE}"):
        PgStore(database.url)


def test_the_bucket_of_another_store_is_refused(newest_postgres: PostgresServer, database: Database) -> None:
    bucket = SwitchedBucket()
    ColdStore(database.url, bucket).close()
    ColdStore(database.url, bucket).close()
    assert "of another store" in refusal_of(new_database(newest_postgres).url, bucket).message


def test_an_empty_bucket_is_refused_once_there_are_cold_bytes(database: Database) -> None:
    bucket = SwitchedBucket()
    with closing(ColdStore(database.url, bucket)) as store:
        assert store.settler.claim()
        store.settle(folded_map(store, *COMMITS))
    assert "does not have the bytes of this store" in refusal_of(database.url, SwitchedBucket()).message


def test_a_bucket_that_moved_is_the_same_if_its_objects_are(database: Database) -> None:
    bucket = SwitchedBucket()
    ColdStore(database.url, bucket).close()
    ColdStore(database.url, bucket, place="s3://moved/there").close()
    assert database.execute("SELECT url FROM object_store") == [("s3://moved/there",)]


def test_an_older_program_does_not_start_on_a_database_with_cold_bytes(database: Database) -> None:
    ColdStore(database.url, SwitchedBucket()).close()
    assert database.execute("SELECT oldest FROM cairn_schema") == [(BOUND_OLDEST,)]


def test_a_bucket_that_is_not_there_or_without_rights_is_refused(
    database: Database, object_place: ObjectPlace, monkeypatch: pytest.MonkeyPatch
) -> None:
    there = object_place.bucket
    missing = refusal_of(database.url, open_bucket("s3://there-is-none/maps"))
    assert missing.kind == "bad_objects"
    assert "AWS_ENDPOINT_URL" in missing.message
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", READER)
    assert "cannot write" in refusal_of(database.url, open_bucket(object_place.url)).message
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:1")
    assert "cannot write" in refusal_of(database.url, open_bucket(object_place.url)).message
    assert not list(there.names(""))


def test_a_real_bucket_keeps_gives_lists_and_deletes(object_place: ObjectPlace) -> None:
    bucket = object_place.bucket
    bucket.put(MARK, b"cairn")
    bucket.put_all([("cells/1/2/a", b"123456"), ("cells/1/2/b", b"")])
    assert bucket.get("cells/1/2/a") == b"123456"
    assert bucket.get("cells/1/2/b") == b""
    assert bucket.part("cells/1/2/a", start=1, size_bytes=2) == b"23"
    assert bucket.part("cells/1/2/a", start=1, size_bytes=9) is None
    assert bucket.part("cells/1/2/a", start=1, size_bytes=0) == b""
    assert sorted(name for page in bucket.names("cells") for name in page) == ["cells/1/2/a", "cells/1/2/b"]
    assert [page for page in bucket.names("segments") if page] == []
    for _ in range(2):
        bucket.delete("cells/1/2/a")
    assert bucket.get("cells/1/2/a") is None
    assert bucket.part("cells/1/2/a", start=1, size_bytes=2) is None


def test_objects_are_a_database_s(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="SQLite keeps"):
        Settings(folder=tmp_path, objects=PLACE).check_store()


# Room


def test_pushes_are_refused_before_the_database_is_full(database: Database, caplog: pytest.LogCaptureFixture) -> None:
    PgStore(database.url).close()  # with the tables, which take a part of it
    ((size_bytes,),) = database.execute("SELECT pg_database_size(current_database())")
    used = int(str(size_bytes))
    with closing(PgStore(database.url, size_bytes_max=2 * used)) as store:
        store.health.check_space(1)
        assert store.health.figures().free_bytes
        assert not caplog.records
    with closing(PgStore(database.url, size_bytes_max=int(used / 0.8))) as store:
        store.health.check_space(1)
        store.health.check_space(1)
        assert len(caplog.records) == 1
        with pytest.raises(UnreachableError, match=r"of .* MB"):
            store.health.check_space(used)
    with closing(PgStore(database.url, size_bytes_max=used)) as store:
        with pytest.raises(UnreachableError) as caught:
            store.health.check_space(1)
        assert caught.value.kind == "disk_full"


LARGE = """
    INSERT INTO diff (map, commit_number, cell, body)
    SELECT 1, n, 1, (SELECT string_agg(sha256(k::text::bytea), '') FROM generate_series(1, 8192) AS k)
    FROM generate_series({first}, {last}) AS n"""
"""SQL of evidence of 256 kB each."""


def test_room_that_moved_bytes_left_behind_is_room_again(database: Database) -> None:
    PgStore(database.url).close()
    ((size_bytes,),) = database.execute("SELECT pg_database_size(current_database())")
    room = int(str(size_bytes)) + (16 << 20)
    with closing(PgStore(database.url, size_bytes_max=room)) as store:
        database.execute(LARGE.format(first=1, last=64))
        with pytest.raises(UnreachableError, match=r"of .* MB"):
            store.health.check_space(1)
    # The last one stays, so that the file does.
    database.execute("UPDATE diff SET body = NULL, segment = 'segments/1' WHERE commit_number < 64")
    database.execute("VACUUM diff")
    with closing(PgStore(database.url, size_bytes_max=room)) as store:
        store.health.check_space(1)
        free = store.health.figures().free_bytes
        assert free is not None
        assert free > 12 << 20
        # What comes takes that room, as is known a second later.
        database.execute(LARGE.format(first=65, last=88))
        until(lambda: (store.health.figures().free_bytes or 0) < free - (5 << 20), "it is counted")
