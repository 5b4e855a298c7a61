"""What every store must do with branches and their tokens."""

import time
from dataclasses import replace

import pytest
from tests.cairn_server.commit_contract import folded_map, new_map
from tests.cairn_server.sync.pushes import WREN, pushed

from cairn_map.errors import NotFoundError
from cairn_server.store.branch_notes import EntrySize
from cairn_server.store.store import Store
from cairn_server.store.store_rows import Branch, MapRow


def branch(name: str, *, mode: str = "high-end", sensors: tuple[str, ...] = ()) -> Branch:
    """A branch as it is registered."""
    return Branch(name, mode, sensors, None, 5.0)


def token(row: MapRow, text: str) -> bytes:
    """What stands for a token of that map."""
    return f"{row.name} {text}".encode()


class BranchContract:
    """Tests of a `Store`."""

    def after_notes(self, store: Store) -> None:
        """Return when notes are written that were made before."""
        new_map(store)

    def test_branches_come_by_name_and_belong_to_one_map(self, store: Store) -> None:
        row, other = new_map(store), new_map(store)
        for name in ("wren", "mole", "newt"):
            store.register(row, branch(name, sensors=("tof", "camera")), token(row, name))
        store.register(other, branch("mole", mode="viewer"), token(other, "mole"))
        assert [found.name for found in store.branches(row)] == ["mole", "newt", "wren"]
        assert {found.sensors for found in store.branches(row)} == {("tof", "camera")}
        assert [(found.name, found.mode) for found in store.branches(other)] == [("mole", "viewer")]
        store.deregister(row, "mole")
        assert [found.name for found in store.branches(other)] == ["mole"]
        with store.snapshot(row) as snapshot:
            assert snapshot.totals().branches == 2

    def test_a_registration_s_token_is_known_until_it_is_replaced_or_the_branch_is_gone(self, store: Store) -> None:
        row, other = new_map(store), new_map(store)
        store.register(row, branch("mole"), token(row, "old"))
        store.register(row, branch("wren"), token(row, "wren"))
        store.register(other, branch("mole"), token(other, "mole"))
        store.register(row, branch("mole"), token(row, "new"))

        def robots() -> list[tuple[str, str | None] | None]:
            hashes = [*(token(row, text) for text in ("old", "new", "wren", "none")), token(other, "mole")]
            found = [store.tokens.of_hash(secret_hash) for secret_hash in hashes]
            return [(t.map_name or "", t.robot) if t else None for t in found]

        assert robots() == [None, (row.name, "mole"), (row.name, "wren"), None, (other.name, "mole")]
        store.deregister(row, "mole")
        assert robots() == [None, None, (row.name, "wren"), None, (other.name, "mole")]

    def test_a_branch_that_registers_again_keeps_its_cursor(self, store: Store) -> None:
        row = folded_map(store, pushed(0, 0))
        store.register(row, branch("mole"), token(row, "1"))
        with store.snapshot(row) as snapshot:
            cursor = snapshot.head.cursor
        store.seen(row, "mole", cursor)
        store.register(row, branch("mole", mode="low-end", sensors=("tof",)), token(row, "2"))
        [found] = store.branches(row)
        assert (found.mode, found.sensors, found.cursor, found.last_seen_s) == ("low-end", ("tof",), cursor, 5.0)

    def test_a_branch_that_was_seen_has_the_time_and_the_newest_cursor(self, store: Store) -> None:
        row = folded_map(store, pushed(0, 0))
        store.register(row, branch("mole"), token(row, "1"))
        start_s = time.time()
        with store.snapshot(row) as snapshot:
            cursor = snapshot.head.cursor
        store.seen(row, "mole", None)
        self.after_notes(store)
        [found] = store.branches(row)
        assert found.cursor is None
        assert start_s <= found.last_seen_s <= time.time()
        store.seen(row, "mole", cursor)
        store.seen(row, "mole", None)
        self.after_notes(store)
        assert [found.cursor for found in store.branches(row)] == [cursor]

    def test_who_was_deregistered_is_not_seen_any_more(self, store: Store) -> None:
        row = new_map(store)
        store.register(row, branch("mole"), token(row, "1"))
        store.deregister(row, "mole")
        store.seen(row, "mole", None)
        self.after_notes(store)
        assert store.branches(row) == []
        with pytest.raises(NotFoundError) as refused:
            store.deregister(row, "mole")
        assert refused.value.kind == "no_branch"

    def test_a_new_incarnation_stands_nowhere(self, store: Store) -> None:
        row = folded_map(store, pushed(0, 0))
        with store.snapshot(row) as snapshot:
            cursor = snapshot.head.cursor
        cursors = []
        for turn, incarnation in enumerate(("a", "a", "b")):
            store.register(row, replace(branch("mole"), incarnation=incarnation), token(row, str(turn)))
            cursors += [found.cursor for found in store.branches(row)]
            store.seen(row, "mole", cursor)
            self.after_notes(store)
        assert cursors == [None, cursor, None]
        assert [found.incarnation for found in store.branches(row)] == ["b"]

    def test_a_branch_s_last_status_is_kept_as_long_as_the_branch(self, store: Store) -> None:
        row, other = new_map(store), new_map(store)
        for name in ("mole", "wren"):
            store.register(row, branch(name), token(row, name))
        for name, status in (("mole", "1"), ("wren", "2"), ("mole", "3"), ("nobody", "4")):
            store.notes.put_status(row, name, status)
        self.after_notes(store)
        assert (store.notes.statuses(row), store.notes.statuses(other)) == ({"mole": "3", "wren": "2"}, {})
        store.register(row, branch("mole"), token(row, "new"))
        assert store.notes.statuses(row) == {"mole": "3", "wren": "2"}
        store.deregister(row, "mole")
        store.register(row, branch("mole"), token(row, "newer"))
        assert store.notes.statuses(row) == {"wren": "2"}

    def test_what_the_log_weighs_comes_in_pages(self, store: Store) -> None:
        commits = [pushed(0, 0), pushed(0, 1, WREN), pushed(1, 0, cells={}, retracts=[pushed(0, 0)])]
        row = folded_map(store, *commits)
        sizes = [EntrySize(n, c.id.author, len(c.data)) for n, c in enumerate(commits, start=1)]
        sizes.append(EntrySize(4, None, len(commits[0].data)))
        assert store.notes.entry_sizes(row, after_seq=0, limit=9) == sizes
        assert store.notes.entry_sizes(row, after_seq=1, limit=2) == sizes[1:3]
        assert store.notes.entry_sizes(row, after_seq=4, limit=9) == []
