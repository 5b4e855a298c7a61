"""Every route with every kind of token on every map and robot: PROTOCOL.md's table is the norm.

A route that is added to the app must be in the table, and whatever a path names must be among the objects here: what
the running server says of itself is compared with both. Objects are a holder's own, another's, and unknown ones.
"""

import base64
import re
import time
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import httpx
import pytest
from starlette.routing import WebSocketRoute
from tests.fixtures.server.access import bearer
from tests.fixtures.server.live import DEADLINE_S, Live
from tests.fixtures.server.protocol_document import ROLES_OF
from tests.fixtures.server.pushes import MOLE, WREN, pushed
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from cairn_map.commits.ids import Author, Incarnation, RobotName
from cairn_map.wire.access_messages import RoleText
from cairn_map.wire.messages import Register
from cairn_server.access.auth import new_token, token_hash
from cairn_server.http.app import ROUTERS
from cairn_server.http.middleware.token_first import TOKEN_PREFIX
from cairn_server.http.openapi import operations
from cairn_server.http.routes.live import PROTOCOL
from cairn_server.store.store_rows import MapRow, Token

READING = {"reader", "robot", "operator", "relay"}
ADMIN, ENROLLER = "a" * 20, "e" * 20
GHOST = Author(RobotName("ghost"), Incarnation("00000000000000bb"))
AUTHORS = {"mole": MOLE, "wren": WREN}
"""Robots that are registered on both maps, with a commit on each."""
UNKNOWN = {"ghost": GHOST}
"""A robot of which no server knows anything."""
OBJECTS = {
    "name": "a map here, another one, none",
    "branch": "mole's, wren's, ghost's",
    "commit": "mole's, wren's, ghost's",
    "robot": "mole, wren, ghost",
    "author": "mole's, wren's, ghost's",
    "token": "a token, none",
    "cell": "one that holds evidence",
    "voxel": "one of that cell",
    "sha": "none",
    "file": "none",
}
"""Objects that the routes' paths name, and which of each are asked for."""
CREATION = ("PUT", "/maps/{name}")
NAMES = re.compile(rb"mole|wren|ghost|[0-9a-f]{16}|nobody|known")
"""Names of objects, as a refusal may repeat them."""
Place = Literal["here", "there"]
Worth = Literal["good", "none", "wrong", "expired", "revoked", "rotated", "replaced", "deregistered"]


@dataclass(frozen=True)
class Holder:
    """Holder of a token that sends a request."""

    role: RoleText | None
    place: Place | None = None
    """The one map that the token is for."""
    robot: str | None = None
    worth: Worth = "good"
    file: str | None = None
    """The secret, if it is one of the settings'."""

    def __str__(self) -> str:
        parts = (self.worth, self.robot or self.role, "file" if self.file else "", self.place and f"of {self.place}")
        return " ".join(part for part in parts if part)


ROLES: tuple[RoleText, ...] = ("admin", "operator", "reader", "enroller", "relay")
PLACES: tuple[Place, ...] = ("here", "there")
HOLDERS = [
    Holder(None, worth="none"),
    Holder(None, worth="wrong"),
    *(Holder("admin", worth=worth) for worth in ("expired", "revoked")),
    *(Holder("robot", "here", "mole", worth=worth) for worth in ("expired", "revoked", "rotated")),
    *(Holder("robot", "here", "vole", worth=worth) for worth in ("replaced", "deregistered")),
    Holder("admin", file=ADMIN),
    Holder("enroller", file=ENROLLER),
    *(Holder(role, place) for role in ROLES for place in (None, *PLACES)),
    *(Holder("robot", place, robot) for place in PLACES for robot in ("mole", "wren")),
    *(Holder("relay", place, "mole") for place in PLACES),
]


