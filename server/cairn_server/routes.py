"""HTTP: the routes of PROTOCOL.md over `Service`. Nothing is decided here."""

import json
from collections.abc import Callable
from typing import Annotated

from fastapi import APIRouter, Depends, FastAPI, Header, Query, Request, Response
from fastapi.responses import HTMLResponse
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer

from cairn_map.cell_files import CELL_MEDIA_TYPE, FORMS, MEDIA_TYPES, cell_file
from cairn_map.errors import BadInputError, NotFoundError
from cairn_map.grid import cell_from_text, cell_key
from cairn_map.ids import author_from_text
from cairn_map.messages import (
    BranchInfo,
    CellIndex,
    CreateMap,
    LogEntry,
    MapInfo,
    MissingRequest,
    Pushed,
    Register,
    Registered,
    Retract,
    Retracted,
)
from cairn_server.auth import Caller, Role, caller_of, require
from cairn_server.body_limit import BodyLimit
from cairn_server.cells_at_rest import stored_evidence
from cairn_server.own_origin import OwnOrigin
from cairn_server.problems import add_problem_handlers
from cairn_server.service import Service
from cairn_server.store import MapRow

REPLY_MEDIA_TYPE = "application/vnd.cairn.reply"
LOG_PAGE_MAX = 1000
PAGE = """<!doctype html><title>cairn</title><h1>cairn map server</h1>
<p>It runs. <a href="maps">Maps</a>, <a href="openapi.json">routes</a>;
<code>cairn map ls</code> lists the maps in a terminal.</p>"""

router = APIRouter()
bearer = HTTPBearer(auto_error=False)


def service_of(request: Request) -> Service:
    """The app's service."""
    service: Service = request.app.state.service
    return service


Operations = Annotated[Service, Depends(service_of)]
Credentials = Annotated[HTTPAuthorizationCredentials | None, Depends(bearer)]


def map_of(name: str, service: Operations, credentials: Credentials) -> MapRow:
    """The map named in the path; strangers are not told which names there are."""
    try:
        return service.store.map(name)
    except NotFoundError:
        anybody(service, credentials)
        raise


Map = Annotated[MapRow, Depends(map_of)]


def anybody(service: Operations, credentials: Credentials) -> Caller:
    """Who calls, where no map is named yet."""
    return caller_of(credentials.credentials if credentials else None, None, service.store, service.settings)


def caller_on_map(service: Operations, row: Map, credentials: Credentials) -> Caller:
    """Who calls; robots' tokens count on their own map only."""
    return caller_of(credentials.credentials if credentials else None, row, service.store, service.settings)


OnMap = Annotated[Caller, Depends(caller_on_map)]


def allowed(*roles: Role) -> Callable[[Caller], Caller]:
    """A dependency: the caller on a map, if it is an admin or has one of these roles."""

    def check(caller: OnMap) -> Caller:
        require(caller, *roles)
        return caller

    return check


def admin(caller: Annotated[Caller, Depends(anybody)]) -> Caller:
    """The caller, if it is an admin."""
    require(caller)
    return caller


def own_branch(branch: str, caller: OnMap) -> Caller:
    """The caller, if it is an admin or the robot of the branch in the path."""
    require(caller, *([Role.ROBOT] if caller.robot == branch else []))
    return caller


async def body_of(request: Request) -> bytes:
    """The whole body; `BodyLimit` bounds it."""
    return await request.body()


ADMIN = [Depends(admin)]
READERS = [Depends(allowed(Role.ROBOT))]
OWNERS = [Depends(own_branch)]


@router.get("/healthz")
def healthz() -> dict[str, str]:
    """The process answers."""
    return {"status": "ok"}


@router.get("/", response_class=HTMLResponse)
def page() -> str:
    """A page for whoever opens the server in a browser."""
    return PAGE


@router.get("/maps", dependencies=ADMIN)
def list_maps(service: Operations) -> list[MapInfo]:
    """All maps."""
    return [service.map_info(row) for row in service.store.maps()]


@router.put("/maps/{name}", status_code=201, dependencies=ADMIN)
def create_map(
    name: str,
    body: CreateMap,
    service: Operations,
    response: Response,
) -> MapInfo:
    """Create a map; 200 if an equal one exists."""
    info, is_new = service.create_map(name, body)
    response.status_code = 201 if is_new else 200
    return info


@router.get("/maps/{name}", dependencies=[Depends(allowed(Role.ROBOT, Role.ENROLLER))])
def get_map(service: Operations, row: Map) -> MapInfo:
    """One map's extent, sizes and head."""
    return service.map_info(row)


