"""Routes of robots' keys: challenges for proofs, the keys that names are bound to, an operator's word for another."""

from typing import Annotated

from fastapi import APIRouter, Depends

from cairn_map.commits.ids import author_from_text
from cairn_map.wire.access_messages import Challenge, RobotKeyList
from cairn_server.access.auth import Caller, Role
from cairn_server.http.routes.callers import Map, Operations, allowed

router = APIRouter()
Operator = Annotated[Caller, Depends(allowed(Role.OPERATOR))]


@router.get("/challenge")
def challenge(service: Operations) -> Challenge:
    """A text for a robot to sign by its key, so that it may register under a name that is known."""
    return Challenge(challenge=service.sync.admissions.challenges.new())


@router.get("/maps/{name}/keys", dependencies=[Depends(allowed(Role.OPERATOR))])
def list_keys(service: Operations, row: Map) -> RobotKeyList:
    """Keys that robots' names are bound to, and the robots that were refused for theirs."""
    return service.sync.admissions.list(row)


@router.put("/maps/{name}/keys/{author}", status_code=204)
def admit(author: str, service: Operations, row: Map, caller: Operator) -> None:
    """Admit a robot's other key, by an operator's word."""
    service.sync.admissions.admit(row, author_from_text(author), by=caller)
