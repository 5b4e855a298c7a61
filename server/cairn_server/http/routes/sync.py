"""Routes of synchronisation: push, whole or in parts, and fetch-missing."""

from typing import Annotated

from fastapi import APIRouter, Depends, Header, Query, Response
from fastapi.responses import StreamingResponse
from starlette.concurrency import run_in_threadpool

from cairn_map.commits.signature import TEXT_MAX
from cairn_map.errors import ConflictError
from cairn_map.wire.messages import MissingRequest, PushReceipt, Upload
from cairn_map.wire.relay_peer import CommitList, commit_list
from cairn_server.access.auth import Caller, Role
from cairn_server.http.routes.callers import (
    READERS,
    Map,
    Operations,
    Visit,
    allowed,
    body_of,
    require_format,
    visiting_owner,
    visiting_robot,
)
from cairn_server.http.routes.documentation import TAKES_TOKEN, also, answers, body, json_body, problems
from cairn_server.http.routes.json_bodies import json_of
from cairn_server.store.replica_notes import BodyPart
from cairn_server.sync.asked_cells import Asked, asked_of
from cairn_server.sync.handing_over import found_commit
from cairn_server.sync.uploads import uploaded_by

COMMIT_MEDIA_TYPE = "application/vnd.cairn.commit"
REPLY_MEDIA_TYPE = "application/vnd.cairn.reply"
UPLOAD = "/maps/{name}/commits/{commit}/upload"
Digest = Annotated[str, Query(pattern="^[0-9a-f]{64}$", description="SHA-256 of the whole body")]
Count = Annotated[int, Query(ge=0, lt=1 << 53)]

router = APIRouter()


@router.put(
    "/maps/{name}/commits/{commit}",
    responses=also(201, PushReceipt) | problems(409, 425, 429, 507),
    openapi_extra=body(COMMIT_MEDIA_TYPE) | TAKES_TOKEN,
)
def push(
    commit: str,
    visit: Annotated[Visit, Depends(visiting_robot)],
    data: Annotated[bytes, Depends(body_of)],
    response: Response,
    cairn_seal: Annotated[str | None, Header(max_length=64)] = None,
    cairn_signature: Annotated[str | None, Header(max_length=TEXT_MAX)] = None,
) -> PushReceipt:
    """Push a commit: 201 new, 200 seen before, 409 other bytes under this id."""
    pushes, row, caller = visit.service.sync.pushes, visit.row, visit.caller
    try:
        is_new = pushes.keep(row, caller, commit, data, seal=cairn_seal, signatures=cairn_signature)
    except ConflictError as exc:
        pushes.note_conflict(row, caller, exc)
        raise
    response.status_code = 201 if is_new else 200
    return PushReceipt(id=commit, state="new" if is_new else "known")


@router.get(
    "/maps/{name}/commits/{commit}",
    dependencies=READERS,
    response_class=Response,
    responses=answers({200: (COMMIT_MEDIA_TYPE,)}, headers=("ETag", "Cairn-Seal")) | problems(409),
)
def get_commit(commit: str, service: Operations, row: Map) -> Response:
    """A commit's bytes as they were pushed, while its evidence is kept."""
    found = found_commit(service.store, row, commit)
    headers = {"ETag": f'"{found.sha.hex()}"', "Cache-Control": "no-cache"}
    headers |= {"Cairn-Seal": found.seal} if found.seal else {}
    headers |= {"Cairn-Signature": found.signatures} if found.signatures else {}
    return Response(found.data, media_type=COMMIT_MEDIA_TYPE, headers=headers)


@router.get("/maps/{name}/commits", dependencies=READERS)
def list_commits(service: Operations, row: Map) -> CommitList:
    """Commits that the server has, for relays."""
    return commit_list(service.sync.held.of(row))


@router.post(
    "/maps/{name}/branches/{branch}/missing",
    response_class=Response,
    responses=answers({200: (REPLY_MEDIA_TYPE,), 204: ()}) | problems(410),
    openapi_extra=TAKES_TOKEN
    | json_body(MissingRequest, example={"author": "mole.1f2e3d4c5b6a7988", "kinds": ["delta", "full"]}),
)
def missing(
    branch: str,
    visit: Annotated[Visit, Depends(visiting_owner)],
    asked: Annotated[Asked, json_of(MissingRequest, asked_of)],
) -> Response:
    """Frames that bring the caller to the head, sent as they are read; 204 if they are those of the last reply."""
    require_format(visit.row, visit.format)
    reply = visit.service.sync.replies.missing(visit.row, branch, asked)
    if not reply.first:
        return Response(status_code=204)
    if reply.rest is None:
        return Response(reply.first, media_type=REPLY_MEDIA_TYPE)
    return StreamingResponse(reply.parts(), media_type=REPLY_MEDIA_TYPE)


async def author(commit: str, caller: Annotated[Caller, Depends(allowed(Role.ROBOT, Role.RELAY))]) -> Caller:
    """The caller, if it may push this commit."""
    uploaded_by(caller, commit)
    return caller


Author = Annotated[Caller, Depends(author)]


@router.get(UPLOAD)
def upload(
    commit: str,
    service: Operations,
    row: Map,
    caller: Author,
    digest: Digest,
) -> Upload:
    """State of an upload: bytes that came already, and whether the commit is kept."""
    return service.sync.uploads.state(row, caller, commit, digest)


@router.patch(
    UPLOAD,
    responses=also(201, Upload) | problems(409, 425, 429, 507),
    openapi_extra=body("application/octet-stream"),
)
async def add_part(
    commit: str,
    service: Operations,
    row: Map,
    caller: Author,
    response: Response,
    data: Annotated[bytes, Depends(body_of)],
    digest: Digest,
    total: Count,
    offset: Count,
    cairn_signature: Annotated[str | None, Header(max_length=TEXT_MAX)] = None,
) -> Upload:
    """Add a part of a commit's bytes; with the last one it is pushed."""
    part, uploads = BodyPart(digest, total, offset, data), service.sync.uploads
    try:
        found, is_new = await run_in_threadpool(
            lambda: uploads.add(row, caller, commit, part, signatures=cairn_signature)
        )
    except ConflictError as exc:
        await run_in_threadpool(service.sync.pushes.note_conflict, row, caller, exc)
        raise
    response.status_code = 201 if is_new else 200
    return found
