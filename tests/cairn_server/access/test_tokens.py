"""Tokens from their first day to their last, over HTTP and by the command."""

import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import httpx
import pytest
from tests.fixtures.server.access import ADMIN, ENROLLER, bearer, robot_token
from tests.fixtures.server.answers import kind_of
from tests.fixtures.server.live import Live, until
from tests.fixtures.server.pushes import MOLE, WREN, pushed

from cairn_client.cli import token as token_command
from cairn_client.http.api import MapApi
from cairn_map.errors import BadInputError, ConflictError, DeniedError, NotFoundError
from cairn_map.wire.access_messages import AuditEntry, CreateToken
from cairn_server.access import auth, rate_limits
from cairn_server.settings import Settings
from cairn_server.store.sqlite import tokens as sqlite_tokens
from cairn_server.store.sqlite.store import SqliteStore
from cairn_server.store.store_rows import Token

GUARDED = {"admin_token": ADMIN, "enrolment_token": ENROLLER}


@pytest.fixture(scope="module")
def guarded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Live]:
    """A server with tokens."""
    with Live(tmp_path_factory.mktemp("tokens"), **GUARDED) as server:
        yield server


@pytest.fixture
def admin(guarded: Live) -> Iterator[MapApi]:
    """Its administrator."""
    with MapApi(str(guarded.http.base_url), token=ADMIN) as api:
        yield api


def read_as(live: Live, secret: str, name: str) -> httpx.Response:
    return live.http.get(f"/maps/{name}/log", headers=bearer(secret))


def test_a_token_is_given_rotated_and_revoked_and_each_ends_what_was_before(guarded: Live, admin: MapApi) -> None:
    name = guarded.new_map().name
    first = admin.create_token("eye", CreateToken(role="reader", map=name))
    assert (first.info.name, first.info.role, first.info.map, first.info.expires_s) == ("eye", "reader", name, None)
    assert read_as(guarded, first.token, name).status_code == 200
    with pytest.raises(ConflictError, match="rotate it"):
        admin.create_token("eye", CreateToken(role="admin"))
    second = admin.rotate_token("eye")
    assert second.info.model_copy(update={"last_used_s": None}) == first.info
    assert kind_of(read_as(guarded, first.token, name)) == "bad_token"
    assert read_as(guarded, second.token, name).status_code == 200
    admin.revoke_token("eye")
    assert kind_of(read_as(guarded, second.token, name)) == "bad_token"
    with pytest.raises(NotFoundError):
        admin.revoke_token("eye")
    with pytest.raises(NotFoundError):
        admin.rotate_token("eye")


def test_a_token_ends_when_its_time_is_over(guarded: Live, admin: MapApi) -> None:
    name = guarded.new_map().name
    made = admin.create_token("brief", CreateToken(role="reader", lifetime_s=0.2))
    assert made.info.expires_s and made.info.expires_s < time.time() + 0.3
    assert read_as(guarded, made.token, name).status_code == 200
    until(lambda: read_as(guarded, made.token, name).status_code == 401, "the token ends")


def test_secrets_are_long_random_and_kept_nowhere(guarded: Live, admin: MapApi) -> None:
    secrets = [admin.create_token(f"s{n}", CreateToken(role="reader")).token for n in range(3)]
    assert len(set(secrets)) == 3
    assert all(len(bytes.fromhex(secret)) == 32 for secret in secrets)  # and none is taken for an option: -O7Dm...
    kept = b"".join(path.read_bytes() for path in guarded.service.settings.folder.glob("cairn.sqlite*"))
    assert not any(secret.encode() in kept for secret in secrets)
    assert not any(secret in repr(admin.tokens()) for secret in secrets)


@pytest.mark.parametrize("name", ["admin", "enroller", "local", "server"])
def test_names_that_the_audit_log_uses_are_no_tokens_names(admin: MapApi, name: str) -> None:
    with pytest.raises(BadInputError) as refused:
        admin.create_token(name, CreateToken(role="reader"))
    assert refused.value.kind == "reserved_name"


