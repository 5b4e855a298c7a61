"""Commits that come in parts: where they go on, what is refused before it comes, how little a hostile robot holds."""

from contextlib import suppress
from pathlib import Path
from random import Random

import pytest
from tests.fixtures.server.access import ADMIN, bearer, robot_token
from tests.fixtures.server.answers import kind_of
from tests.fixtures.server.live import Live
from tests.fixtures.server.pushes import MOLE, WREN, pushed
from tests.fixtures.server.quotas import SIZE, assert_waits, guarded
from tests.fixtures.server.stores import one_server
from tests.fixtures.server.uploads import COMMIT, add, state

from cairn_map.commits.commit import COMMIT_BYTES_MAX
from cairn_map.errors import BadInputError, UnreachableError
from cairn_map.wire.messages import CreateMap
from cairn_server.access.auth import Caller, Role
from cairn_server.store.replica_notes import BodyPart
from cairn_server.store.store_rows import Use
from cairn_server.sync import uploads
from cairn_server.sync.uploads import Uploads


def test_a_commit_comes_in_parts_and_is_pushed_with_the_last(live: Live) -> None:
    row = live.new_map()
    half = len(COMMIT.data) // 2
    assert state(live, row) == {"size_bytes": 0, "sha": None}
    first = add(live, row, COMMIT.data[:half], 0)
    assert (first.status_code, first.json()) == (200, {"size_bytes": half, "sha": None})
    assert live.pending(row) == 0
    last = add(live, row, COMMIT.data[half:], half)
    assert (last.status_code, last.json()) == (201, {"size_bytes": len(COMMIT.data), "sha": COMMIT.sha.hex()})
    live.folded(row)
    assert live.http.get(f"/maps/{row.name}/commits/{COMMIT.id}").content == COMMIT.data
    assert state(live, row)["size_bytes"] == 0


def test_whose_last_answer_was_lost_learns_that_the_commit_is_kept(live: Live) -> None:
    row = live.new_map()
    add(live, row, COMMIT.data, 0)
    assert state(live, row)["sha"] == COMMIT.sha.hex()
    again = add(live, row, COMMIT.data, 0)
    assert (again.status_code, again.json()["sha"]) == (200, COMMIT.sha.hex())


def test_a_part_that_begins_elsewhere_changes_nothing_and_says_where_to_go_on(live: Live) -> None:
    row = live.new_map()
    add(live, row, COMMIT.data[:100], 0)
    for offset in (0, 99, 101):
        assert add(live, row, COMMIT.data[:50], offset).json() == {"size_bytes": 100, "sha": None}


def test_other_bytes_of_the_same_id_begin_anew(live: Live) -> None:
    row = live.new_map()
    other = pushed(0, 1)
    add(live, row, COMMIT.data[:100], 0)
    assert state(live, row, other)["size_bytes"] == 0
    assert add(live, row, other.data[:70], 0, commit=other).json()["size_bytes"] == 70
    assert state(live, row)["size_bytes"] == 0


def test_bytes_without_their_digest_are_dropped(live: Live) -> None:
    row = live.new_map()
    wrong = add(live, row, b"?" * len(COMMIT.data), 0)
    assert (wrong.status_code, wrong.json()) == (200, {"size_bytes": 0, "sha": None})
    assert state(live, row)["size_bytes"] == 0


def test_what_a_push_refuses_is_refused_and_dropped(live: Live) -> None:
    row, taken = live.new_map(), pushed(0, 1)
    live.push(row, taken)
    refused = add(live, row, COMMIT.data, 0)
    assert (refused.status_code, kind_of(refused)) == (409, "id_taken")
    assert state(live, row)["size_bytes"] == 0


@pytest.mark.parametrize(("offset", "total"), [(1, len(COMMIT.data)), (0, 10), (0, COMMIT_BYTES_MAX + 1)])
def test_more_than_was_announced_or_may_be_is_refused(live: Live, offset: int, total: int) -> None:
    row = live.new_map()
    refused = add(live, row, COMMIT.data, offset, total=total)
    assert (refused.status_code, kind_of(refused)) == (413, "too_large")
    assert state(live, row)["size_bytes"] == 0


