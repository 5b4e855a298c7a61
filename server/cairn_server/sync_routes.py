"""Routes of push and fetch-missing. Nothing is decided here."""

from typing import Annotated

from fastapi import APIRouter, Depends, Response

from cairn_map.messages import MissingRequest, Pushed
from cairn_server.auth import Caller, Role
from cairn_server.http_access import OWNERS, Map, Operations, allowed, body_of

REPLY_MEDIA_TYPE = "application/vnd.cairn.reply"

router = APIRouter()


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