@pytest.mark.parametrize(
    "body",
    [
        {"role": "robot", "map": "lab"},
        {"role": "robot", "robot": "mole"},
        {"role": "reader", "robot": "mole", "map": "lab"},
        {"role": "king"},
        {"role": "reader", "lifetime_s": 0},
        {"role": "reader", "lifetime_s": 1e300},
        {"role": "reader", "lifetime_s": float("inf")},
        {},
    ],
)
def test_tokens_that_make_no_sense_are_refused(guarded: Live, body: dict[str, object]) -> None:
    content = str(body).replace("'", '"').replace("inf", "1e999").encode()
    headers = {"Content-Type": "application/json", **bearer(ADMIN)}
    assert guarded.http.put("/tokens/odd", content=content, headers=headers).status_code == 422
    assert guarded.http.put("/tokens/ODD", json={"role": "reader"}, headers=bearer(ADMIN)).status_code == 400
    missing = {"role": "reader", "map": "no-such-map"}
    assert kind_of(guarded.http.put("/tokens/odd", json=missing, headers=bearer(ADMIN))) == "no_map"


def test_a_given_robot_token_is_as_good_as_a_registration(guarded: Live, admin: MapApi) -> None:
    row = guarded.new_map()
    spare = admin.create_token("spare", CreateToken(role="robot", map=row.name, robot="mole")).token
    assert guarded.push(row, pushed(0, 0), headers=bearer(spare)).status_code == 201
    assert guarded.push(row, pushed(0, 0, WREN), headers=bearer(spare)).status_code == 403
    registered = robot_token(guarded, row, "mole")
    assert read_as(guarded, spare, row.name).status_code == 200
    renewed = admin.rotate_token(f"{row.name}:mole").token
    assert read_as(guarded, registered, row.name).status_code == 401
    assert read_as(guarded, renewed, row.name).status_code == 200
    admin.deregister(row.name, "mole")
    assert {read_as(guarded, secret, row.name).status_code for secret in (spare, renewed)} == {401}


def test_an_enroller_of_one_map_registers_robots_there_alone(guarded: Live, admin: MapApi) -> None:
    here, there = guarded.new_map(), guarded.new_map()
    secret = admin.create_token("gate", CreateToken(role="enroller", map=here.name)).token
    body = {"robot": "mole", "incarnation": MOLE.incarnation}
    found = [guarded.http.post(f"/maps/{r.name}/branches", json=body, headers=bearer(secret)) for r in (here, there)]
    assert [answer.status_code for answer in found] == [201, 401]


def test_last_use_is_noted_at_most_every_few_seconds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = SqliteStore(tmp_path)
    writes: list[object] = []
    submit = store._writer.submit
    monkeypatch.setattr(store._writer, "submit", lambda job: (writes.append(job), submit(job))[1])
    token = Token(name="eye", role="reader", map_number=None, map_name=None, robot=None, created_s=1.0, expires_s=None)
    store.tokens.add(token, b"hash")
    before = len(writes)
    for _ in range(100):
        store.tokens.used("eye")
    assert len(writes) == before + 1
    found = store.tokens.all()[0].last_used_s
    assert found and time.time() - 5 < found <= time.time()
    store.tokens.used("eye")
    store.close()  # writes what is noted
    again = SqliteStore(tmp_path)
    later = again.tokens.of_hash(b"hash")
    assert later and later.last_used_s and later.last_used_s >= found
    again.close()
    assert sqlite_tokens.USED_EVERY_S >= 5


