"""The route that draws a map. Nothing is decided here."""

from typing import Annotated

from fastapi import APIRouter, Header, Query, Response

from cairn_map.render.render_request import RenderRequest
from cairn_server.http.routes.callers import READERS, Map, Operations

MEDIA_TYPES = {"png": "image/png", "npz": "application/x-npz"}

router = APIRouter()


@router.get("/maps/{name}/main/render", dependencies=READERS)
def render(
    service: Operations,
    row: Map,
    asked: Annotated[RenderRequest, Query()],
    if_none_match: Annotated[str | None, Header()] = None,
) -> Response:
    """The map as a camera at a pose would see it: PNG with a legend, or the values as NPZ; strong ETag."""
    view = service.views.asked(row, asked, known=if_none_match)
    headers = {"ETag": view.etag, "Cache-Control": "no-cache", "Cairn-Cursor": str(view.head.cursor)}
    if view.body is None:
        return Response(status_code=304, headers=headers)
    headers["X-Content-Type-Options"] = "nosniff"
    return Response(view.body, media_type=MEDIA_TYPES[asked.format], headers=headers)
