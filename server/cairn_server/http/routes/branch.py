"""Routes of a map's robots: registration, keys, status and latest picture of each one's branch, shares of bounds."""

from email.utils import formatdate
from typing import Annotated

from fastapi import APIRouter, Depends, Header, Response

from cairn_map.commits.ids import Author, Incarnation, RobotName, author_from_text
from cairn_map.commits.key_proof import PROOF_TEXT_MAX
from cairn_map.wire.access_messages import Challenge, RobotClosed, RobotKeyList, RobotUse
from cairn_map.wire.messages import BranchInfo, Register, Registered, RobotStatus
from cairn_server.access.auth import Caller, Role
from cairn_server.http.routes.callers import (
    OWNERS,
    READERS,
    Format,
    Map,
    Operations,
    OwnOrigins,
    Times,
    allowed,
    body_of,
    own_branch,
    registrar,
    require_format,
)
from cairn_server.http.routes.documentation import answers, body, json_body, problems
from cairn_server.http.routes.json_bodies import json_of
from cairn_server.store.shares import used_bounds

PICTURES = ("image/jpeg", "image/png")

router = APIRouter()
Operator = Annotated[Caller, Depends(allowed(Role.OPERATOR))]


@router.post(
    "/maps/{name}/branches",
    status_code=201,
    openapi_extra=json_body(
        Register,
        example={
            "robot": "mole",
            "mode": "high-end",
            "incarnation": "1f2e3d4c5b6a7988",
            "sensors": ["tof", "colour", "thermal"],
        },
    ),
)
def register(
    service: Operations,
    row: Map,
    caller: Annotated[Caller, Depends(registrar)],
    body: Annotated[Register, json_of(Register)],
    own: OwnOrigins,
    known: Format,
    cairn_proof: Annotated[str | None, Header(max_length=PROOF_TEXT_MAX)] = None,
) -> Registered:
    """Register a robot; registering again replaces its token, and takes a proof that it is the same robot."""
    require_format(row, known)
    author = Author(RobotName(body.robot), Incarnation(body.incarnation))
    with service.sync.admissions.registering(row, caller, author, cairn_proof, own=own) as grounds:
        registered = service.maps.register(row, body, grounds)
    service.store.audit_log.add(caller.name, "register", f"map {row.name}: {body.robot}", client=caller.address)
    return registered


@router.get("/maps/{name}/branches", dependencies=READERS)
def list_branches(service: Operations, row: Map, times: Times) -> list[BranchInfo]:
    """All robots, and how far behind each is."""
    return [times(branch) for branch in service.maps.branches(row)]


@router.delete("/maps/{name}/branches/{branch}", status_code=204)
def deregister(branch: str, service: Operations, row: Map, caller: Annotated[Caller, Depends(own_branch)]) -> None:
    """Deregister a robot, by an admin from the map and its layers; its evidence stays."""
    if caller.role is Role.ADMIN:
        service.maps.expel(row, branch)
    else:
        service.maps.deregister(row, branch)
    service.store.audit_log.add(caller.name, "deregister", f"map {row.name}: {branch}", client=caller.address)


@router.put(
    "/maps/{name}/branches/{branch}/status",
    status_code=204,
    dependencies=OWNERS,
    openapi_extra=json_body(
        RobotStatus,
        example={
            "time_s": 1795253400.0,
            "pose": {
                "time_s": 1795253400.0,
                "t_map_rig": [1.5, -2.0, 0.4],
                "q_map_rig": [0.0, 0.0, 0.0, 1.0],
                "sigma_m": 0.05,
                "sigma_rad": 0.01,
            },
            "mode": "high-end",
            "waiting": 3,
            "waiting_bytes": 1500000,
            "battery": 0.8,
            "note": "at the stairs",
        },
    ),
)
def put_status(branch: str, service: Operations, row: Map, body: Annotated[RobotStatus, json_of(RobotStatus)]) -> None:
    """Report where a robot is and how it is doing; only the latest report is kept."""
    service.reports.put_status(row, branch, body)


@router.put("/maps/{name}/branches/{branch}/view", status_code=204, dependencies=OWNERS, openapi_extra=body(*PICTURES))
def put_view(branch: str, service: Operations, row: Map, data: Annotated[bytes, Depends(body_of)]) -> None:
    """Show what a robot sees: a JPEG or PNG, kept in memory until the next one."""
    service.reports.put_view(row, branch, data)


@router.get(
    "/maps/{name}/branches/{branch}/view",
    dependencies=READERS,
    response_class=Response,
    responses=answers({200: PICTURES, 304: ()}, headers=("ETag", "Last-Modified")),
)
def get_view(
    branch: str, service: Operations, row: Map, if_none_match: Annotated[str | None, Header()] = None
) -> Response:
    """A robot's latest picture; strong ETag, `Last-Modified` is when it came."""
    view = service.reports.view(row, branch)
    headers = {
        "ETag": f'"{view.digest}"',
        "Last-Modified": formatdate(view.time_s, usegmt=True),
        "Cache-Control": "no-cache",
        # A browser must take the bytes for a picture, whatever else they could be read as.
        "X-Content-Type-Options": "nosniff",
        "Content-Security-Policy": "default-src 'none'; sandbox",
    }
    if if_none_match and (if_none_match.strip() == "*" or headers["ETag"] in if_none_match):
        return Response(status_code=304, headers=headers)
    return Response(view.data, media_type=view.media_type, headers=headers)


@router.get("/maps/{name}/robots", dependencies=[Depends(allowed(Role.OPERATOR))])
def robot_uses(service: Operations, row: Map) -> list[RobotUse]:
    """Use of their shares by all robots, and of the reserve."""
    return [
        RobotUse(
            robot=share.robot or None,
            incarnations=share.incarnations,
            intervals=share.intervals,
            used=used_bounds(share),
        )
        for share in service.store.shares.of(row)
    ]


@router.post("/maps/{name}/robots/{robot}/close", responses=problems(409))
def close_robot(
    robot: str, service: Operations, row: Map, caller: Annotated[Caller, Depends(allowed())]
) -> RobotClosed:
    """Close all incarnations of a robot: they take no new commits, and its shares are whole again."""
    closed = service.store.shares.close(row, robot)
    detail = f"map {row.name}: {robot}, {closed.authors} incarnations"
    service.store.audit_log.add(caller.name, "close_robot", detail, client=caller.address)
    return RobotClosed(robot=robot, incarnations=closed.authors, intervals=closed.intervals)


@router.get("/challenge")
def challenge(service: Operations) -> Challenge:
    """A text for a robot to sign by its key, so that it may register under a name that is known."""
    return Challenge(challenge=service.sync.admissions.challenges.new())


@router.get("/maps/{name}/keys", dependencies=[Depends(allowed(Role.OPERATOR))])
def list_keys(service: Operations, row: Map, times: Times) -> RobotKeyList:
    """Keys that robots' names are bound to, and the robots that were refused for theirs."""
    keys: RobotKeyList = times(service.sync.admissions.list(row))
    return keys


@router.put("/maps/{name}/keys/{author}", status_code=204)
def admit(author: str, service: Operations, row: Map, caller: Operator) -> None:
    """Admit a robot's other key, by an operator's word."""
    service.acts.take(caller.name, is_admin=caller.role is Role.ADMIN)
    service.sync.admissions.admit(row, author_from_text(author), by=caller)
