"""Callers and what they ask for: the dependencies that routes share. Rights are checked here, by `auth`.

Those that every push and fetch needs are `async`, which here only means that no other thread is needed to run them: a
change of threads takes longer than they do, more so while other threads are at work, and each push would make five. A
token is looked up by its key, which takes some 40 us and waits for no writer.
"""

from collections.abc import Awaitable, Callable
from dataclasses import dataclass, replace
from typing import Annotated, Any

from fastapi import Depends, Header, Request
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer
from starlette.requests import HTTPConnection

from cairn_map.commits.commit import EPOCH_VERSION, SUM_VERSION
from cairn_map.commits.key_proof import PROOF_TEXT_MAX
from cairn_map.errors import BadInputError, DeniedError, NotFoundError
from cairn_map.wire.utc_times import with_utc
from cairn_server.access.auth import READING, Caller, Role, bad_token, require, require_all_maps
from cairn_server.access.own_names import OwnNames
from cairn_server.service import Service
from cairn_server.store.store_rows import MapRow

bearer = HTTPBearer(auto_error=False)


async def service_of(request: Request) -> Service:
    """The app's service."""
    service: Service = request.app.state.service
    return service


Operations = Annotated[Service, Depends(service_of)]
Credentials = Annotated[HTTPAuthorizationCredentials | None, Depends(bearer)]


@dataclass(frozen=True, slots=True)
class Asker:
    """Client of one request or stream, and the service that it asks."""

    service: Service
    credentials: HTTPAuthorizationCredentials | None
    address: str
    """Address of the client."""

    def map(self, name: str) -> MapRow:
        """The map of a name; clients without access to all maps cannot find out which names exist."""
        try:
            return self.service.store.map(name)
        except NotFoundError:
            if self.caller(None).map_number is not None:
                raise bad_token() from None
            raise

    def caller(self, row: MapRow | None) -> Caller:
        """The caller, on a map or (None) where none is named; a token of one map counts on that map only."""
        token = self.credentials.credentials if self.credentials else None
        return replace(self.service.holders.of(token, row), address=self.address)

    def reader(self, name: str) -> MapRow:
        """The map of a name, if the caller may read it."""
        row = self.map(name)
        require(self.caller(row), *READING)
        return row


async def asker_of(request: Request, credentials: Credentials) -> Asker:
    """The client of a request."""
    return asker_for(request, credentials)


def asker_for(request: HTTPConnection, credentials: HTTPAuthorizationCredentials | None) -> Asker:
    """The client of a request or a stream, by what it showed."""
    address = request.client.host if request.client is not None else ""
    return Asker(request.app.state.service, credentials, address)


Asking = Annotated[Asker, Depends(asker_of)]


async def times_for(cairn_protocol: Annotated[str | None, Header(max_length=8)] = None) -> Callable[[Any], Any]:
    """Function that adds the times of an answer in ISO 8601 for people, who state no version of the protocol."""
    return _unchanged if cairn_protocol is not None else with_utc


def _unchanged(message: Any) -> Any:
    return message


Times = Annotated[Callable[[Any], Any], Depends(times_for)]


async def map_of(name: str, asker: Asking) -> MapRow:
    """The map named in the path."""
    return asker.map(name)


Map = Annotated[MapRow, Depends(map_of)]


def caller_anywhere(asker: Asking) -> Caller:
    """The caller, where no map is named."""
    return asker.caller(None)


async def caller_on_map(row: Map, asker: Asking) -> Caller:
    """The caller, on the map in the path."""
    return asker.caller(row)


OnMap = Annotated[Caller, Depends(caller_on_map)]


async def format_of(cairn_format: Annotated[str | None, Header(max_length=8)] = None) -> int:
    """Newest version of the map format that a client reads, which clients state from version 2 on."""
    return int(cairn_format) if cairn_format is not None and cairn_format.isdecimal() else SUM_VERSION


Format = Annotated[int, Depends(format_of)]