class Holders:
    """A server with two maps, two robots on each, and a token for every holder."""

    def __init__(self, live: Live) -> None:
        self.live = live
        self.rows = {place: live.new_map() for place in PLACES}
        for row in self.rows.values():
            for author in AUTHORS.values():
                live.push(row, pushed(0, 0, author), headers=bearer(ADMIN)).raise_for_status()
            live.folded(row)
        self._ask("PUT", "/tokens/known", json={"role": "reader"})
        self._headers: dict[Holder, dict[str, str]] = {}

    def renew(self) -> None:
        """Robots registered and tokens given again: what was just done may have ended them."""
        for row in self.rows.values():
            for robot, author in AUTHORS.items():
                self.live.service.maps.register(row, Register(robot=robot, incarnation=author.incarnation))
        self._headers = {}

    def headers_of(self, holder: Holder) -> dict[str, str]:
        if holder not in self._headers:
            self._headers[holder] = (
                {} if holder.worth == "none" else {"Authorization": f"Bearer {self._secret(holder)}"}
            )
        return self._headers[holder]

    def _secret(self, holder: Holder) -> str:
        if holder.file or holder.worth == "wrong":
            return holder.file or "x" * 43
        assert holder.role
        if holder.worth in ("rotated", "replaced", "deregistered"):
            return self._ended_secret(holder)
        store, secret, row = self.live.service.store, new_token(), self.rows[holder.place] if holder.place else None
        token = Token(
            name=secret[:30],
            role=holder.role,
            map_number=row.number if row else None,
            map_name=row.name if row else None,
            robot=holder.robot,
            created_s=time.time() - 9,
            expires_s=time.time() - 1 if holder.worth == "expired" else time.time() + 999,
        )
        store.tokens.add(token, token_hash(secret))
        if holder.worth == "revoked":
            store.tokens.remove(token.name)
        return secret

    def _ended_secret(self, holder: Holder) -> str:
        """A secret that was good until its token got another one, or its robot left."""
        assert holder.place
        row = self.rows[holder.place]
        if holder.worth == "rotated":
            name = new_token()[:30]
            fields = {"role": holder.role, "map": row.name, "robot": holder.robot}
            secret = str(self._ask("PUT", f"/tokens/{name}", json=fields).json()["token"])
            self._ask("POST", f"/tokens/{name}/rotate")
            return secret
        body = {"robot": holder.robot, "incarnation": MOLE.incarnation}
        secret = str(self._ask("POST", f"/maps/{row.name}/branches", json=body).json()["token"])
        if holder.worth == "replaced":
            self._ask("POST", f"/maps/{row.name}/branches", json=body)
        self._ask("DELETE", f"/maps/{row.name}/branches/{holder.robot}")
        return secret

    def _ask(self, method: str, path: str, **options: Any) -> httpx.Response:
        answer = self.live.http.request(method, path, headers=bearer(ADMIN), **options)
        return answer.raise_for_status()


@pytest.fixture(scope="module")
def holders(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Holders]:
    """A server that wants tokens."""
    folder: Path = tmp_path_factory.mktemp("matrix")
    with Live(folder, admin_token=ADMIN, enrolment_token=ENROLLER) as server:
        yield Holders(server)


def statuses(route: tuple[str, str], holder: Holder, place: str, robot: str) -> set[int] | None:
    """Status codes that the document prescribes; None: any of the route itself, as the holder is let in."""
    roles, is_of_a_map = set(ROLES_OF[route]), "{name}" in route[1] and route != CREATION
    if "anybody" in roles:
        return None
    if holder.worth != "good":
        return {401}
    if is_of_a_map and holder.place not in (None, place):
        return {401}
    allowed = roles | (READING if "reader" in roles else set())
    if holder.role == "admin":
        may = is_of_a_map or holder.place is None or roles != {"admin"}
    else:
        may = holder.role in allowed or ("own robot" in roles and holder.robot == robot)
    if place == "nowhere" and is_of_a_map:
        return {404} if may else {403, 404}
    return None if may else {403}


