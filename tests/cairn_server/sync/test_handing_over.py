"""Commits that a relay may hand over: exactly what others signed, and nothing that it made or changed itself."""

from collections.abc import Iterator

import httpx
import pytest
from tests.fixtures.map.made import SMALL
from tests.fixtures.server.access import ADMIN, bearer
from tests.fixtures.server.answers import kind_of
from tests.fixtures.server.live import Live
from tests.fixtures.server.pushes import pushed, read, sum_of
from tests.fixtures.server.signatures import FRIEND, KEYS, MOLE, OLD_MOLE, WREN, signed
from tests.fixtures.server.stores import one_server
from tests.fixtures.server.uploads import add, state

from cairn_map.commits.commit import Commit, renamed_commit
from cairn_map.commits.commit_reading import open_commit
from cairn_map.commits.ids import INITIAL, OPERATOR, Author, CommitId, RobotName
from cairn_map.commits.signature import SigningKey
from cairn_map.wire.access_messages import CreateToken
from cairn_map.wire.messages import Retract
from cairn_server.access.auth import ADMIN_FILE
from cairn_server.access.tokens import create_token
from cairn_server.store.store_rows import MapRow
from cairn_server.sync.handing_over import server_key


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Live]:
    """A server with a relay."""
    trusted = FRIEND.public_key.hex()
    with Live(tmp_path_factory.mktemp("base"), admin_token=ADMIN, trusted_servers=trusted) as server:
        secret = create_token(server.service.store, "field", CreateToken(role="relay"), by=ADMIN_FILE)
        server.http.headers["Authorization"] = f"Bearer {secret.token}"
        yield server


@pytest.fixture
def row(live: Live) -> MapRow:
    return live.new_map()


def hand_over(live: Live, row: MapRow, commit: Commit, *keys: SigningKey) -> httpx.Response:
    return live.push(row, commit, headers=signed(row, commit, *keys))


def entries(live: Live, row: MapRow) -> list[dict[str, object]]:
    live.folded(row)
    found: list[dict[str, object]] = live.http.get(f"/maps/{row.name}/log").json()
    return found


def test_a_signed_commit_is_taken_once_from_whoever_relays_it_and_says_so(live: Live, row: MapRow) -> None:
    commit = pushed(0, 1, MOLE)
    assert hand_over(live, row, commit).status_code == 201
    assert hand_over(live, row, commit).status_code == 200
    assert [(entry["id"], entry["via"]) for entry in entries(live, row)] == [(str(commit.id), "field")]
    assert read(live.cells(row)) == sum_of([commit])


def test_it_goes_on_with_the_very_bytes_and_signature(live: Live, row: MapRow) -> None:
    commit = pushed(0, 1, MOLE)
    hand_over(live, row, commit)
    found = live.http.get(f"/maps/{row.name}/commits/{commit.id}")
    assert found.content == commit.data
    assert found.headers["Cairn-Signature"] == signed(row, commit)["Cairn-Signature"]


def test_an_unsigned_commit_is_not_a_relay_s_to_give(live: Live, row: MapRow) -> None:
    answer = live.push(row, pushed(0, 1, MOLE))
    assert (answer.status_code, kind_of(answer)) == (403, "not_allowed")
    assert entries(live, row) == []


def test_no_byte_can_be_changed_on_the_way(live: Live, row: MapRow) -> None:
    commit, other = pushed(0, 1, MOLE), pushed(0, 2, MOLE)
    answer = live.push(row, other, headers=signed(row, commit))
    assert (answer.status_code, kind_of(answer)) == (400, "bad_signature")
    for at in range(0, len(commit.data), 7):
        changed = bytearray(commit.data)
        changed[at] ^= 4
        path = f"/maps/{row.name}/commits/{commit.id}"
        answer = live.http.put(path, content=bytes(changed), headers=signed(row, commit))
        if answer.is_success:  # the same evidence, compressed another way, is the same commit
            assert open_commit(bytes(changed))[0].sha == commit.sha
    assert read(live.cells(row)) in ({}, sum_of([commit]))


def test_a_commit_is_not_replayed_under_another_id_or_on_another_map(live: Live, row: MapRow) -> None:
    commit = pushed(0, 1, MOLE)
    again = renamed_commit(commit.data, commit=CommitId(MOLE, 1), parent=None)
    answers = [
        live.push(row, again, headers=signed(row, commit)),
        live.push(row, commit, headers=signed(live.new_map(), commit)),
    ]
    assert [kind_of(answer) for answer in answers] == ["bad_signature"] * 2


def test_a_relay_s_own_key_speaks_for_nobody_known(live: Live, row: MapRow) -> None:
    forged = pushed(0, 1, MOLE)
    answer = hand_over(live, row, forged, FRIEND)
    assert (answer.status_code, kind_of(answer)) == (403, "not_allowed")


def test_a_retract_is_signed_by_everybody_from_whom_it_takes_something(live: Live, row: MapRow) -> None:
    old, foreign = pushed(0, 1, OLD_MOLE), pushed(0, 2, WREN)
    for commit in (old, foreign):
        hand_over(live, row, commit)
    taking_old = pushed(0, 0, MOLE, cells={}, retracts=[old])
    taking_foreign = pushed(1, 0, MOLE, cells={}, retracts=[foreign])
    assert hand_over(live, row, taking_old).status_code == 403
    assert hand_over(live, row, taking_old, KEYS[0], KEYS[1]).status_code == 201
    assert hand_over(live, row, taking_foreign, KEYS[0], KEYS[2]).status_code == 403
    assert read(live.cells(row)) == sum_of([foreign])


