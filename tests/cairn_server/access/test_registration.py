"""Registration of robots: by an enrolment token, within its quota, and under a known name only by the same robot."""

import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from tests.fixtures.server.access import ADMIN, ENROLLER, bearer
from tests.fixtures.server.answers import kind_of
from tests.fixtures.server.live import Live
from tests.fixtures.server.pushes import pushed
from tests.fixtures.server.signatures import KEY_OF, MOLE, OLD_MOLE, WREN, signed

from cairn_map.commits.ids import Author, Incarnation
from cairn_map.commits.key_proof import KeyProof, proof_bytes
from cairn_map.errors import BadInputError
from cairn_map.wire.access_messages import CreateToken
from cairn_map.wire.origins import origin_of
from cairn_server.access import challenges
from cairn_server.access.auth import ADMIN_FILE
from cairn_server.access.challenges import Challenges
from cairn_server.access.tokens import create_token
from cairn_server.settings import Quotas
from cairn_server.store.store_rows import MapRow
from cairn_server.sync.admissions import ASKING_MAX

BASE = "http://base:8750"


@pytest.fixture(scope="module")
def guarded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Live]:
    with Live(tmp_path_factory.mktemp("guarded"), admin_token=ADMIN, enrolment_token=ENROLLER) as live:
        yield live


def proof_of(live: Live, map_name: str, author: Author, *signers: Author, asked: str | None = None) -> dict[str, str]:
    """Header of a proof over the server's challenge, by a robot that asked this server or another one."""
    challenge = live.http.get("/challenge").json()["challenge"]
    origin = asked or origin_of(str(live.http.base_url))
    message = proof_bytes(origin, map_name, author, challenge)
    signatures = tuple(KEY_OF[signer].sign_bytes(message) for signer in signers or (author,))
    return {"Cairn-Proof": KeyProof(author, challenge, origin, signatures).to_text()}


def register(live: Live, row: MapRow, author: Author, headers: dict[str, str]) -> httpx.Response:
    body = {"robot": author.robot, "incarnation": author.incarnation}
    return live.http.post(f"/maps/{row.name}/branches", json=body, headers=headers)


def known_mole(live: Live) -> tuple[MapRow, dict[str, str]]:
    """A map on which mole is known by its key, and mole's token."""
    row = live.new_map()
    answer = register(live, row, MOLE, bearer(ENROLLER))
    token = bearer(answer.json()["token"])
    commit = pushed(0, 0, MOLE)
    assert live.push(row, commit, headers=token | signed(row, commit)).status_code == 201
    return row, token


def test_the_enrolment_token_is_not_enough_for_a_name_that_is_known(guarded: Live) -> None:
    row, token = known_mole(guarded)
    for author in (MOLE, OLD_MOLE):
        answer = register(guarded, row, author, bearer(ENROLLER))
        assert (answer.status_code, kind_of(answer)) == (403, "not_admitted")
    assert guarded.http.get(f"/maps/{row.name}", headers=token).status_code == 200  # the real one is still in
    assert register(guarded, row, MOLE, token).status_code == 403
    for headers in (bearer(ENROLLER) | proof_of(guarded, row.name, MOLE), bearer(ADMIN)):
        answer = register(guarded, row, MOLE, headers)
        assert answer.status_code == 201


def test_a_proof_is_for_one_robot_on_one_map_and_a_minute(guarded: Live) -> None:
    row, _ = known_mole(guarded)
    other = guarded.new_map()
    sound = proof_of(guarded, row.name, OLD_MOLE, OLD_MOLE, MOLE)["Cairn-Proof"]
    author, challenge, origin, marks = sound.split(" ")
    wrong = [
        f"{author} {challenge[:-1]}{'0' if challenge[-1] != '0' else '1'} {origin} {marks}",
        f"{author} {challenge} {origin} {marks.replace(marks[70], '0' if marks[70] != '0' else '1', 1)}",
        proof_of(guarded, other.name, OLD_MOLE, MOLE)["Cairn-Proof"],
        "x" * 5000,
        "mole",
        f"{author} {challenge} {origin} -",
    ]
    for text in wrong:
        answer = register(guarded, row, OLD_MOLE, bearer(ENROLLER) | {"Cairn-Proof": text})
        assert answer.status_code in (400, 422)
    answer = register(guarded, row, OLD_MOLE, bearer(ENROLLER) | proof_of(guarded, row.name, WREN, MOLE))
    assert kind_of(answer) == "not_admitted"
    assert register(guarded, row, OLD_MOLE, bearer(ENROLLER) | {"Cairn-Proof": sound}).status_code == 201


def test_a_proof_made_for_another_server_is_refused_and_names_both(guarded: Live) -> None:
    row, _ = known_mole(guarded)
    own = f"127.0.0.1:{guarded.port}"
    for asked in (BASE, f"https://{own}", f"http://127.0.0.1:{guarded.port + 1}"):
        proof = proof_of(guarded, row.name, OLD_MOLE, OLD_MOLE, MOLE, asked=asked)
        for shown in (bearer(ENROLLER), {}):
            answer = register(guarded, row, OLD_MOLE, proof | shown)
            assert (answer.status_code, kind_of(answer)) == (400, "other_origin")
            assert f"made for {asked}" in answer.json()["detail"]
            assert f"http://{own}" in answer.json()["detail"]


def test_a_proof_of_the_form_that_names_no_server_is_refused_with_the_way_out(guarded: Live) -> None:
    row, _ = known_mole(guarded)
    author, challenge, _, marks = proof_of(guarded, row.name, MOLE)["Cairn-Proof"].split(" ")
    for shown in (bearer(ENROLLER), {}):
        answer = register(guarded, row, MOLE, {"Cairn-Proof": f"{author} {challenge} {marks}"} | shown)
        assert (answer.status_code, kind_of(answer)) == (400, "bad_signature")
        assert "update" in answer.json()["detail"]


