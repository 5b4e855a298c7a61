"""The app: all routes of PROTOCOL.md over a `Service`, and the middleware in front of them."""

from collections.abc import Iterator

from fastapi import APIRouter, FastAPI, Request, Response
from fastapi.responses import HTMLResponse
from starlette.middleware import Middleware

from cairn_server.access.body_budget import BodyBudget
from cairn_server.access.connection_places import ConnectionPlaces
from cairn_server.access.own_names import OwnNames
from cairn_server.access.turns import Turns
from cairn_server.http.middleware.body_limit import BodyLimit, turns_of_long_bodies
from cairn_server.http.middleware.connection_shares import ConnectionShares
from cairn_server.http.middleware.head_checks import (
    DeniedHandshakes,
    HeadRequests,
    PlainPath,
    ProtocolVersion,
    SameOrigin,
)
from cairn_server.http.middleware.request_trail import RequestTrail
from cairn_server.http.middleware.token_first import TokenFirst
from cairn_server.http.middleware.work_turns import Lanes, WorkTurns
from cairn_server.http.openapi import DocumentedApp
from cairn_server.http.routes import attachment as attachment_routes
from cairn_server.http.routes import branch as branch_routes
from cairn_server.http.routes import cell as cell_routes
from cairn_server.http.routes import console as console_routes
from cairn_server.http.routes import export as export_routes
from cairn_server.http.routes import live as live_routes
from cairn_server.http.routes import map as map_routes
from cairn_server.http.routes import operations as operations_routes
from cairn_server.http.routes import sync as sync_routes
from cairn_server.http.routes.long_bodies import LongBodies
from cairn_server.http.routes.problems import PROBLEM_HANDLERS
from cairn_server.service import Service

router = APIRouter()
ROUTERS = (
    sync_routes.router,
    router,
    map_routes.router,
    attachment_routes.router,
    branch_routes.router,
    cell_routes.router,
    export_routes.router,
    live_routes.router,
    operations_routes.router,
    console_routes.router,
)
"""In the order in which the path of a request is compared with theirs: a push comes first, not after 18 others."""


@router.get("/docs", response_class=HTMLResponse)
def docs(request: Request) -> HTMLResponse:
    """The routes for people."""
    headers = {"Content-Security-Policy": "default-src 'none'; style-src 'unsafe-inline'"}
    return HTMLResponse(request.app.page_bytes, headers=headers)


@router.get("/openapi.json", include_in_schema=False)
def openapi(request: Request) -> Response:
    """The routes for machines."""
    return Response(request.app.document_bytes, media_type="application/json")


def make_app(service: Service, *, long_bodies: LongBodies | None = None) -> FastAPI:
    """The app over a service, which the caller closes; without `long_bodies` they are parsed in threads."""
    settings = service.settings
    lanes, bodies = Lanes(), BodyBudget(settings.memory.bodies_bytes)
    reading = turns_of_long_bodies()
    own_names = OwnNames.of(settings, service.certificate)
    places = ConnectionPlaces(settings.limit_concurrency, trusted_proxies=settings.trusted_proxies)
    app = DocumentedApp(
        title="cairn map server",
        version="1",
        description="See server/PROTOCOL.md.",
        docs_url=None,
        openapi_url=None,
        redoc_url=None,
        redirect_slashes=False,
        middleware=list(_middleware(service, own_names, lanes, bodies, reading, places)),
        exception_handlers=PROBLEM_HANDLERS,
    )
    app.state.service = service
    app.state.own_names = own_names
    app.state.lanes, app.state.bodies, app.state.reading, app.state.places = lanes, bodies, reading, places
    app.state.long_bodies = long_bodies or LongBodies()
    app.state.console_files = console_routes.ConsoleFiles()
    for part in ROUTERS if settings.folding != "only" else (operations_routes.router,):
        app.include_router(part)
    return app


def _middleware(
    service: Service,
    own_names: OwnNames,
    lanes: Lanes,
    bodies: BodyBudget,
    reading: Turns,
    places: ConnectionPlaces,
) -> Iterator[Middleware]:
    """Middleware in the order in which a request passes it; the answer passes it in reverse."""
    yield Middleware(DeniedHandshakes)
    yield Middleware(RequestTrail, figures=service.figures, time_s=service.clock.now_s)
    if service.settings.admin_token is None:
        yield Middleware(SameOrigin, host=service.settings.host)
    yield Middleware(ProtocolVersion)
    yield Middleware(PlainPath)
    yield Middleware(TokenFirst, service=service, own_names=own_names)
    yield Middleware(ConnectionShares, places=places)
    yield Middleware(BodyLimit, budget=bodies, turns=reading)
    yield Middleware(WorkTurns, lanes=lanes, stop=service.stop_time)
    yield Middleware(HeadRequests)