def test_a_silent_robots_token_ends_and_another_registration_gives_a_new_one(tmp_path: Path) -> None:
    with Live(tmp_path, branch_expiry_s=60, **GUARDED) as live:
        row = live.new_map()
        token = robot_token(live, row, "mole")
        assert read_as(live, token, row.name).status_code == 200
        live.service.store.tokens.all()
        live.service.store._writer.run(  # type: ignore[attr-defined]
            lambda c: c.execute(
                "UPDATE token SET created_age_s = created_age_s - 61, used_age_s = used_age_s - 61"
            ).fetchall()
        )
        live.service.store.tokens.forget_known()  # type: ignore[attr-defined]
        assert kind_of(read_as(live, token, row.name)) == "bad_token"
        assert read_as(live, robot_token(live, row, "mole"), row.name).status_code == 200


def test_only_robots_tokens_without_an_end_of_their_own_end_by_silence() -> None:
    def ended(role: str, expires_s: float | None, expiry_s: float | None) -> bool:
        token = Token(
            name="x",
            role=role,
            map_number=1,
            map_name="lab",
            robot=None,
            created_s=0.0,
            expires_s=expires_s,
            last_used_s=50.0,
            used_age_s=50.0,
        )  # type: ignore[arg-type]
        return auth.has_ended(token, Settings(branch_expiry_s=expiry_s), now_s=200.0, age_s=200.0)

    assert ended("robot", None, 100)
    assert not ended("robot", None, 160)
    assert not ended("robot", None, None)
    assert not ended("robot", 300.0, 100)
    assert not ended("operator", None, 100)
    assert ended("operator", 200.0, None)


def test_the_command_gives_lists_rotates_and_revokes(guarded: Live, capsys: pytest.CaptureFixture[str]) -> None:
    server, name = str(guarded.http.base_url), guarded.new_map().name

    def cairn_token(*arguments: str, token: str = ADMIN) -> str:
        assert token_command.main([*arguments, "--token", token]) == 0
        return capsys.readouterr().out

    first = cairn_token("create", server, "desk", "--role", "operator", "--map", name, "--days", "1").strip()
    assert read_as(guarded, first, name).status_code == 200
    line = next(line for line in cairn_token("list", server).splitlines() if line.startswith("desk "))
    assert line.split()[:3] == ["desk", "operator", name]
    assert "never" not in line
    second = cairn_token("rotate", server, "desk").strip()
    assert [read_as(guarded, secret, name).status_code for secret in (first, second)] == [401, 200]
    assert cairn_token("revoke", server, "desk") == ""
    assert '"desk"' not in cairn_token("list", server, "--json")
    with pytest.raises(BadInputError, match="names its map and its robot"):
        cairn_token("create", server, "odd", "--role", "robot")
    with pytest.raises(BadInputError, match="greater than 0"):
        cairn_token("create", server, "odd", "--role", "reader", "--days", "0")
    with pytest.raises(DeniedError):
        cairn_token("list", server, token=ENROLLER)
    for name in ("../maps", "a/b", "x?y"):
        with pytest.raises(BadInputError):
            cairn_token("revoke", server, name)


def audit(live: Live, after: int = 0, limit: int = 1000) -> list[AuditEntry]:
    answer = live.http.get("/audit", params={"after": after, "limit": limit}, headers=bearer(ADMIN))
    return [AuditEntry.model_validate(entry) for entry in answer.json()]


