"""What every store must do with tokens and the audit log, and what it must tell of robots' uses and of itself."""

import hashlib
import time
from dataclasses import replace
from itertools import pairwise

import pytest
from tests.cairn_map.made import SMALL
from tests.cairn_server.branch_contract import branch, token
from tests.cairn_server.commit_contract import new_map
from tests.cairn_server.store_contract import NAMES, new_of
from tests.cairn_server.sync.pushes import MOLE, WREN, pushed

from cairn_map.errors import ConflictError, NotFoundError
from cairn_server.folding.cell_cache import CellCache
from cairn_server.folding.folding import fold_pending
from cairn_server.store.quota_store import Use
from cairn_server.store.store import Store
from cairn_server.store.store_health import Backlog
from cairn_server.store.store_rows import MapRow
from cairn_server.store.token_store import Token, registration_name


def made(row: MapRow | None = None, *, robot: str | None = None, expires_s: float | None = None) -> Token:
    """A token under a new name."""
    return Token(
        name=next(NAMES),
        role="robot" if robot else "reader",
        map_number=row.number if row else None,
        map_name=row.name if row else None,
        robot=robot,
        created_s=5.0,
        expires_s=expires_s,
    )


def secret_of(token: Token, *, turn: int = 0) -> bytes:
    """What stands for the hash of a token's secret."""
    return hashlib.sha256(f"{token.name} {turn}".encode()).digest()


