"""HTTP: the routes of PROTOCOL.md over `Service`. Nothing is decided here."""

import json
from typing import Annotated

from fastapi import APIRouter, Depends, FastAPI, Header, Query, Request, Response
from fastapi.responses import HTMLResponse
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer

from cairn_map.cell_files import CELL_MEDIA_TYPE, cell_file
from cairn_map.errors import NotFoundError
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
from cairn_server.folding import stored_evidence
from cairn_server.problems import add_problem_handlers
from cairn_server.service import Service
from cairn_server.store import MapRow

FRAMES_MEDIA_TYPE = "application/vnd.cairn.frames"
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


def map_of(name: str, service: Annotated[Service, Depends(service_of)]) -> MapRow:
    """The map named in the path."""
    return service.store.map(name)


Operations = Annotated[Service, Depends(service_of)]
Map = Annotated[MapRow, Depends(map_of)]
Credentials = Annotated[HTTPAuthorizationCredentials | None, Depends(bearer)]


def anybody(service: Operations, credentials: Credentials) -> Caller:
    """Who calls, where no map is named yet."""
    return caller_of(credentials.credentials if credentials else None, None, service.store, service.settings)


def caller_on_map(service: Operations, row: Map, credentials: Credentials) -> Caller:
    """Who calls; robots' tokens count on their own map only."""
    return caller_of(credentials.credentials if credentials else None, row, service.store, service.settings)


async def body_of(request: Request) -> bytes:
    """The whole body; `BodyLimit` bounds it."""
    return await request.body()


OnMap = Annotated[Caller, Depends(caller_on_map)]


@router.get("/healthz")
def healthz() -> dict[str, str]:
    """The process answers."""
    return {"status": "ok"}


@router.get("/", response_class=HTMLResponse)
def page() -> str:
    """A page for whoever opens the server in a browser."""
    return PAGE


@router.get("/maps")
def list_maps(service: Operations, caller: Annotated[Caller, Depends(anybody)]) -> list[MapInfo]:
    """All maps."""
    require(caller)
    return [service.map_info(row) for row in service.store.maps()]


@router.put("/maps/{name}", status_code=201)
def create_map(
    name: str,
    body: CreateMap,
    service: Operations,
    response: Response,
    caller: Annotated[Caller, Depends(anybody)],
) -> MapInfo:
    """Create a map; 200 if an equal one exists."""
    require(caller)
    info, is_new = service.create_map(name, body)
    response.status_code = 201 if is_new else 200
    return info


@router.get("/maps/{name}")
def get_map(service: Operations, row: Map, caller: OnMap) -> MapInfo:
    """One map's extent, sizes and head."""
    require(caller, Role.ROBOT, Role.ENROLLER)
    return service.map_info(row)


@router.post("/maps/{name}/branches", status_code=201)
def register(body: Register, service: Operations, row: Map, caller: OnMap) -> Registered:
    """Register a robot; registering again replaces its token."""
    require(caller, Role.ENROLLER)
    return service.register(row, body)


@router.get("/maps/{name}/branches")
def list_branches(service: Operations, row: Map, caller: OnMap) -> list[BranchInfo]:
    """All robots, and how far behind each is."""
    require(caller, Role.ROBOT)
    return service.branches(row)


@router.delete("/maps/{name}/branches/{branch}", status_code=204)
def deregister(branch: str, service: Operations, row: Map, caller: OnMap) -> None:
    """Deregister a robot; its evidence stays."""
    require_branch(caller, branch)
    service.store.deregister(row, branch)


@router.put("/maps/{name}/commits/{commit}")
def push(
    commit: str,
    service: Operations,
    row: Map,
    caller: OnMap,
    response: Response,
    data: Annotated[bytes, Depends(body_of)],
) -> Pushed:
    """Push a commit: 201 new, 200 seen before, 409 other bytes under this id."""
    require(caller, Role.ROBOT)
    is_new = service.push(row, caller, commit, data)
    response.status_code = 201 if is_new else 200
    return Pushed(id=commit, state="new" if is_new else "known")


@router.post("/maps/{name}/branches/{branch}/missing")
def missing(branch: str, body: MissingRequest, service: Operations, row: Map, caller: OnMap) -> Response:
    """The frames that bring the asker to the head."""
    require_branch(caller, branch)
    return Response(service.missing(row, branch, body), media_type=FRAMES_MEDIA_TYPE)


@router.post("/maps/{name}/retracts", status_code=201)
def retract(body: Retract, service: Operations, row: Map, caller: OnMap) -> Retracted:
    """Undo commits exactly."""
    require(caller)
    return service.retract(row, body)


@router.get("/maps/{name}/log")
def log(
    service: Operations,
    row: Map,
    caller: OnMap,
    after: Annotated[int, Query(ge=0)] = 0,
    limit: Annotated[int, Query(ge=1, le=LOG_PAGE_MAX)] = 100,
) -> list[LogEntry]:
    """Log entries, oldest first."""
    require(caller, Role.ROBOT)
    with service.store.snapshot(row) as snapshot:
        return snapshot.log(after_seq=after, limit=limit)


@router.get("/maps/{name}/main/cells")
def cell_index(
    service: Operations, row: Map, caller: OnMap, author: Annotated[str | None, Query(max_length=80)] = None
) -> CellIndex:
    """All cells that were ever touched, from one state."""
    require(caller, Role.ROBOT)
    return service.cell_index(row, author_from_text(author) if author else None)


@router.get("/maps/{name}/main/cells/{cell}")
def get_cell(
    cell: str,
    service: Operations,
    row: Map,
    caller: OnMap,
    if_none_match: Annotated[str | None, Header()] = None,
) -> Response:
    """One cell: the octree, or by suffix `.npz` and `.ply`; strong ETag, cursor and coverage in the headers."""
    require(caller, Role.ROBOT)
    number, dot, suffix = cell.partition(".")
    key = cell_key(cell_from_text(number))
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


def require_branch(caller: Caller, branch: str) -> None:
    """Refuse a robot that speaks for another branch than its own."""
    require(caller, *([Role.ROBOT] if caller.robot == branch else []))


def make_app(service: Service) -> FastAPI:
    """The app over a service; whoever made the service closes it."""
    app = FastAPI(
        title="cairn map server", version="1", description="See server/PROTOCOL.md.", docs_url=None, redoc_url=None
    )
    app.state.service = service
    app.include_router(router)
    add_problem_handlers(app)
    app.add_middleware(BodyLimit)
    return app
