"""Routes of what robots report of themselves. Nothing is decided here."""

from email.utils import formatdate
from typing import Annotated

from fastapi import APIRouter, Depends, Header, Response

from cairn_map.wire.messages import RobotStatus
from cairn_server.http.routes.callers import OWNERS, READERS, Map, Operations, body_of

router = APIRouter()


@router.put("/maps/{name}/branches/{branch}/status", status_code=204, dependencies=OWNERS)
def put_status(branch: str, body: RobotStatus, service: Operations, row: Map) -> None:
    """Tell where a robot is and how it is doing; only the last one is kept."""
    service.reports.put_status(row, branch, body)


@router.put("/maps/{name}/branches/{branch}/view", status_code=204, dependencies=OWNERS)
def put_view(branch: str, service: Operations, row: Map, data: Annotated[bytes, Depends(body_of)]) -> None:
    """Show what a robot sees: a JPEG or PNG, kept in memory until the next one."""
    service.reports.put_view(row, branch, data)


@router.get("/maps/{name}/branches/{branch}/view", dependencies=READERS)
def get_view(
    branch: str, service: Operations, row: Map, if_none_match: Annotated[str | None, Header()] = None
) -> Response:
    """A robot's latest picture; strong ETag, `Last-Modified` is when it came."""
    view = service.reports.view(row, branch)
    headers = {
        "ETag": f'"{view.digest}"',
        "Last-Modified": formatdate(view.time_s, usegmt=True),
        "Cache-Control": "no-cache",
        # Whatever else the bytes may be read as, a browser is to take them for a picture.
        "X-Content-Type-Options": "nosniff",
        "Content-Security-Policy": "default-src 'none'; sandbox",
    }
    if if_none_match and (if_none_match.strip() == "*" or headers["ETag"] in if_none_match):
        return Response(status_code=304, headers=headers)
    return Response(view.data, media_type=view.media_type, headers=headers)
