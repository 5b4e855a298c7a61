"""Routes by which a map leaves the server: as a picture, a file of points or an octree, what changed, what is hot."""

from functools import partial
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Header, Query, Request, Response
from fastapi.responses import StreamingResponse
from starlette.types import Receive, Scope, Send

from cairn_map.epochs.moment import TimeText
from cairn_map.errors import DeniedError
from cairn_map.files.export_request import BOX_CHARS_MAX, EXPORT_TYPES, ExportRequest, ExportTicket, TicketedExport
from cairn_map.queries.hot_spots import VOXELS_MIN, WARM_K
from cairn_map.render.render_request import RenderRequest
from cairn_map.wire.change_messages import ChangesAnswer, RetractChanges
from cairn_map.wire.hot_spot_messages import SPOTS_MAX, VOXELS_MAX, HotSpotsAnswer
from cairn_map.wire.hottest_messages import HOTTEST_MAX, HottestAnswer
from cairn_map.wire.messages import Retract
from cairn_map.wire.spread_messages import SpreadAnswer
from cairn_server.access.auth import Role
from cairn_server.access.connection_places import ConnectionPlace
from cairn_server.http.middleware.deadlines import PLACE
from cairn_server.http.routes.callers import READERS, Asking, Credentials, Map, Operations, allowed
from cairn_server.http.routes.documentation import answers, json_body, problems
from cairn_server.http.routes.json_bodies import json_of
from cairn_server.store.store_rows import MapRow
from cairn_server.views.map_exports import Export, while_allowed

PICTURES = {"png": "image/png", "npz": "application/x-npz"}

router = APIRouter()