@router.post("/maps/{name}/branches", status_code=201, dependencies=[Depends(allowed(Role.ENROLLER))])
def register(body: Register, service: Operations, row: Map) -> Registered:
    """Register a robot; registering again replaces its token."""
    return service.register(row, body)


@router.get("/maps/{name}/branches", dependencies=READERS)
def list_branches(service: Operations, row: Map) -> list[BranchInfo]:
    """All robots, and how far behind each is."""
    return service.branches(row)


@router.delete("/maps/{name}/branches/{branch}", status_code=204, dependencies=OWNERS)
def deregister(branch: str, service: Operations, row: Map) -> None:
    """Deregister a robot; its evidence stays."""
    service.store.deregister(row, branch)


@router.put("/maps/{name}/commits/{commit}")
def push(
    commit: str,
    service: Operations,
    row: Map,
    caller: Annotated[Caller, Depends(allowed(Role.ROBOT))],
    response: Response,
    data: Annotated[bytes, Depends(body_of)],
) -> Pushed:
    """Push a commit: 201 new, 200 seen before, 409 other bytes under this id."""
    is_new = service.push(row, caller, commit, data)
    response.status_code = 201 if is_new else 200
    return Pushed(id=commit, state="new" if is_new else "known")


@router.post("/maps/{name}/branches/{branch}/missing", dependencies=OWNERS)
def missing(branch: str, body: MissingRequest, service: Operations, row: Map) -> Response:
    """The frames that bring the asker to the head."""
    return Response(service.missing(row, branch, body), media_type=REPLY_MEDIA_TYPE)


@router.post("/maps/{name}/retracts", status_code=201, dependencies=[Depends(allowed())])
def retract(body: Retract, service: Operations, row: Map) -> Retracted:
    """Undo commits exactly."""
    return service.retract(row, body)


@router.get("/maps/{name}/log", dependencies=READERS)
def log(
    service: Operations,
    row: Map,
    after: Annotated[int, Query(ge=0, lt=1 << 63)] = 0,
    limit: Annotated[int, Query(ge=1, le=LOG_PAGE_MAX)] = 100,
) -> list[LogEntry]:
    """Log entries, oldest first."""
    with service.store.snapshot(row) as snapshot:
        return snapshot.log(after_seq=after, limit=limit)


@router.get("/maps/{name}/main/cells", dependencies=READERS)
def cell_index(service: Operations, row: Map, author: Annotated[str | None, Query(max_length=80)] = None) -> CellIndex:
    """All cells that were ever touched, from one state."""
    return service.cell_index(row, author_from_text(author) if author else None)


@router.get("/maps/{name}/main/cells/{cell}", dependencies=READERS)
def get_cell(
    cell: str,
    service: Operations,
    row: Map,
    if_none_match: Annotated[str | None, Header()] = None,
) -> Response:
    """One cell: the octree, or by suffix `.npz`, `.ply`, `.view`; strong ETag, cursor and coverage in the headers."""
    number, dot, suffix = cell.partition(".")
    key = cell_key(cell_from_text(number))
    if dot and suffix not in MEDIA_TYPES:
        raise BadInputError("unknown_format", f"cells come as {FORMS}, not as .{suffix[:16]}")
    stored, head = service.cell(row, key)
    if stored is None:
        raise NotFoundError("no_cell", f"nobody has seen cell {number} of map {row.name}")
    etag = f'"{stored.digest.hex()}{dot}{suffix}"'
    headers = {
        "ETag": etag,
        "Cache-Control": "no-cache",
        "Cairn-Cursor": str(head.cursor),
        "Cairn-Coverage": json.dumps(head.vector.to_json(), separators=(",", ":")),
        "Cairn-Fingerprint": stored.fingerprint.hex(),
    }
    if if_none_match and (if_none_match.strip() == "*" or etag in [t.strip() for t in if_none_match.split(",")]):
        return Response(status_code=304, headers=headers)
    if not suffix:
        return Response(stored.body, media_type=CELL_MEDIA_TYPE, headers=headers)
    data, media_type = cell_file(suffix, key, stored_evidence(stored), row.geometry, row.sensor_model)
    headers["Content-Disposition"] = f'attachment; filename="{row.name}_{number}.{suffix}"'
    return Response(data, media_type=media_type, headers=headers)


def make_app(service: Service) -> FastAPI:
    """The app over a service; whoever made the service closes it."""
    app = FastAPI(
        title="cairn map server",
        version="1",
        description="See server/PROTOCOL.md.",
        docs_url=None,
        redoc_url=None,
        redirect_slashes=False,
    )
    app.state.service = service
    app.include_router(router)
    add_problem_handlers(app)
    app.add_middleware(BodyLimit)
    if service.settings.admin_token is None:
        app.add_middleware(OwnOrigin, host=service.settings.host)
    return app