def ask(holders: Holders, route: tuple[str, str], holder: Holder, place: str, robot: str) -> httpx.Response:
    """A sound request where that matters for who is let in, an empty message elsewhere."""
    method, path = route
    commit = pushed(0, 0, (AUTHORS | UNKNOWN)[robot])
    row = holders.rows[place].name if place in holders.rows else place  # type: ignore[index]
    parts = defaultdict(lambda: "0") | {
        "name": row,
        "branch": robot,
        "robot": robot,
        "author": str((AUTHORS | UNKNOWN)[robot]),
        "commit": str(commit.id),
        "cell": "0,0,0",
        "voxel": "0,0,0",
        "token": "nobody" if robot in UNKNOWN else "known",
    }
    content = commit.data if "{commit}" in path else b"{}"
    headers = {"Content-Type": "application/json", **holders.headers_of(holder)}
    return holders.live.ask(method, path.format_map(parts), content=content, headers=headers)


@pytest.mark.slow
@pytest.mark.parametrize("route", ROLES_OF, ids=" ".join)
def test_each_token_may_do_what_the_document_says_and_no_more(holders: Holders, route: tuple[str, str]) -> None:
    method, path = route
    holders.renew()
    has_objects = any(part in path for part in ("{branch}", "{commit}", "{token}", "{robot}", "{author}"))
    robots = (*UNKNOWN, *AUTHORS) if has_objects else ("mole",)
    places = ("here", "there", *(["nowhere"] if route != CREATION else []))
    wrong = []
    for holder in HOLDERS:
        refusals, denials = set(), set()
        for place in places if "{name}" in path else ("here",):
            for robot in robots:
                if robot in UNKNOWN and place != "here":
                    continue
                if method == "DELETE" and robot not in UNKNOWN:
                    holders.renew()
                answer = ask(holders, route, holder, place, robot)
                expected = statuses(route, holder, place, robot)
                is_right = answer.status_code in expected if expected else answer.status_code not in (401, 403)
                if not is_right or answer.status_code >= 500:
                    wrong.append(f"{holder} on map {place}, robot {robot}: {answer.status_code}, not {expected}")
                if answer.status_code == 401:
                    assert answer.headers["WWW-Authenticate"] == "Bearer"
                    refusals.add(answer.content)
                if answer.status_code == 403 and place == "here":
                    denials.add(NAMES.sub(b"*", answer.content))
        assert len(refusals) <= 1, f"{holder} learns from refusals which names there are"
        assert len(denials) <= 1, f"{holder} learns from denials which objects there are: {denials}"
    assert wrong == []


def test_the_matrix_has_every_route_and_object_of_the_running_server(holders: Holders) -> None:
    document = holders.live.http.get("/openapi.json").json()
    routes = {(method.upper(), path) for (method, path), _ in operations(document)}
    assert routes | {("GET", "/openapi.json")} == ROLES_OF.keys()
    named = {name for _, path in routes for name in re.findall(r"{(\w+)}", path)}
    assert named == OBJECTS.keys()


@pytest.mark.parametrize(
    "shown",
    [
        ["Bearer"],
        ["Basic " + base64.b64encode(f"admin:{ADMIN}".encode()).decode()],
        [ADMIN],
        [f"Bearer {ADMIN} x"],
        [f"Bearer {ADMIN[:-1]}"],
        [f"Bearer {ADMIN}{ADMIN}"],
        [f"Bearer {ADMIN.upper()}"],
        ["Bearer " + "x" * 9000],
        ["Bearer \u00e9"],
        [f"Bearer {'x' * 43}", f"Bearer {ADMIN}"],
        [f"Token {ADMIN}"],
    ],
    ids=repr,
)
def test_what_is_not_exactly_one_good_token_opens_nothing(holders: Holders, shown: list[str]) -> None:
    for method, path in ROLES_OF:
        if "anybody" not in ROLES_OF[method, path]:
            parts = defaultdict(lambda: "0") | {"name": holders.rows["here"].name, "branch": "mole", "token": "known"}
            headers = [(b"Authorization", text.encode("latin-1")) for text in shown]
            url = holders.live.http.base_url.copy_with(raw_path=path.format_map(parts).encode())
            answer = holders.live.answer_to(holders.live.http.build_request(method, url, headers=headers))
            assert answer.status_code == 401, (method, path)


