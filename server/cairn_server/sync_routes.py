"""Routes of push and fetch-missing. Nothing is decided here."""

from typing import Annotated

from fastapi import APIRouter, Depends, Header, Response

from cairn_map.messages import MissingRequest, Pushed
from cairn_server.auth import Caller, Role
from cairn_server.http_access import OWNERS, READERS, Map, Operations, allowed, body_of

COMMIT_MEDIA_TYPE = "application/vnd.cairn.commit"
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
    cairn_seal: Annotated[str | None, Header(max_length=64)] = None,
) -> Pushed:
    """Push a commit: 201 new, 200 seen before, 409 other bytes under this id."""
    is_new = service.push(row, caller, commit, data, seal=cairn_seal)
    response.status_code = 201 if is_new else 200
    return Pushed(id=commit, state="new" if is_new else "known")


@router.get("/maps/{name}/commits/{commit}", dependencies=READERS)
def get_commit(commit: str, service: Operations, row: Map) -> Response:
    """A commit's bytes as they were pushed, while its evidence is kept."""
    data, sha, seal = service.commit(row, commit)
    headers = {"ETag": f'"{sha.hex()}"', "Cache-Control": "no-cache"} | ({"Cairn-Seal": seal} if seal else {})
    return Response(data, media_type=COMMIT_MEDIA_TYPE, headers=headers)


@router.post("/maps/{name}/branches/{branch}/missing", dependencies=OWNERS)
def missing(branch: str, body: MissingRequest, service: Operations, row: Map) -> Response:
    """The frames that bring the asker to the head."""
    return Response(service.missing(row, branch, body), media_type=REPLY_MEDIA_TYPE)