def test_a_robot_uploads_for_itself_only_and_within_its_quota(tmp_path: Path) -> None:
    with guarded(tmp_path, bytes_per_day=SIZE + 10) as live:
        live.http.put("/maps/lab", json=CreateMap().model_dump(), headers=bearer(ADMIN))
        row = live.new_map()
        headers = bearer(robot_token(live, row, "mole"))
        foreign = pushed(0, 0, WREN)
        for answer in (
            add(live, row, b"?", 0, commit=foreign, headers=headers),
            live.http.get(
                f"/maps/{row.name}/commits/{foreign.id}/upload", params={"digest": "0" * 64}, headers=headers
            ),
        ):
            assert (answer.status_code, kind_of(answer)) == (403, "not_allowed")
        assert_waits(add(live, row, b"?", 0, total=SIZE + 11, headers=headers), 1, 86_400)
        assert add(live, row, COMMIT.data, 0, headers=headers).status_code == 201
        later = pushed(1, 0)
        assert_waits(add(live, row, later.data[:9], 0, commit=later, headers=headers), 1, 86_400)


def test_after_a_quota_the_same_part_comes_again(tmp_path: Path) -> None:
    with guarded(tmp_path, commits_per_minute=1) as live:
        row = live.new_map()
        headers, later = bearer(robot_token(live, row, "mole")), pushed(1, 0)
        most = len(later.data) - 1
        add(live, row, later.data[:most], 0, commit=later, headers=headers)
        live.push(row, COMMIT, headers=headers)
        assert_waits(add(live, row, later.data[most:], most, commit=later, headers=headers), 1, 60)
        assert state(live, row, later, headers=headers)["size_bytes"] == most
        # A minute later.
        live.service.sync.pushes.meter.accounts.give_back((row.number, "mole"), Use(), day=0, commits=1)
        assert add(live, row, later.data[most:], most, commit=later, headers=headers).status_code == 201