def test_a_challenge_ends_after_a_minute_and_with_the_process() -> None:
    now_s = itertools.count(5.0, challenges.LIFETIME_S * 0.6)
    one, other = Challenges(steady_s=lambda: next(now_s)), Challenges()
    text = one.new()
    message = proof_bytes(BASE, "lab", MOLE, text)
    proof = KeyProof(MOLE, text, BASE, (KEY_OF[MOLE].sign_bytes(message),))
    assert one.signers(proof, map_name="lab", own=frozenset({BASE})) == {MOLE.incarnation}
    for asked in (one, other):
        with pytest.raises(BadInputError, match="challenge"):
            asked.signers(proof, map_name="lab", own=frozenset({BASE}))


def test_without_a_token_only_the_key_that_an_operator_lets_in_registers_and_once(guarded: Live) -> None:
    row, _ = known_mole(guarded)

    def tried(author: Author, *signers: Author) -> int:
        return register(guarded, row, author, proof_of(guarded, row.name, author, *signers)).status_code

    assert [tried(MOLE), tried(OLD_MOLE), tried(OLD_MOLE, MOLE)] == [401] * 3
    path = f"/maps/{row.name}/keys/{OLD_MOLE}"
    assert guarded.http.put(path, headers=bearer(ENROLLER)).status_code == 403
    assert guarded.http.put(path, headers=bearer(ADMIN)).status_code == 204
    assert [tried(MOLE), tried(OLD_MOLE, MOLE)] == [401] * 2
    assert tried(OLD_MOLE) == 201
    assert tried(OLD_MOLE) == 401
    nowhere = guarded.http.post("/maps/nowhere/branches", json={}, headers=proof_of(guarded, "nowhere", MOLE))
    assert (nowhere.status_code, kind_of(nowhere)) == (401, "no_token")
    for name in ("operator", "initial"):
        answer = guarded.http.put(f"/maps/{row.name}/keys/{name}.{MOLE.incarnation}", headers=bearer(ADMIN))
        assert kind_of(answer) == "reserved_name"


def test_one_who_asks_with_key_after_key_hides_no_other_robot_that_asks(guarded: Live) -> None:
    row, _ = known_mole(guarded)
    assert register(guarded, row, WREN, bearer(ENROLLER)).status_code == 201
    keys = f"/maps/{row.name}/keys"

    def asking() -> list[dict[str, Any]]:
        found: list[dict[str, Any]] = guarded.http.get(keys, headers=bearer(ADMIN)).json()["asking"]
        return found

    lost = Author(WREN.robot, OLD_MOLE.incarnation)
    assert register(guarded, row, lost, bearer(ENROLLER)).status_code == 403
    (first,) = asking()
    assert first["author"] == str(lost)
    assert first["since_s"] == first["asked_s"]
    for n in range(ASKING_MAX + 1):
        drawn = MOLE._replace(incarnation=Incarnation(f"{n:016x}"))
        assert register(guarded, row, drawn, bearer(ENROLLER)).status_code == 403
    assert asking()[0] == first
    assert register(guarded, row, lost, bearer(ENROLLER)).status_code == 403
    *others, last = asking()
    assert len(others) == ASKING_MAX - 1
    assert (last["author"], last["since_s"]) == (str(lost), first["since_s"])
    assert last["asked_s"] >= first["asked_s"]
    assert guarded.http.put(f"{keys}/{lost}", headers=bearer(ADMIN)).status_code == 204
    assert str(lost) not in {robot["author"] for robot in asking()}


def test_an_enrolment_token_for_one_robot_registers_it_under_any_key_and_no_other(guarded: Live) -> None:
    row, _ = known_mole(guarded)
    made = CreateToken(role="enroller", map=row.name, robot="mole")
    named = bearer(create_token(guarded.service.store, f"for-{row.name}", made, by=ADMIN_FILE).token)
    assert register(guarded, row, OLD_MOLE, named).status_code == 201
    assert kind_of(register(guarded, row, WREN, named)) == "not_allowed"
    guarded.http.delete(f"/maps/{row.name}/branches/mole", headers=bearer(ADMIN)).raise_for_status()
    assert register(guarded, row, OLD_MOLE, named).status_code == 401  # it went with the robot


def test_an_enrolment_token_registers_so_many_robots_an_hour(tmp_path: Path) -> None:
    quotas = Quotas(registrations_per_hour=3)
    with Live(tmp_path, admin_token=ADMIN, enrolment_token=ENROLLER, quotas=quotas) as live:
        row = live.new_map()

        def tried(name: str, token: str) -> int:
            author = Author(MOLE.robot.__class__(name), MOLE.incarnation)
            return register(live, row, author, bearer(token)).status_code

        assert tried("mole", ADMIN) == 201
        assert [tried("mole", ENROLLER) for _ in range(4)] == [403] * 4  # what is refused costs nothing
        assert [tried(f"robot{n}", ENROLLER) for n in range(4)] == [201] * 3 + [429]
        other = create_token(live.service.store, "gate", CreateToken(role="enroller"), by=ADMIN_FILE).token
        assert [tried("another", ENROLLER), tried("another", other), tried("more", ADMIN)] == [429, 201, 201]
        before = len(live.service.store.audit_log.page(after=0, limit=100))
        assert tried("last", ENROLLER) == 429
        assert len(live.service.store.audit_log.page(after=0, limit=100)) == before
