"""Routes of the attachments of marks: which are wanted, one to be saved as a file, and the parts of one."""

from typing import Annotated

from fastapi import APIRouter, Depends, Header, Query, Response
from starlette.concurrency import run_in_threadpool

from cairn_map.commits.attachment import PICTURES, PLAIN_BYTES, media_type_of
from cairn_map.wire.mark_messages import PAGE_MAX, AttachmentState, WantedAttachments
from cairn_server.access.auth import Caller, Role
from cairn_server.http.routes.callers import READERS, Map, Operations, allowed, body_of
from cairn_server.http.routes.documentation import answers, body, problems

ATTACHMENT = "/maps/{name}/main/attachments/{sha}"
MEDIA_TYPES = (*(media_type for _, _, media_type, _ in PICTURES), PLAIN_BYTES)
Sender = Annotated[Caller, Depends(allowed(Role.OPERATOR, Role.ROBOT, Role.RELAY))]
Count = Annotated[int, Query(ge=0, lt=1 << 53)]

router = APIRouter()


@router.get("/maps/{name}/main/attachments", dependencies=READERS)
def wanted_attachments(
    service: Operations,
    row: Map,
    robot: Annotated[
        str | None, Query(max_length=64, description="only those that marks of this robot, or operators' marks, name")
    ] = None,
    limit: Annotated[int, Query(ge=1, le=PAGE_MAX)] = PAGE_MAX,
) -> WantedAttachments:
    """Attachments that marks of the map name and that did not come whole yet."""
    return service.sync.attachments.wanted(row, robot=robot, limit=limit)


@router.get(
    ATTACHMENT,
    dependencies=READERS,
    response_class=Response,
    responses=answers({200: MEDIA_TYPES, 304: ()}, headers=("ETag", "Content-Disposition")),
)
def get_attachment(
    sha: str, service: Operations, row: Map, if_none_match: Annotated[str | None, Header()] = None
) -> Response:
    """An attachment that a mark names, as a file to be saved: no browser shows it by itself."""
    data = service.sync.attachments.data(row, sha)
    media_type, suffix = media_type_of(data)
    headers = {
        "ETag": f'"{sha}"',
        "Cache-Control": "private, no-cache",
        "Content-Disposition": f'attachment; filename="{sha[:16]}{suffix}"',
        # Whatever the bytes could be read as, they are a file: nothing in them may run in the name of this server.
        "X-Content-Type-Options": "nosniff",
        "Content-Security-Policy": "default-src 'none'; sandbox",
    }
    if if_none_match and (if_none_match.strip() == "*" or headers["ETag"] in if_none_match):
        return Response(status_code=304, headers=headers)
    return Response(data, media_type=media_type, headers=headers)


@router.patch(ATTACHMENT, responses=problems(507), openapi_extra=body(PLAIN_BYTES))
async def add_attachment_part(
    sha: str,
    service: Operations,
    row: Map,
    caller: Sender,
    data: Annotated[bytes, Depends(body_of)],
    total: Count,
    offset: Count,
) -> AttachmentState:
    """Add a part of an attachment that a mark names; an empty one asks how much is there."""
    attachments = service.sync.attachments
    return await run_in_threadpool(
        lambda: attachments.add(row, caller, sha, total_bytes=total, begin_bytes=offset, data=data)
    )