@pytest.mark.parametrize("robot", [OPERATOR, INITIAL])
def test_what_a_server_says_itself_is_taken_from_servers_that_are_trusted(live: Live, row: MapRow, robot: str) -> None:
    target = pushed(0, 1, MOLE)
    hand_over(live, row, target)
    author = Author(RobotName(robot), KEYS[0].incarnation)
    said = pushed(0, 0, author, cells={}, retracts=[target])
    stranger = hand_over(live, row, said, KEYS[0])
    assert (stranger.status_code, kind_of(stranger)) == (403, "not_allowed")
    assert f"--trust-server {KEYS[0].public_key.hex()}" in stranger.json()["detail"]
    assert hand_over(live, row, said, FRIEND).status_code == 201
    assert read(live.cells(row)) == {}


def test_a_server_hands_its_operators_retracts_on_under_its_own_key(live: Live, row: MapRow) -> None:
    target = pushed(0, 1, MOLE)
    hand_over(live, row, target)
    request = Retract(commits=[str(target.id)])
    done = live.service.sync.retracts.retract(row, request, by=ADMIN_FILE).id
    found = live.http.get(f"/maps/{row.name}/commits/{done}")
    key = live.http.get(f"/maps/{row.name}").json()["server_key"]
    assert found.headers["Cairn-Signature"].startswith(f"{key}.")
    path, headers = f"/maps/{row.name}/commits/{done}", {"Cairn-Signature": found.headers["Cairn-Signature"]}
    assert live.http.put(path, content=found.content, headers=headers).status_code == 200


def test_a_signed_commit_may_come_in_parts_and_only_whole_and_signed_it_counts(live: Live, row: MapRow) -> None:
    commit = pushed(0, 1, MOLE)
    half = len(commit.data) // 2
    assert add(live, row, commit.data[:half], 0, commit=commit).status_code == 200
    unsigned = add(live, row, commit.data[half:], half, commit=commit)
    assert (unsigned.status_code, kind_of(unsigned)) == (403, "not_allowed")
    assert state(live, row, commit) == {"size_bytes": 0, "sha": None}
    headers = signed(row, commit)
    add(live, row, commit.data[:half], 0, commit=commit, headers=headers)
    assert state(live, row, commit)["size_bytes"] == half
    as_robot = {"headers": bearer(ADMIN)}  # who pushes it itself has its own bytes there
    assert state(live, row, commit, **as_robot)["size_bytes"] == 0
    add(live, row, commit.data[:9], 0, commit=commit, total=len(commit.data) + 1, **as_robot)
    answer = add(live, row, commit.data[half:], half, commit=commit, headers=headers)
    assert (answer.status_code, answer.json()["sha"]) == (201, commit.sha.hex())
    assert [(entry["id"], entry["via"]) for entry in entries(live, row)] == [(str(commit.id), "field")]


def test_a_server_s_key_is_of_its_map(live: Live) -> None:
    rows = [live.new_map() for _ in range(2)]
    assert server_key(rows[0]).public_key != server_key(rows[1]).public_key
    assert server_key(rows[0]) == server_key(live.service.store.map(rows[0].name))


def test_a_robot_s_token_brings_nobody_else_s_commits_and_a_relay_that_is_a_robot_its_own(live: Live) -> None:
    row = live.new_map(SMALL)
    tokens = {
        role: create_token(
            live.service.store, f"wren-{role}", CreateToken(role=role, map=row.name, robot="wren"), by=ADMIN_FILE
        ).token
        for role in ("robot", "relay")
    }
    foreign, own = pushed(0, 1, MOLE), pushed(0, 2, WREN)
    headers = signed(row, foreign)
    assert live.push(row, foreign, headers=headers | bearer(tokens["robot"])).status_code == 403
    assert live.push(row, foreign, headers=headers | bearer(tokens["relay"])).status_code == 201
    assert live.push(row, own, headers=bearer(tokens["relay"])).status_code == 201
    assert [entry["via"] for entry in entries(live, row)] == ["wren-relay", None]


def test_a_bad_signature_on_an_own_commit_is_refused_too(live: Live, row: MapRow) -> None:
    commit = pushed(0, 1, MOLE)
    headers = signed(row, pushed(0, 2, MOLE)) | bearer(ADMIN)
    assert kind_of(live.push(row, commit, headers=headers)) == "bad_signature"


@one_server("those that ask to be admitted are known to the one that refused them")
def test_a_name_that_is_known_is_not_a_relay_s_to_speak_in_under_another_key(live: Live, row: MapRow) -> None:
    body = {"robot": "mole", "incarnation": MOLE.incarnation}
    live.http.post(f"/maps/{row.name}/branches", json=body, headers=bearer(ADMIN)).raise_for_status()
    forged = pushed(0, 1, OLD_MOLE)
    answer = hand_over(live, row, forged)
    assert (answer.status_code, kind_of(answer)) == (403, "not_admitted")
    assert entries(live, row) == []
    assert hand_over(live, row, pushed(0, 1, MOLE)).status_code == 201
    assert hand_over(live, row, forged).status_code == 403
    asking = live.http.get(f"/maps/{row.name}/keys", headers=bearer(ADMIN)).json()["asking"]
    assert [(robot["author"], robot["by"]) for robot in asking] == [(str(OLD_MOLE), "field")]
    answer = live.http.put(f"/maps/{row.name}/keys/{OLD_MOLE}", headers=bearer(ADMIN))
    assert answer.status_code == 204
    assert hand_over(live, row, forged).status_code == 201


def test_a_new_key_that_the_old_one_signs_is_taken_from_a_relay(live: Live, row: MapRow) -> None:
    assert hand_over(live, row, pushed(0, 1, OLD_MOLE)).status_code == 201
    assert hand_over(live, row, pushed(0, 2, MOLE), *KEYS[:2]).status_code == 201
    assert hand_over(live, row, pushed(1, 3, MOLE)).status_code == 201