@one_server("one of them is made to be busy")
def test_where_the_push_must_wait_an_empty_part_tries_again(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    row = live.new_map()

    def busy(*arguments: object, **beside: object) -> bool:
        raise UnreachableError("busy", "later", 1.0)

    with monkeypatch.context() as patch:
        patch.setattr(live.service.sync.pushes, "keep", busy)
        assert add(live, row, COMMIT.data, 0).status_code == 503
    assert state(live, row)["size_bytes"] == len(COMMIT.data)
    assert add(live, row, b"", len(COMMIT.data)).status_code == 201


def test_a_commit_that_was_taken_out_and_forgotten_comes_to_its_end_in_parts(live: Live) -> None:
    row = live.new_map()
    live.push(row, COMMIT)
    live.folded(row)
    assert live.retract(row, COMMIT).status_code == 201
    live.folded(row)
    assert live.service.store.forget_evidence(row, before_s=float("inf"), limit=100) == 1
    assert state(live, row)["sha"] == COMMIT.sha.hex()
    half = len(COMMIT.data) // 2
    add(live, row, COMMIT.data[:half], 0)
    last = add(live, row, COMMIT.data[half:], half)
    assert (last.status_code, last.json()) == (200, {"size_bytes": len(COMMIT.data), "sha": COMMIT.sha.hex()})


class Staging:
    """Uploads without a server, and their clock."""

    def __init__(self, live: Live, uploads: Uploads | None = None) -> None:
        if live.service.store.replicas is not None:
            pytest.skip("bounds of the memory of one process")
        self.now_s = 0.0
        self.row = live.new_map()
        self.uploads = uploads or Uploads(live.service.store, live.service.sync.pushes, steady_s=lambda: self.now_s)

    def add(self, robot: str, size_bytes: int, *, n: int = 0, total: int = COMMIT_BYTES_MAX, offset: int = 0) -> int:
        part = BodyPart("0" * 64, total, offset, bytes(size_bytes))
        caller = Caller(Role.ROBOT, robot)
        return self.uploads.add(self.row, caller, f"{robot}.{MOLE.incarnation}.{n}", part)[0].size_bytes


def test_an_amend_stays_while_what_it_names_comes_in_parts(live: Live) -> None:
    row, target = live.new_map(), pushed(0, 3)
    live.push(row, target)
    live.folded(row)
    live.service.store.forget_evidence(row, before_s=float("inf"), limit=100)
    amend = pushed(1, 1, retracts=[target])
    assert kind_of(add(live, row, amend.data, 0, commit=amend)) == "evidence_gone"
    half = len(target.data) // 2
    for data, offset in ((target.data[:half], 0), (target.data[half:], half)):
        assert add(live, row, data, offset, commit=target).status_code == 200
    assert state(live, row, amend)["size_bytes"] == len(amend.data)
    assert add(live, row, b"", len(amend.data), commit=amend).status_code == 201


def test_a_hostile_robot_holds_two_bodies_at_a_time(live: Live) -> None:
    staging = Staging(live)
    for n in range(50):
        assert staging.add("mole", 1000, n=n) == 1000
        assert staging.uploads.staged_bytes() == 1000 * min(n + 1, 2)


def test_who_announces_much_takes_no_room_from_others(live: Live) -> None:
    staging = Staging(live)
    for robot in "abcdef":
        staging.add(robot, 1)
    assert [staging.add(robot, 1, offset=1) for robot in "abcdef"] == [2] * 6


def test_all_robots_together_hold_no_more_than_the_limit(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(uploads, "STAGED_BYTES_MAX", 10_000)
    staging = Staging(live)
    random = Random(1)
    for _ in range(200):
        total = random.randint(1000, 5000)
        with suppress(UnreachableError):
            staging.add(f"r{random.randrange(20)}", random.randint(1, 999), n=random.randrange(3), total=total)
        assert staging.uploads.staged_bytes() <= 10_000


def test_who_was_quiet_longest_goes_first_and_what_is_old_goes(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(uploads, "STAGED_BYTES_MAX", 500)
    staging = Staging(live)
    for robot in ("a", "b"):
        staging.add(robot, 150)
    staging.add("a", 50, offset=150)
    staging.add("b", 50, offset=150)
    staging.add("c", 150)
    assert staging.add("a", 1, offset=200) == 0
    assert staging.add("b", 1, offset=200) == 201
    staging.now_s = uploads.IDLE_S + 1
    staging.add("b", 1, offset=201)
    staging.add("d", 200)
    assert staging.add("b", 0, offset=202) == 202
    assert staging.add("c", 1, offset=150) == 0
    staging.now_s += uploads.KEPT_S + 1
    staging.add("d", 10, total=1000)
    assert staging.uploads.staged_bytes() == 10


def test_another_robots_upload_survives_two_full_ones(live: Live) -> None:
    staging = Staging(live)
    staging.add("wren", 1 << 18)
    for _ in range(3):
        for n in range(2):
            with suppress(UnreachableError):  # room for both is only without wren's
                staging.add("mole", COMMIT_BYTES_MAX - 1, n=n)
    assert staging.add("wren", 1 << 18, offset=1 << 18) == 1 << 19
    assert staging.uploads.staged_bytes() <= uploads.STAGED_BYTES_MAX


def test_who_holds_most_waits_and_loses_nothing(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(uploads, "STAGED_BYTES_MAX", 500)
    staging = Staging(live)
    staging.add("mole", 300)
    staging.add("wren", 150)
    with pytest.raises(UnreachableError) as told:
        staging.add("mole", 100, offset=300)
    assert told.value.kind == "busy" and told.value.retry_after_s
    assert staging.add("mole", 50, offset=300) == 350
    assert staging.add("wren", 1, offset=150) == 151


def test_a_robot_on_many_maps_holds_no_more_than_one_share(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(uploads, "STAGED_BYTES_MAX", 1000)
    one = Staging(live)
    maps = [Staging(live, one.uploads) for _ in range(8)]
    for each in maps:
        each.add("mole", 100)
    for at in range(0, 500, 100):
        assert one.add("wren", 100, offset=at) == at + 100
    with suppress(UnreachableError):
        maps[0].add("mole", 600, n=1)
    assert one.add("wren", 0, offset=500) == 500
    assert one.uploads.staged_bytes() <= 1000


def test_a_part_of_nothing_takes_no_place(live: Live) -> None:
    staging = Staging(live)
    for n in range(5):
        staging.add(f"r{n}", 0)
    assert staging.uploads.staged_bytes() == 0


def test_a_bad_id_is_refused(live: Live) -> None:
    with pytest.raises(BadInputError):
        live.service.sync.uploads.add(live.new_map(), Caller(Role.ADMIN), "?", BodyPart("0" * 64, 1, 0, b""))
