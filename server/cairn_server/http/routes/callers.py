"""Who calls and what of: the dependencies that routes share. Checks of rights are made here, by `auth`.

Those that every push and fetch needs are `async`, which here only means that no other thread is needed to run them: a
change of threads takes longer than they do, more so while other threads are at work, and each push would make five. A
token is looked up by its key, which takes some 40 us and waits for no writer.
"""

from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Annotated

from fastapi import Depends, Request
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer

from cairn_map.errors import NotFoundError
from cairn_server.access.auth import READING, Caller, Role, bad_token, caller_of, require, require_all_maps
from cairn_server.service import Service
from cairn_server.store.store_rows import MapRow

bearer = HTTPBearer(auto_error=False)


async def service_of(request: Request) -> Service:
    """The app's service."""
    service: Service = request.app.state.service
    return service


Operations = Annotated[Service, Depends(service_of)]
Credentials = Annotated[HTTPAuthorizationCredentials | None, Depends(bearer)]


def map_now(name: str, service: Service, credentials: HTTPAuthorizationCredentials | None) -> MapRow:
    """The map of a name; strangers are not told which names there are."""
    try:
        return service.store.map(name)
    except NotFoundError:
        if caller_now(service, None, credentials).map_number is not None:
            raise bad_token() from None
        raise


def caller_now(service: Service, row: MapRow | None, credentials: HTTPAuthorizationCredentials | None) -> Caller:
    """Who calls, on a map or (None) where none is named; a token of one map counts on that map only."""
    return caller_of(credentials.credentials if credentials else None, row, service.store, service.settings)


async def map_of(name: str, service: Operations, credentials: Credentials) -> MapRow:
    """The map named in the path."""
    return map_now(name, service, credentials)


Map = Annotated[MapRow, Depends(map_of)]


def anybody(service: Operations, credentials: Credentials) -> Caller:
    """Who calls, where no map is named yet."""
    return caller_now(service, None, credentials)


async def caller_on_map(service: Operations, row: Map, credentials: Credentials) -> Caller:
    """Who calls, on the map in the path."""
    return caller_now(service, row, credentials)


OnMap = Annotated[Caller, Depends(caller_on_map)]


def allowed(*roles: Role) -> Callable[[Caller], Awaitable[Caller]]:
    """A dependency: the caller on a map, if it is an admin or has one of these roles."""

    async def check(caller: OnMap) -> Caller:
        require(caller, *roles)
        return caller

    return check


def admin(caller: Annotated[Caller, Depends(anybody)]) -> Caller:
    """The caller, if it is an admin of all maps."""
    require(caller)
    require_all_maps(caller)
    return caller


def reader_somewhere(caller: Annotated[Caller, Depends(anybody)]) -> Caller:
    """The caller, if it may read some map or all."""
    require(caller, *READING)
    return caller


async def own_branch(branch: str, caller: OnMap) -> Caller:
    """The caller, if it is an admin or the robot of the branch in the path."""
    require_owner(caller, branch)
    return caller


def require_owner(caller: Caller, branch: str) -> None:
    """Refuse who is neither an admin nor the robot of a branch."""
    require(caller, *([Role.ROBOT, Role.RELAY] if caller.robot == branch else []))


@dataclass(frozen=True, slots=True)
class Visit:
    """Who does something with a map, all at once: for routes that robots ask all day.

    FastAPI takes some 40 us for each dependency of a dependency, which for a push was as long as its check.
    """

    service: Service
    row: MapRow
    caller: Caller


async def visiting_robot(name: str, request: Request, credentials: Credentials) -> Visit:
    """A robot, a relay or an admin on the map in the path."""
    visit = _visit(name, request, credentials)
    require(visit.caller, Role.ROBOT, Role.RELAY)
    return visit


async def visiting_owner(name: str, branch: str, request: Request, credentials: Credentials) -> Visit:
    """The robot of the branch in the path, or an admin."""
    visit = _visit(name, request, credentials)
    require_owner(visit.caller, branch)
    return visit


def _visit(name: str, request: Request, credentials: HTTPAuthorizationCredentials | None) -> Visit:
    service: Service = request.app.state.service
    row = map_now(name, service, credentials)
    return Visit(service, row, caller_now(service, row, credentials))


async def body_of(request: Request) -> bytes:
    """The whole body; `BodyLimit` bounds it."""
    return await request.body()


reader = allowed(*READING)

ADMIN = [Depends(admin)]
READERS = [Depends(reader)]
OWNERS = [Depends(own_branch)]
