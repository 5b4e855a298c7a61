"""Routes of push and fetch-missing. Nothing is decided here but where a push is worked on.

A small one on the event loop: its check takes less time than to change to a thread and back, and then another thread
waits for the disk on its behalf. Whatever may take longer has a thread of its own.
"""

from typing import Annotated

from fastapi import APIRouter, Depends, Header, Request, Response
from starlette.concurrency import run_in_threadpool

from cairn_map.commits.commit_reading import commit_reader
from cairn_map.commits.signature import TEXT_MAX
from cairn_map.errors import ConflictError
from cairn_map.wire.messages import MissingRequest, Pushed
from cairn_map.wire.relay_peer import CommitList, commit_list
from cairn_server.http.routes.callers import READERS, Map, Operations, Visit, visiting_owner, visiting_robot
from cairn_server.sync.handing_over import found_commit

COMMIT_MEDIA_TYPE = "application/vnd.cairn.commit"
REPLY_MEDIA_TYPE = "application/vnd.cairn.reply"

router = APIRouter()


AT_ONCE_BYTES = 1 << 16
"""A body that is not larger is looked into at once."""


@router.put("/maps/{name}/commits/{commit}")
async def push(
    commit: str,
    visit: Annotated[Visit, Depends(visiting_robot)],
    request: Request,
    response: Response,
    cairn_seal: Annotated[str | None, Header(max_length=64)] = None,
    cairn_signature: Annotated[str | None, Header(max_length=TEXT_MAX)] = None,
) -> Pushed:
    """Push a commit: 201 new, 200 seen before, 409 other bytes under this id."""
    pushes, row, caller = visit.service.pushes, visit.row, visit.caller
    beside = {"seal": cairn_seal, "signatures": cairn_signature}
    data = await request.body()
    pushed = commit_reader(data) if len(data) <= AT_ONCE_BYTES else None
    try:
        if pushed is None or not pushes.is_quick(row, caller, pushed):
            is_new = await run_in_threadpool(pushes.keep, row, caller, commit, data, **beside)
        else:
            is_new = await pushes.keep_soon(row, caller, commit, pushed, **beside)
    except ConflictError as exc:
        await run_in_threadpool(pushes.note_conflict, row, caller, exc)
        raise
    response.status_code = 201 if is_new else 200
    return Pushed(id=commit, state="new" if is_new else "known")


@router.get("/maps/{name}/commits/{commit}", dependencies=READERS)
def get_commit(commit: str, service: Operations, row: Map) -> Response:
    """A commit's bytes as they were pushed, while its evidence is kept."""
    found = found_commit(service.store, row, commit)
    headers = {"ETag": f'"{found.sha.hex()}"', "Cache-Control": "no-cache"}
    headers |= {"Cairn-Seal": found.seal} if found.seal else {}
    headers |= {"Cairn-Signature": found.signatures} if found.signatures else {}
    return Response(found.data, media_type=COMMIT_MEDIA_TYPE, headers=headers)


@router.get("/maps/{name}/commits", dependencies=READERS)
def list_commits(service: Operations, row: Map) -> CommitList:
    """Which commits are here, for relays."""
    return commit_list(service.held.of(row))


@router.post("/maps/{name}/branches/{branch}/missing")
def missing(branch: str, body: MissingRequest, visit: Annotated[Visit, Depends(visiting_owner)]) -> Response:
    """The frames that bring the asker to the head; 204 if they are those of the last reply."""
    reply = visit.service.missing(visit.row, branch, body)
    return Response(reply, media_type=REPLY_MEDIA_TYPE) if reply else Response(status_code=204)