def require_format(row: MapRow, known: int) -> None:
    """Refuse a client that could not read the bytes of a map's cells.

    Raises:
        BadInputError: kind `unknown_version`.
    """
    if row.layer.has_epochs and known < EPOCH_VERSION:
        raise BadInputError(
            "unknown_version",
            f"map {row.name} keeps evidence by epoch, in bytes of version {EPOCH_VERSION}, and this client reads "
            f"version {known}; update it, or have it work on a map made with --epoch none",
        )


def allowed(*roles: Role) -> Callable[[Caller], Awaitable[Caller]]:
    """A dependency: the caller on a map, if it is an admin or has one of these roles."""

    async def check(caller: OnMap) -> Caller:
        require(caller, *roles)
        return caller

    return check


async def own_origins(request: Request) -> frozenset[str]:
    """Origins of this server that a proof may name which came with this request."""
    names: OwnNames = request.app.state.own_names
    return names.origins(request.scope["scheme"], request.scope["server"])


OwnOrigins = Annotated[frozenset[str], Depends(own_origins)]


async def registrar(
    row: Map,
    asker: Asking,
    own: OwnOrigins,
    cairn_proof: Annotated[str | None, Header(max_length=PROOF_TEXT_MAX)] = None,
) -> Caller:
    """The caller, if it may register robots: by a token, or without one by a key that an operator lets in."""
    try:
        caller = asker.caller(row)
    except DeniedError:
        if asker.credentials is not None or cairn_proof is None:
            raise
        returning = asker.service.sync.admissions.returning(row.name, cairn_proof, own=own)
        return replace(returning, address=asker.address)
    require(caller, Role.ENROLLER)
    return caller


def admin(caller: Annotated[Caller, Depends(caller_anywhere)]) -> Caller:
    """The caller, if it is an admin of all maps."""
    require(caller)
    require_all_maps(caller)
    return caller


def reader_somewhere(caller: Annotated[Caller, Depends(caller_anywhere)]) -> Caller:
    """The caller, if it may read some map or all."""
    require(caller, *READING)
    return caller


async def own_branch(branch: str, caller: OnMap) -> Caller:
    """The caller, if it is an admin or the robot of the branch in the path."""
    require_owner(caller, branch)
    return caller


def require_owner(caller: Caller, branch: str) -> None:
    """Refuse a caller that is neither an admin nor the robot of a branch."""
    require(caller, *([Role.ROBOT, Role.RELAY] if caller.robot == branch else []))


@dataclass(frozen=True, slots=True)
class Visit:
    """Service, map and caller of a request, found in one dependency: for routes that robots call all day.

    FastAPI takes some 40 us for each dependency of a dependency, which for a push was as long as its check. So these
    routes read the token themselves, and say in their `openapi_extra` that they take one (`documentation.TAKES_TOKEN`).
    """

    service: Service
    row: MapRow
    caller: Caller
    format: int
    """`format_of` the client."""


async def visiting_robot(name: str, request: Request) -> Visit:
    """A robot, a relay or an admin on the map in the path."""
    visit = await _visit(name, request)
    require(visit.caller, Role.ROBOT, Role.RELAY)
    return visit


async def visiting_owner(name: str, branch: str, request: Request) -> Visit:
    """The robot of the branch in the path, or an admin."""
    visit = await _visit(name, request)
    require_owner(visit.caller, branch)
    return visit


async def _visit(name: str, request: Request) -> Visit:
    asker = asker_for(request, await bearer(request))
    row = asker.map(name)
    return Visit(asker.service, row, asker.caller(row), await format_of(request.headers.get("cairn-format")))


async def body_of(request: Request) -> bytes:
    """The whole body; `BodyLimit` bounds it. A token that ended while it came does not count.

    Raises:
        DeniedError: kind `bad_token`.
    """
    data = await request.body()
    credentials = await bearer(request)
    if credentials is not None:
        asker_for(request, credentials).caller(None)
    return data


reader = allowed(*READING)

ADMIN = [Depends(admin)]
READERS = [Depends(reader)]
OWNERS = [Depends(own_branch)]
