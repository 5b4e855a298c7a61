"""No robot can make another's commit refused, whatever it pushes; and what an operator retracts gives back its share.

Through the routes, with the tokens of robots and the quotas that servers have by default.
"""

import math
from collections.abc import Iterator
from functools import cache, partial
from pathlib import Path

import httpx
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from tests.fixtures.map.made import SMALL, surface_evidence
from tests.fixtures.server.access import ADMIN, ENROLLER, bearer, robot_token
from tests.fixtures.server.answers import kind_of
from tests.fixtures.server.crowded_map import add_authors, long_author
from tests.fixtures.server.live import Live
from tests.fixtures.server.pushes import KEYS, pushed
from tests.fixtures.server.shares_contract import author_of

from cairn_map.commits.commit import Commit, CommitMeta, ScanPose, make_commit
from cairn_map.commits.ids import CommitId
from cairn_map.errors import CairnError, ConflictError
from cairn_map.evidence.channels import SAMPLE_MAX
from cairn_map.evidence.evidence import packed_evidence
from cairn_map.evidence.grid import CellKey, cell_key
from cairn_server.access import quotas
from cairn_server.store.shares import INCARNATIONS_MAX, INTERVALS_OF_ROBOT_MAX, RESERVE_MORE, ROBOTS_MAX
from cairn_server.store.store_rows import MapRow

SCANS_MAX = 4096
FAR = [cell_key(cell) for cell in ((-(2**20), 0, 0), (2**20 - 1, 0, 0), (0, 9000, 0), (0, 0, -9000))]
Claims = dict[str, object]


@pytest.fixture(scope="module")
def guarded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Live]:
    """A server with tokens and default quotas; where a robot's cells lie is read again at once."""
    folder: Path = tmp_path_factory.mktemp("guarded")
    with pytest.MonkeyPatch.context() as patch, Live(folder, admin_token=ADMIN, enrolment_token=ENROLLER) as live:
        patch.setattr(quotas, "BOX_EVERY_S", 0.0)
        patch.setattr(quotas, "BOX_PAUSE_FACTOR", 0.0)
        yield live


@st.composite
def claims(draw: st.DrawFn) -> Claims:
    """One commit of the adversary, each field at its extremes."""
    scans = draw(st.sampled_from([1, SCANS_MAX, SCANS_MAX, 0]))
    heavy = st.sampled_from([1, scans, scans, scans + 1, 1024 * max(scans, 1)])
    return {
        "incarnation": draw(st.integers(0, 3)),
        "n": draw(st.sampled_from([0, 1, 2, 3, 5, 7, 10_000, 20_000, 10**15 - 1])),
        "scans": scans,
        "keys": draw(st.lists(st.sampled_from([*KEYS, *KEYS, *FAR]), min_size=1, max_size=3, unique=True)),
        "counts": draw(st.tuples(*[st.sampled_from([0, 1, scans, scans + 1, 2**31 - 1])] * 2)),
        "weight": draw(heavy),
        "value": draw(st.sampled_from([0, 1, SAMPLE_MAX, SAMPLE_MAX, SAMPLE_MAX + 1])),
        "retracts": draw(st.lists(st.sampled_from(["mole.0.0", "mole.0.1", "mole.3.7", "wren.0.0"]), max_size=2)),
        "time_s": draw(st.sampled_from([0.0, -1e308, 1e308])),
        "place_m": draw(st.sampled_from([0.0, 1e308])),
        "note": draw(st.sampled_from(["", "\U0001f573" * 1024])),
    }


def commit_of(claim: Claims) -> Commit | None:
    """The commit that makes a claim; None where its own bytes cannot say it."""
    samples = np.zeros((1, SMALL.plane_count), np.int64)
    weight, value = int(str(claim["weight"])), int(str(claim["value"]))
    for channel in SMALL.channels:
        planes = SMALL.planes_of(channel.name)
        samples[0, planes] = min(weight * value, 2**62)
        samples[0, planes.stop - 1] = min(weight, 2**62)
        if channel.kind == "temperature":
            samples[0, planes.start + 1] = min(weight * value**2, 2**62)
    pose = ScanPose(
        time_s=float(str(claim["time_s"])),
        t_map_rig=(float(str(claim["place_m"])), 0.0, 0.0),
        q_map_rig=(0.0, 0.0, 0.0, 1.0),
    )
    keys: list[CellKey] = list(claim["keys"])  # type: ignore[call-overload]
    try:
        evidence = packed_evidence(np.array([511], np.uint32), np.array([claim["counts"]]), samples, SMALL)
        mole = author_of("mole", int(str(claim["incarnation"])))
        targets = dict.fromkeys(map(_target, list(claim["retracts"])))  # type: ignore[call-overload]
        commit = CommitId(mole, int(str(claim["n"])))
        meta = CommitMeta(
            id=str(commit),
            geometry=SMALL.digest().hex(),
            scans=(pose,) * int(str(claim["scans"])),
            captured_s=(pose.time_s, pose.time_s),
            retracts=tuple(str(target) for target in targets if target != commit),
            note=str(claim["note"]),
        )
        return make_commit(meta, dict.fromkeys(keys, evidence), SMALL)
    except (CairnError, ValueError):
        return None


