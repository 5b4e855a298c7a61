"""Routes of commits that come in parts. Nothing is decided here."""

from typing import Annotated

from fastapi import APIRouter, Depends, Header, Query, Response
from starlette.concurrency import run_in_threadpool

from cairn_map.commits.signature import TEXT_MAX
from cairn_map.errors import ConflictError
from cairn_map.wire.messages import Upload
from cairn_server.access.auth import Caller, Role
from cairn_server.http.routes.callers import Map, Operations, allowed, body_of
from cairn_server.sync.uploads import Part, uploaded_by

PATH = "/maps/{name}/commits/{commit}/upload"
Digest = Annotated[str, Query(pattern="^[0-9a-f]{64}$", description="SHA-256 of the whole body")]
Count = Annotated[int, Query(ge=0, lt=1 << 53)]

router = APIRouter()


async def author(commit: str, caller: Annotated[Caller, Depends(allowed(Role.ROBOT, Role.RELAY))]) -> Caller:
    """The caller, if it may push this commit."""
    uploaded_by(caller, commit)
    return caller


Author = Annotated[Caller, Depends(author)]


@router.get(PATH)
def upload(
    commit: str,
    service: Operations,
    row: Map,
    caller: Author,
    digest: Digest,
) -> Upload:
    """How many bytes of a commit came already, and whether it is kept."""
    return service.uploads.state(row, caller, commit, digest)


@router.patch(PATH)
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
    part = Part(digest, total, offset, data, cairn_signature)
    try:
        found, is_new = await run_in_threadpool(service.uploads.add, row, caller, commit, part)
    except ConflictError as exc:
        await run_in_threadpool(service.pushes.note_conflict, row, caller, exc)
        raise
    response.status_code = 201 if is_new else 200
    return found