class AccessContract:
    """Tests of a `Store`."""

    # Tokens

    def test_a_token_is_found_by_its_secret_as_it_was_added(self, store: Store) -> None:
        row = new_map(store)
        tokens = [made(), made(row), made(row, robot="mole"), made(expires_s=1.0)]  # one that ended, too
        for each in tokens:
            store.tokens.add(each, secret_of(each))
        assert [store.tokens.of_hash(secret_of(each)) for each in tokens] == tokens
        assert store.tokens.of_hash(bytes(32)) is None
        found = store.tokens.all()
        assert [each for each in found if each in tokens] == sorted(tokens, key=lambda each: each.name)
        assert [each.name for each in found] == sorted(each.name for each in found)

    def test_a_name_is_given_once_and_again_when_it_is_free(self, store: Store) -> None:
        first = made()
        store.tokens.add(first, secret_of(first))
        with pytest.raises(ConflictError) as refused:
            store.tokens.add(first, secret_of(first, turn=1))
        assert refused.value.kind == "token_exists"
        assert store.tokens.of_hash(secret_of(first, turn=1)) is None
        store.tokens.remove(first.name)
        assert store.tokens.of_hash(secret_of(first)) is None
        with pytest.raises(NotFoundError) as missed:
            store.tokens.remove(first.name)
        assert missed.value.kind == "no_such_token"
        store.tokens.add(first, secret_of(first, turn=1))
        assert store.tokens.of_hash(secret_of(first, turn=1)) == first

    def test_a_renewed_token_has_another_secret_and_nothing_else(self, store: Store) -> None:
        first = made(expires_s=7.0)
        store.tokens.add(first, secret_of(first))
        assert store.tokens.renew(first.name, secret_of(first, turn=1)) == first
        found = [store.tokens.of_hash(secret_of(first, turn=turn)) for turn in range(2)]
        assert found == [None, first]
        with pytest.raises(NotFoundError) as missed:
            store.tokens.renew("nobody", secret_of(first, turn=2))
        assert missed.value.kind == "no_such_token"

    def test_when_a_token_was_last_used_is_noted(self, store: Store) -> None:
        first, second = made(), made()
        for each in (first, second):
            store.tokens.add(each, secret_of(each))
        start_s = time.time()
        store.tokens.used(first.name)
        store.tokens.used("nobody")
        used_s = {each.name: each.last_used_s for each in store.tokens.all()}
        assert start_s <= (used_s[first.name] or 0) <= time.time()
        assert used_s[second.name] is None and "nobody" not in used_s

    def test_all_tokens_of_a_robot_go_with_its_branch(self, store: Store) -> None:
        row, other = new_map(store), new_map(store)
        own, of_other, reader = made(row, robot="mole"), made(other, robot="mole"), made(row)
        for each in (own, of_other, reader):
            store.tokens.add(each, secret_of(each))
        store.register(row, branch("mole"), token(row, "mole"))
        registered = store.tokens.of_hash(token(row, "mole"))
        assert registered is not None and registered.name == registration_name(row.name, "mole")
        assert (registered.role, registered.expires_s, registered.last_used_s) == ("robot", None, None)
        store.deregister(row, "mole")
        assert store.tokens.of_hash(token(row, "mole")) is None
        assert [store.tokens.of_hash(secret_of(each)) for each in (own, of_other, reader)] == [None, of_other, reader]

    # The audit log

    def test_lines_are_numbered_and_each_follows_the_one_before(self, store: Store) -> None:
        store.audit_log.add("chief", "first", "the line that the others follow")
        before = store.audit_log.page(after=0, limit=1 << 30)[-1]
        start_s = time.time()
        for n in range(3):
            store.audit_log.add("chief", "retract", f"number {n}")
        store.audit("healed_cell", "by itself")
        new_map(store)  # after which notes are written
        lines = store.audit_log.page(after=before.number, limit=9)
        assert [(line.who, line.what, line.detail) for line in lines] == [
            *(("chief", "retract", f"number {n}") for n in range(3)),
            ("server", "healed_cell", "by itself"),
        ]
        assert [line.number for line in lines] == [before.number + n for n in range(1, 5)]
        assert all(line.is_next_after(last) for last, line in pairwise([before, *lines]))
        assert not lines[1].is_next_after(before)
        assert all(start_s <= line.time_s <= time.time() for line in lines)
        assert store.audit_log.page(after=lines[0].number, limit=2) == lines[1:3]
        assert store.audit_log.page(after=lines[-1].number, limit=9) == []

    # What it tells of robots and of itself

    def test_what_robots_pushed_since_a_time_is_summed_up_for_each_map(self, store: Store) -> None:
        row, other = new_map(store, pushed(0, 0)), new_map(store, pushed(0, 1))
        between_s = time.time()
        late = [pushed(1, 1), pushed(2, 2), pushed(0, 0, WREN)]
        for commit in late:
            store.append(row, new_of(commit))
        store.append(row, new_of(late[0]))  # known, so it counts no second time
        mole = [pushed(0, 0), *late[:2]]
        use = {
            name: Use(sum(len(c.data) for c in some), sum(len(c.cells) for c in some))
            for name, some in (("late", late[:2]), ("all", mole), ("wren", late[2:]), ("other", [pushed(0, 1)]))
        }
        mine = {(row.number, "mole"), (row.number, "wren"), (other.number, "mole")}

        def since(time_s: float) -> dict[tuple[int, str], Use]:
            return {robot: found for robot, found in store.uses.since(time_s).items() if robot in mine}

        assert since(between_s) == {(row.number, "mole"): use["late"], (row.number, "wren"): use["wren"]}
        assert since(0.0) == {
            (row.number, "mole"): use["all"],
            (row.number, "wren"): use["wren"],
            (other.number, "mole"): use["other"],
        }
        assert since(time.time() + 1) == {}

    def test_what_a_relay_brought_counts_for_its_token_and_for_no_robot(self, store: Store) -> None:
        row = new_map(store, pushed(0, 0))
        brought = pushed(1, 1)
        store.append(row, replace(new_of(brought), via="field"))
        used = {robot: use.size_bytes for robot, use in store.uses.since(0.0).items() if robot[0] == row.number}
        assert used == {(row.number, "mole"): len(pushed(0, 0).data), (row.number, "relay field"): len(brought.data)}

    def test_what_was_pushed_since_a_time_counts_although_the_clock_was_set_back_after_it(
        self, store: Store, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        row, now_s = new_map(store), time.time()
        for n, shift_s in enumerate((-10.0, 0.0, 20.0, -30.0, -1e9)):
            monkeypatch.setattr(time, "time", lambda shift_s=shift_s: now_s + shift_s)
            store.append(row, new_of(pushed(n, 0)))
        monkeypatch.undo()
        sizes = [len(pushed(n, 0).data) for n in range(3)]
        for since_s, counted in ((-15.0, sizes), (-5.0, sizes[1:]), (20.0, sizes[2:]), (21.0, [])):
            used = store.uses.since(now_s + since_s).get((row.number, "mole"), Use())
            assert used == Use(sum(counted), 2 * len(counted))

    def test_what_is_not_folded_is_counted_for_each_map(self, store: Store) -> None:
        start_s = time.time()
        row, empty = new_map(store, pushed(0, 0), pushed(1, 1)), new_map(store)
        backlogs = {backlog.map: backlog for backlog in store.health.backlogs()}
        assert backlogs[empty.name] == Backlog(empty.name, 0, None)
        assert backlogs[row.name].commits == 2
        assert start_s <= (backlogs[row.name].oldest_s or 0) <= time.time()
        fold_pending(store, row, CellCache(SMALL), limit=9)
        assert Backlog(row.name, 0, None) in store.health.backlogs()

    def test_a_store_at_work_has_room_and_counts_what_it_writes(self, store: Store) -> None:
        store.health.check_space(1)
        store.health.probe()
        before = store.health.figures()
        row = new_map(store, pushed(0, 0))
        store.append(row, new_of(pushed(0, 0, MOLE)))
        after = store.health.figures()
        assert after.size_bytes + after.ahead_bytes > 0 and after.failures == before.failures == {}
        assert after.written > before.written