def _target(text: str) -> CommitId:
    robot, incarnation, n = text.split(".")
    return CommitId(author_of(robot, int(incarnation)), int(n))


def honest(robot: str, n: int, incarnation: int = 0) -> Commit:
    """A measurement with colour, intensity and temperature in the cells that the adversary fills."""
    return pushed(n, n, author_of(robot, incarnation), cells=dict.fromkeys(KEYS, surface(n)), scans=64)


surface = cache(partial(surface_evidence, geometry=SMALL))


class Team:
    """A map with an adversary `mole` and an honest `wren`; each pushes with its own token."""

    def __init__(self, live: Live) -> None:
        self.live = live
        self.row: MapRow = live.new_map()
        self._tokens = {robot: bearer(robot_token(live, self.row, robot)) for robot in ("mole", "wren")}

    def push(self, robot: str, commit: Commit) -> httpx.Response:
        return self.live.push(self.row, commit, headers=self._tokens[robot])

    def retract_all_of_mole(self) -> None:
        body = {"robot": "mole", "note": "an adversary"}
        answer = self.live.http.post(f"/maps/{self.row.name}/retracts", json=body, headers=bearer(ADMIN))
        assert answer.status_code == 201 or kind_of(answer) == "nothing_to_retract", answer.text
        self.live.folded(self.row)


ATTACK: Claims = {
    "incarnation": 0,
    "n": 0,
    "scans": SCANS_MAX,
    "keys": [KEYS[0]],
    "counts": (1, 0),
    "weight": SCANS_MAX,
    "value": SAMPLE_MAX,
    "retracts": [],
    "time_s": 0.0,
    "place_m": 0.0,
    "note": "",
}
"""The largest squares that a commit may claim; the second one fills the robot's share."""


@settings(max_examples=8)
@given(attack=st.lists(claims(), min_size=1, max_size=4))
@example(attack=[ATTACK, ATTACK | {"n": 1}, ATTACK | {"n": 2}])
@example(attack=[ATTACK | {"weight": 1024 * SCANS_MAX}, ATTACK | {"n": 1, "weight": 4, "scans": 1}])
@example(
    attack=[ATTACK | {"keys": [KEYS[0]]}, ATTACK | {"n": 1, "keys": [FAR[2]]}, ATTACK | {"n": 2, "keys": [FAR[3]]}]
)
def test_nothing_that_a_robot_pushes_makes_another_s_commit_refused(guarded: Live, attack: list[Claims]) -> None:
    team = Team(guarded)
    for claim in attack:
        commit = commit_of(claim)
        if commit is not None:
            assert team.push("mole", commit).status_code in (200, 201, 400, 403, 409, 413)
    assert team.push("wren", honest("wren", 0)).status_code == 201
    team.live.folded(team.row)
    assert team.push("wren", honest("wren", 1)).status_code == 201
    team.retract_all_of_mole()
    assert team.push("wren", honest("wren", 2, incarnation=9)).status_code == 201
    team.live.folded(team.row)
    assert guarded.service.store.shares.regions(team.row, "mole") == []
    again = commit_of(ATTACK | {"incarnation": 8, "keys": KEYS})
    assert again and team.push("mole", again).status_code == 201


def test_a_robot_fills_its_own_share_of_sums_and_hears_what_to_do(guarded: Live) -> None:
    team = Team(guarded)
    commits = [commit for n in range(3) if (commit := commit_of(ATTACK | {"n": n}))]
    answers = [team.push("mole", commit) for commit in commits]
    assert [answer.status_code for answer in answers] == [201, 201, 400]
    assert kind_of(answers[2]) == "evidence_overflow"
    assert "robot mole" in answers[2].json()["detail"] and "cairn map retract" in answers[2].json()["detail"]
    name = f'cairn_share_used_ratio{{bound="sums",map="{team.row.name}",robot="mole"}}'
    assert [line.split()[0] for line in shares_above_half(guarded, team.row)] == [name]
    assert math.isclose(float(shares_above_half(guarded, team.row)[0].split()[1]), 1.0, rel_tol=1e-5)
    assert team.push("wren", honest("wren", 0)).status_code == 201
    team.retract_all_of_mole()
    assert shares_above_half(guarded, team.row) == []
    assert team.push("mole", commits[2]).status_code == 201