class _Download(StreamingResponse):
    """File on its way, which ends without its end once its token has ended: the connection is cut."""

    _place: ConnectionPlace | None = None

    def __init__(self, export: Export, **options: Any) -> None:
        super().__init__(export.parts, **options)
        self._export = export

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request."""
        self._place = scope.get("state", {}).get(PLACE)
        await super().__call__(scope, receive, send)

    async def stream_response(self, send: Send) -> None:
        """Send the parts."""
        try:
            await super().stream_response(send)
        except DeniedError:
            # By itself the answer would be an error in the log. A proxy's connection is left to it.
            if self._place is not None and self._place.cut is not None:
                self._place.cut()
        finally:
            self._export.close()  # also of a file whose reader went away before its first cell


@router.get(
    "/maps/{name}/main/render",
    dependencies=READERS,
    response_class=Response,
    responses=answers({200: tuple(PICTURES.values()), 304: ()}, headers=("ETag", "Cairn-Cursor")) | problems(413),
)
def render(
    service: Operations,
    row: Map,
    asked: Annotated[RenderRequest, Query()],
    if_none_match: Annotated[str | None, Header()] = None,
) -> Response:
    """The map as a camera at a pose would see it: PNG with a legend, or the values as NPZ; strong ETag."""
    view = service.views.pictures.asked(row, asked, known=if_none_match)
    headers = {"ETag": view.etag, "Cache-Control": "no-cache", "Cairn-Cursor": str(view.head)}
    if view.body is None:
        return Response(status_code=304, headers=headers)
    headers["X-Content-Type-Options"] = "nosniff"
    return Response(view.body, media_type=PICTURES[asked.format], headers=headers)


@router.get("/maps/{name}/main/changes", dependencies=READERS, responses=problems(409, 413))
def changes(
    service: Operations,
    row: Map,
    since: TimeText,
    until: TimeText | None = None,
    box: Annotated[
        str | None, Query(max_length=BOX_CHARS_MAX, description="x0,y0,z0,x1,y1,z1: metres, map frame")
    ] = None,
) -> ChangesAnswer:
    """Voxels that appeared, went, moved by a voxel, or became warmer or colder after a time, by capture."""
    return service.views.changes.asked(row, since, until, box)


@router.post(
    "/maps/{name}/main/changes",
    dependencies=[Depends(allowed(Role.OPERATOR))],
    responses=problems(409, 413),
    openapi_extra=json_body(Retract, example={"commits": ["mole.1f2e3d4c5b6a7988.12"]}),
)
def changes_of_retract(service: Operations, row: Map, body: Annotated[Retract, json_of(Retract)]) -> RetractChanges:
    """Voxels that would look otherwise if these commits were taken out; nothing is."""
    return service.views.retracts.asked(row, body)


@router.get("/maps/{name}/main/hottest", dependencies=READERS)
def hottest(
    service: Operations,
    row: Map,
    count: Annotated[int, Query(ge=1, le=HOTTEST_MAX)] = 10,
    box: Annotated[
        str | None, Query(max_length=BOX_CHARS_MAX, description="x0,y0,z0,x1,y1,z1: metres, map frame")
    ] = None,
) -> HottestAnswer:
    """The occupied voxels of the highest temperature: first those that were seen twice or touch a surface."""
    return service.views.hottest.asked(row, count, box)


@router.get("/maps/{name}/main/hotspots", dependencies=READERS)
def hot_spots(
    service: Operations,
    row: Map,
    over_k: Annotated[
        float, Query(ge=0, le=1e5, allow_inf_nan=False, description="least temperature of a spot's voxels, kelvin")
    ] = WARM_K,
    min_voxels: Annotated[int, Query(ge=1, le=VOXELS_MAX)] = VOXELS_MIN,
    count: Annotated[int, Query(ge=1, le=SPOTS_MAX)] = 50,
    box: Annotated[
        str | None, Query(max_length=BOX_CHARS_MAX, description="x0,y0,z0,x1,y1,z1: metres, map frame")
    ] = None,
) -> HotSpotsAnswer:
    """The hot spots: connected occupied voxels above a temperature, with place, size, height, who and when."""
    return service.views.hot_spots.asked(row, over_k=over_k, voxels_min=min_voxels, count=count, box=box)


@router.get("/maps/{name}/main/spread", dependencies=READERS)
def spread(service: Operations, row: Map) -> SpreadAnswer:
    """Histograms of the heights and temperatures of all occupied voxels: the ends of a colour bar."""
    return service.views.spread.asked(row)


async def map_without_ticket(name: str, request: Request, asker: Asking) -> MapRow | None:
    """The map, for a caller that may read it by a token; None: the request has a ticket, which says what it is for."""
    return None if "ticket" in request.query_params else asker.reader(name)


@router.get(
    "/maps/{name}/main/export",
    response_class=Response,
    responses=answers({200: tuple(EXPORT_TYPES.values())}, headers=("Cairn-Cursor", "Cairn-Points")) | problems(413),
)
def export(
    service: Operations,
    name: str,
    row: Annotated[MapRow | None, Depends(map_without_ticket)],
    asker: Asking,
    asked: Annotated[TicketedExport, Query()],
) -> StreamingResponse:
    """Nodes by box, heights, probability, temperature, depth: occupied ones as points, with free ones as an octree."""
    if row is None:
        made = service.views.tickets.shown(asked.ticket or "", name, asked.request)
    else:
        made = while_allowed(service.views.exports.asked(row, asked.request), partial(asker.reader, name))
    headers = {
        "Cache-Control": "no-store",
        "Cairn-Cursor": str(made.head),
        "Cairn-Points": str(made.count),
        "Content-Disposition": f'attachment; filename="{name}.{asked.format}"',
        "X-Content-Type-Options": "nosniff",
    }
    if made.size_bytes is not None:
        headers["Content-Length"] = str(made.size_bytes)
    return _Download(made, media_type=EXPORT_TYPES[asked.format], headers=headers)


@router.post(
    "/maps/{name}/main/export/tickets",
    dependencies=READERS,
    status_code=201,
    responses=problems(429),
    openapi_extra=json_body(ExportRequest, example={"format": "laz", "box": "-4,-4,0,4,4,2.5", "p": 0.7}),
)
def ask_for_ticket(
    service: Operations,
    row: Map,
    credentials: Credentials,
    asked: Annotated[ExportRequest, json_of(ExportRequest)],
) -> ExportTicket:
    """A ticket that stands for the token shown, once and for this export: what a link to save it by has instead."""
    return service.views.tickets.give(row, asked, credentials.credentials if credentials else None)