def test_every_act_of_an_administrator_is_in_the_audit_log_with_who_did_it(guarded: Live, admin: MapApi) -> None:
    last = audit(guarded)[-1].number if audit(guarded) else 0
    name = guarded.new_map().name
    row = guarded.service.store.map(name)
    guarded.http.put("/maps/audited", json={}, headers=bearer(ADMIN))
    guarded.http.put("/maps/audited", json={}, headers=bearer(ADMIN))  # and the second changes nothing
    desk = admin.create_token("desk", CreateToken(role="operator", map=name)).token
    mole = bearer(robot_token(guarded, row, "mole"))
    guarded.push(row, pushed(0, 0), headers=mole)
    assert guarded.push(row, pushed(0, 1), headers=mole).status_code == 409
    guarded.retract(row, pushed(0, 0), note="wrong lens")  # without a token
    body = {"commits": [str(pushed(0, 0).id)], "note": "wrong lens"}
    assert guarded.http.post(f"/maps/{name}/retracts", json=body, headers=bearer(desk)).status_code == 201
    guarded.http.delete(f"/maps/{name}/branches/mole", headers=mole)
    admin.rotate_token("desk")
    admin.revoke_token("desk")
    found = audit(guarded, last)
    assert [(entry.who, entry.what) for entry in found] == [
        ("admin", "create_map"),
        ("admin", "create_token"),
        ("enroller", "register"),
        (f"{name}:mole", "id_taken"),
        ("desk", "retract"),
        (f"{name}:mole", "deregister"),
        ("admin", "rotate_token"),
        ("admin", "revoke_token"),
    ]
    assert "wrong lens" in found[4].detail
    assert str(pushed(0, 0).id) in found[3].detail
    assert all(time.time() - 60 < entry.time_s <= time.time() for entry in found)
    assert desk not in repr(found)


def test_an_open_servers_caller_is_called_local(live: Live) -> None:
    live.http.put("/maps/of-somebody", json={})
    assert [AuditEntry.model_validate(entry).who for entry in live.http.get("/audit").json()] == ["local"]


def test_the_audit_log_comes_in_pages_and_its_chain_shows_what_was_changed(
    guarded: Live, monkeypatch: pytest.MonkeyPatch
) -> None:
    guarded.service.store.audit("test", "by the server itself")
    for n in range(5):
        guarded.service.store.audit_log.add("test", "count", str(n))
    found = audit(guarded)
    assert found == audit(guarded, 0, 2) + audit(guarded, found[1].number)
    assert [entry.who for entry in found[-6:]] == ["server", *["test"] * 5]
    assert all(later.is_next_after(sooner) for sooner, later in pairwise(found))
    forged = found[1].model_copy(update={"who": "somebody else"})
    assert not forged.is_next_after(found[0])
    assert not found[2].is_next_after(found[0])
    monkeypatch.setattr(sqlite_tokens, "AUDIT_ROWS_MAX", 3)
    guarded.service.store.audit_log.add("test", "count", "last")
    kept = audit(guarded)
    assert kept[0] == found[-2]
    assert len(kept) == 3
    assert kept[2].is_next_after(kept[1])


def test_no_route_changes_the_audit_log(guarded: Live) -> None:
    for method in ("PUT", "POST", "DELETE", "PATCH"):
        for path in ("/audit", "/audit/1"):
            assert guarded.http.request(method, path, headers=bearer(ADMIN)).status_code in (404, 405)


def test_a_robot_cannot_push_others_lines_out_of_the_audit_log_by_refusals(
    guarded: Live, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rate_limits, "NOTED_PER_HOUR", 3)
    row = guarded.new_map()
    mole, wren = (bearer(robot_token(guarded, row, name)) for name in ("mole", "wren"))
    guarded.push(row, pushed(0, 0), headers=mole)
    guarded.push(row, pushed(0, 0, WREN), headers=wren)
    for _ in range(9):
        assert guarded.push(row, pushed(0, 1), headers=mole).status_code == 409
    assert guarded.push(row, pushed(0, 1, WREN), headers=wren).status_code == 409
    found = [entry.who for entry in audit(guarded) if entry.what == "id_taken" and entry.who.startswith(row.name)]
    assert found == [f"{row.name}:mole"] * 3 + [f"{row.name}:wren"]


def test_refusals_are_noted_again_in_the_next_hour() -> None:
    now_s = [7.0 * rate_limits.HOUR_S]
    counter = rate_limits.AuditLimit(steady_s=lambda: now_s[0])
    assert [counter.is_worth_a_line("x") for _ in range(100)] == [True] * 60 + [False] * 40
    now_s[0] += rate_limits.HOUR_S
    assert counter.is_worth_a_line("x")