def shares_above_half(live: Live, row: MapRow) -> list[str]:
    """What the metrics say of a map's shares."""
    lines = live.http.get("/metrics", headers=bearer(ADMIN)).text.splitlines()
    return [line for line in lines if line.startswith("cairn_share_used_ratio") and row.name in line]


def test_a_robot_fills_its_own_share_of_authors_and_gaps(guarded: Live) -> None:
    team = Team(guarded)

    def refusals(ids: list[tuple[int, int]]) -> list[str]:
        answers = [team.push("mole", honest_small("mole", n, incarnation)) for incarnation, n in ids]
        return [kind_of(answer) for answer in answers if answer.status_code != 201]

    gaps = INTERVALS_OF_ROBOT_MAX - INCARNATIONS_MAX
    assert refusals([(0, 2 * n) for n in range(gaps + 1)]) == []
    assert refusals([(n, 0) for n in range(1, INCARNATIONS_MAX)]) == []
    assert refusals([(INCARNATIONS_MAX, 0)]) == ["too_many_authors"]
    assert refusals([(0, 2 * gaps + 2)]) == ["number_gap"]
    for incarnation in range(3):
        assert team.push("wren", honest("wren", 0, incarnation)).status_code == 201
    url = f"/maps/{team.row.name}/robots"
    uses = {use["robot"]: use for use in guarded.http.get(url, headers=bearer(ADMIN)).json()}
    assert uses["mole"]["used"] == {"sums": 0.0, "incarnations": 1.0, "intervals": 1.0}
    closed = guarded.http.post(f"{url}/mole/close", headers=bearer(ADMIN))
    assert closed.json() == {"robot": "mole", "incarnations": INCARNATIONS_MAX, "intervals": INTERVALS_OF_ROBOT_MAX}
    assert refusals([(INCARNATIONS_MAX, 0)]) == []
    lines = guarded.http.get("/audit", params={"limit": 1000}, headers=bearer(ADMIN)).json()
    assert (lines[-1]["what"], lines[-1]["detail"].split(": ")[0]) == ("close_robot", f"map {team.row.name}")
    assert refusals([(0, 2 * gaps + 1)]) == ["author_closed"]


def honest_small(robot: str, n: int, incarnation: int) -> Commit:
    """A commit of one small cell."""
    return pushed(n, n, author_of(robot, incarnation), cells={KEYS[0]: surface(0)}, scans=64)


def test_closing_a_robot_is_an_administrator_s(guarded: Live) -> None:
    team = Team(guarded)
    assert team.push("mole", honest("mole", 0)).status_code == 201
    url = f"/maps/{team.row.name}/robots/mole/close"
    assert kind_of(guarded.http.post(url, headers=team._tokens["mole"])) == "not_allowed"
    missing = guarded.http.post(url.replace("mole", "owl"), headers=bearer(ADMIN))
    assert (missing.status_code, kind_of(missing)) == (404, "no_author")


def test_an_administrator_gives_every_place_back_however_full_its_share(tmp_path: Path) -> None:
    with Live(tmp_path) as live:
        row, store = live.new_map(), live.service.store
        beyond = INTERVALS_OF_ROBOT_MAX - INCARNATIONS_MAX
        for robot in range(ROBOTS_MAX):
            own = [long_author(robot, n) for n in range(INCARNATIONS_MAX)]
            add_authors(store, row, {author: 2 if n < beyond else 1 for n, author in enumerate(own)})
        newcomer = pushed(0, 0, author_of("newcomer"))
        assert kind_of(live.push(row, newcomer)) == "too_many_authors"
        for robot in range(ROBOTS_MAX):
            store.shares.close(row, long_author(robot).robot)
        live.push(row, newcomer).raise_for_status()
        (fresh, reserve) = sorted(store.shares.of(row), key=lambda share: share.intervals)
        assert (fresh.robot, reserve.incarnations, reserve.intervals) == (
            "newcomer",
            ROBOTS_MAX * INCARNATIONS_MAX,
            ROBOTS_MAX * INTERVALS_OF_ROBOT_MAX,
        )
        more = {long_author(0, n): 1 for n in range(INCARNATIONS_MAX, 2 * INCARNATIONS_MAX)}
        add_authors(store, row, more | {long_author(0, 99): RESERVE_MORE})
        with pytest.raises(ConflictError) as refused:
            store.shares.close(row, long_author(0).robot)
        assert refused.value.kind == "reserve_full"
