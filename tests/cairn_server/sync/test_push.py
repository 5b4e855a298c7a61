"""Push: durable, idempotent, commutative; what a commit may not claim."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.fixtures.map.classed import CLASSED
from tests.fixtures.map.made import MIDDLE, PLAIN, SMALL, commit_bytes
from tests.fixtures.map.stored import recoded
from tests.fixtures.server.answers import kind_of
from tests.fixtures.server.live import Live
from tests.fixtures.server.pushes import KEYS, MOLE, WREN, pushed, read, sum_of
from tests.fixtures.server.stores import one_server

from cairn_map.commits.commit import Commit
from cairn_map.commits.ids import INITIAL, Author, Incarnation, RobotName
from cairn_map.evidence.channels import SAMPLE_MAX
from cairn_map.evidence.evidence import packed_evidence
from cairn_map.evidence.grid import Geometry
from cairn_server.store import numbering, shares


def test_push_twice_changes_nothing(live: Live) -> None:
    row = live.new_map()
    commit = pushed(0, 1)
    assert live.push(row, commit).status_code == 201
    before = live.cells(row)
    again = live.push(row, commit)
    assert (again.status_code, again.json()["state"]) == (200, "known")
    assert live.cells(row) == before
    assert len(live.http.get(f"/maps/{row.name}/log").json()) == 1


def test_the_same_id_with_other_bytes_is_refused_and_audited(live: Live) -> None:
    row = live.new_map()
    live.push(row, pushed(0, 1))
    refused = live.push(row, pushed(0, 2))
    assert (refused.status_code, kind_of(refused)) == (409, "id_taken")
    last = live.http.get("/audit", params={"limit": 1000}).json()[-1]
    assert (last["who"], last["what"]) == ("local", "id_taken")
    assert read(live.cells(row)) == sum_of([pushed(0, 1)])


def test_a_recompressed_commit_is_the_same_commit(live: Live) -> None:
    row = live.new_map()
    commit = pushed(0, 1)
    live.push(row, commit)
    other = commit_bytes(commit.text, [recoded(cell, level=None) for cell in commit.cells.values()])
    assert other != commit.data
    assert live.http.put(f"/maps/{row.name}/commits/{commit.id}", content=other).status_code == 200


@settings(max_examples=7)
@given(st.data())
def test_any_order_and_duplication_of_commits_gives_byte_equal_cells(live: Live, data: st.DataObject) -> None:
    commits = [pushed(n, data.draw(st.integers(0, 5)), author) for author in (MOLE, WREN) for n in range(3)]
    first, second = live.new_map(), live.new_map()
    for row in (first, second):
        for commit in data.draw(st.permutations(commits)):
            for _ in range(data.draw(st.integers(1, 2))):
                assert live.push(row, commit).status_code in (200, 201)
    assert live.cells(first) == live.cells(second)
    assert read(live.cells(first)) == sum_of(commits)


def with_counts(hits: int, misses: int, geometry: Geometry = PLAIN, **options: object) -> Commit:
    evidence = packed_evidence(
        np.array([3, 9], np.uint32), np.array([[hits, misses], [0, 1]]), np.zeros((2, geometry.plane_count)), geometry
    )
    return pushed(0, 0, geometry=geometry, cells={KEYS[0]: evidence}, **options)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("hits", "misses", "scans", "status"),
    [(1, 0, 0, 201), (1, 1, 0, 400), (1, 1, 2, 201), (2, 1, 2, 400), (0, 2**31 - 1, 9, 400), (2**31 - 1, 1, 1, 400)],
)
def test_a_commit_counts_at_most_once_per_voxel_and_scan(
    live: Live, hits: int, misses: int, scans: int, status: int
) -> None:
    answer = live.push(live.new_map(PLAIN), with_counts(hits, misses, scans=scans))
    assert answer.status_code == status
    assert status == 201 or kind_of(answer) == "too_much_evidence"


def test_a_commit_has_one_vote_for_a_class_per_voxel_and_sensor(live: Live) -> None:
    for votes, sensors, status in (
        ([4, 0, 0, 4], (), 201),
        ([5, 0, 0, 5], (), 400),
        ([0, 0, 8, 8], ("a", "b"), 201),
        ([0, 0, 0, 9], ("a", "b"), 400),
        ([0, 0, 0, 5], ("a", "a"), 400),
    ):
        evidence = packed_evidence(np.array([3], np.uint32), np.array([[1, 0]]), np.array([votes]), CLASSED)
        commit = pushed(0, 0, geometry=CLASSED, cells={KEYS[0]: evidence}, sensors=sensors)
        assert live.push(live.new_map(CLASSED), commit).status_code == status


@pytest.mark.parametrize("plane", range(SMALL.plane_count))
def test_samples_are_not_heavier_or_larger_than_a_scan_can_give(live: Live, plane: int) -> None:
    samples = np.zeros((1, SMALL.plane_count), np.int64)
    weights = [SMALL.planes_of(channel.name).stop - 1 for channel in SMALL.channels]
    samples[0, weights] = 2
    squares = [SMALL.planes_of("temperature").start + 1]
    most = 2 if plane in weights else 2 * SAMPLE_MAX ** (2 if plane in squares else 1)
    for excess, status in ((0, 201), (1, 400)):
        samples[0, plane] = most + excess
        evidence = packed_evidence(np.array([3], np.uint32), np.array([[1, 0]]), samples, SMALL)
        answer = live.push(live.new_map(), pushed(0, 0, cells={KEYS[0]: evidence}, scans=2))
        assert answer.status_code == status, answer.text


def test_prior_data_may_hold_the_counts_of_many_scans(live: Live) -> None:
    prior = with_counts(500, 700, scans=0, author=Author(INITIAL, Incarnation("0" * 16)))
    assert live.push(live.new_map(PLAIN), prior).status_code == 201


def test_numbers_may_come_in_any_order_but_not_full_of_gaps(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(numbering, "INTERVALS_OF_ROBOT_MAX", 3)
    row = live.new_map()
    assert [live.push(row, pushed(n, 1)).status_code for n in (8, 0, 4)] == [201] * 3
    refused = live.push(row, pushed(2, 1))
    assert (refused.status_code, kind_of(refused)) == (400, "number_gap")
    assert [live.push(row, pushed(n, 1)).status_code for n in (1, 3, 2, 6)] == [201] * 4


@pytest.mark.parametrize(
    ("author", "times_s", "kind"),
    [
        (Author(RobotName("main"), MOLE.incarnation), (0.0, 0.0), "reserved_name"),
        (MOLE, (1.5e9, 1e308), "bad_commit"),
        (MOLE, (-1e12, 0.0), "bad_commit"),
    ],
)
def test_a_name_or_a_time_that_cannot_be_is_refused(
    live: Live, author: Author, times_s: tuple[float, float], kind: str
) -> None:
    row, sound = live.new_map(), pushed(0, 0, author)
    text = sound.meta.model_copy(update={"captured_s": times_s}).model_dump_json().encode()
    data = commit_bytes(text, list(sound.cells.values()))
    path = f"/maps/{row.name}/commits/{sound.id}"
    answer = live.http.put(path, content=data)
    assert (answer.status_code, kind_of(answer)) == (400, kind)


def test_a_number_may_not_run_far_ahead_of_what_is_known_but_the_first_may_be_any(live: Live) -> None:
    row = live.new_map()
    first = 50_000
    assert live.push(row, pushed(first, 1)).status_code == 201
    assert kind_of(live.push(row, pushed(first + numbering.AHEAD_MAX + 1, 1))) == "number_gap"
    assert live.push(row, pushed(first + numbering.AHEAD_MAX, 1)).status_code == 201


def test_one_robot_cannot_fill_the_version_vector_with_incarnations(
    live: Live, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(numbering, "INCARNATIONS_MAX", 2)
    row = live.new_map()
    authors = [Author(MOLE.robot, Incarnation(f"{n:016x}")) for n in range(3)]
    assert [live.push(row, pushed(0, 1, author)).status_code for author in authors] == [201, 201, 400]
    assert kind_of(live.push(row, pushed(0, 1, authors[2]))) == "too_many_authors"
    assert live.push(row, pushed(1, 1, authors[0])).status_code == 201


def test_evidence_for_another_grid_is_refused_before_it_is_decoded(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    def not_now(*_: object, **__: object) -> None:
        raise AssertionError("decoded")

    monkeypatch.setattr("cairn_map.commits.commit_reading.read_canonical_cell", not_now)
    row = live.new_map(SMALL)
    assert kind_of(live.push(row, pushed(0, 1, geometry=MIDDLE))) == "other_geometry"
    assert kind_of(live.http.put(f"/maps/{row.name}/commits/{MOLE}.7", content=pushed(0, 1).data)) == "other_id"
    assert kind_of(live.push(row, pushed(0, 0, cells={}))) == "empty_commit"


def test_a_robot_s_share_of_a_cell_takes_no_more_than_fits(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shares, "COUNT_MAX", 2 * shares.ROBOTS_MAX * 12)
    row = live.new_map(PLAIN)
    one = with_counts(6, 0)
    assert live.push(row, one).status_code == 201
    again = [pushed(n, 0, geometry=PLAIN, cells={KEYS[0]: packed_evidence(
        np.array([3], np.uint32), np.array([[6, 0]]), np.zeros((1, 0)), PLAIN)}) for n in (1, 2)]  # fmt: skip
    assert live.push(row, again[0]).status_code == 201
    assert kind_of(live.push(row, again[1])) == "evidence_overflow"


@one_server("it writes a row now and then, and so does the other one")
def test_a_busy_robot_s_row_is_written_now_and_then_only(live: Live) -> None:
    row = live.new_map()
    body = {"robot": "mole", "incarnation": MOLE.incarnation}
    token = live.http.post(f"/maps/{row.name}/branches", json=body).json()["token"]
    headers = {"Authorization": f"Bearer {token}"}
    seen: list[object] = []
    for n in (0, 1):
        live.push(row, pushed(n, 1), headers=headers)
        live.new_map()  # is written after what was only noted before it
        seen.append(live.service.store.branches(row))
    assert seen[0] == seen[1]
