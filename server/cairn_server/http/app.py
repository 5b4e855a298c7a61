"""The app: all routes of PROTOCOL.md over a `Service`, and what stands before them."""

from fastapi import APIRouter, FastAPI, Request
from fastapi.responses import HTMLResponse

from cairn_server.http.docs_page import docs_page
from cairn_server.http.middleware.body_limit import BodyLimit
from cairn_server.http.middleware.protocol_version import ProtocolVersion
from cairn_server.http.middleware.request_trail import RequestTrail
from cairn_server.http.middleware.same_origin import OwnOrigin
from cairn_server.http.middleware.token_first import TokenFirst
from cairn_server.http.openapi import openapi_of
from cairn_server.http.routes import access as access_routes
from cairn_server.http.routes import cell as cell_routes
from cairn_server.http.routes import console as console_routes
from cairn_server.http.routes import export as export_routes
from cairn_server.http.routes import live as live_routes
from cairn_server.http.routes import map as map_routes
from cairn_server.http.routes import operations as operations_routes
from cairn_server.http.routes import render as render_routes
from cairn_server.http.routes import robot as robot_routes
from cairn_server.http.routes import sync as sync_routes
from cairn_server.http.routes import upload as upload_routes
from cairn_server.http.routes.problems import add_problem_handlers
from cairn_server.service import Service

router = APIRouter()
ROUTERS = (
    router,
    map_routes.router,
    sync_routes.router,
    cell_routes.router,
    access_routes.router,
    operations_routes.router,
    live_routes.router,
    robot_routes.router,
    upload_routes.router,
    render_routes.router,
    export_routes.router,
    console_routes.router,
)


@router.get("/healthz")
def healthz() -> dict[str, str]:
    """The process answers."""
    return {"status": "ok"}


@router.get("/docs", response_class=HTMLResponse)
def docs(request: Request) -> HTMLResponse:
    """The routes for people."""
    headers = {"Content-Security-Policy": "default-src 'none'; style-src 'unsafe-inline'"}
    return HTMLResponse(docs_page(openapi_of(request.app)), headers=headers)


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
    for part in ROUTERS:
        app.include_router(part)
    app.openapi = lambda: openapi_of(app)  # type: ignore[method-assign]
    add_problem_handlers(app)
    app.add_middleware(TokenFirst, service=service)
    app.add_middleware(BodyLimit)
    app.add_middleware(ProtocolVersion)
    if service.settings.admin_token is None:
        app.add_middleware(OwnOrigin, host=service.settings.host)
    app.add_middleware(RequestTrail, figures=service.figures)
    return app