def shake_hands(holders: Holders, path: str, holder: Holder, place: str, *, offers: bool) -> tuple[int, bytes]:
    """Status and body of a WebSocket's handshake, the token in its header or, as browsers do it, in a subprotocol."""
    row = holders.rows[place].name if place in holders.rows else place  # type: ignore[index]
    headers = holders.headers_of(holder)
    token = headers.get("Authorization", "").removeprefix("Bearer ")
    offered = [
        PROTOCOL,
        *([TOKEN_PREFIX + base64.urlsafe_b64encode(token.encode()).decode().rstrip("=")] * bool(token)),
    ]
    try:
        with connect(
            f"ws://127.0.0.1:{holders.live.port}{path.format(name=row)}",
            additional_headers={} if offers else headers,
            subprotocols=offered if offers else None,  # type: ignore[arg-type]
            open_timeout=DEADLINE_S,
        ):
            return 101, b""
    except InvalidStatus as exc:
        assert exc.response.status_code != 101
        if exc.response.status_code == 401:
            assert exc.response.headers["WWW-Authenticate"] == "Bearer"
        return exc.response.status_code, bytes(exc.response.body or b"")


def sockets() -> list[str]:
    """The app's WebSockets, each of which the document has as a GET."""
    found = [part.path for router in ROUTERS for part in router.routes if isinstance(part, WebSocketRoute)]
    assert all(("GET", path) in ROLES_OF for path in found)
    return found


@pytest.mark.parametrize("offers", [False, True], ids=["header", "subprotocol"])
def test_each_token_opens_the_websockets_that_the_document_lets_it_read(holders: Holders, offers: bool) -> None:
    paths = sockets()
    assert paths == ["/maps/{name}/live"]
    holders.renew()
    wrong = []
    for path in paths:
        for holder in HOLDERS:
            refusals = set()
            for place in ("here", "there", "nowhere"):
                status, body = shake_hands(holders, path, holder, place, offers=offers)
                expected = statuses(("GET", path), holder, place, "mole") or {101}
                if status not in expected:
                    wrong.append(f"{holder} on map {place}: {status}, not {expected}")
                if status == 401:
                    refusals.add(body)
            assert len(refusals) <= 1, f"{holder} learns from refusals which maps there are"
    assert wrong == []


def test_the_matrix_has_routes_of_each_kind_of_right() -> None:
    assert {"anybody", "admin", "operator", "reader", "own robot", "relay", "enroller"} == {
        role for roles in ROLES_OF.values() for role in roles
    }


def test_a_token_lists_the_maps_that_it_counts_on(holders: Holders) -> None:
    holders.renew()
    here, there = (holders.rows[place].name for place in PLACES)

    def seen(holder: Holder) -> set[str]:
        answer = holders.live.http.get("/maps", headers=holders.headers_of(holder))
        return {info["name"] for info in answer.json()} & {here, there}

    assert seen(Holder("reader")) == {here, there}
    assert seen(Holder("reader", "there")) == {there}
    assert seen(Holder("robot", "here", "mole")) == {here}


def test_an_admin_of_one_map_makes_no_maps(holders: Holders) -> None:
    holders.renew()
    rows: list[MapRow] = list(holders.rows.values())
    for name in (rows[0].name, rows[1].name, "new"):
        answer = holders.live.http.put(f"/maps/{name}", json={}, headers=holders.headers_of(Holder("admin", "here")))
        assert answer.status_code == 403
