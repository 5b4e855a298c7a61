"""Routes of maps, their branches and their log. Nothing is decided here."""

from typing import Annotated

from fastapi import APIRouter, Depends, Query, Response

from cairn_map.wire.messages import BranchInfo, CreateMap, LogEntry, MapInfo, Register, Registered, Retract, Retracted
from cairn_server.access.auth import READING, Caller, Role
from cairn_server.http.routes.callers import READERS, Map, Operations, admin, allowed, own_branch, reader_somewhere

LOG_PAGE_MAX = 1000

router = APIRouter()


@router.get("/maps")
def list_maps(service: Operations, caller: Annotated[Caller, Depends(reader_somewhere)]) -> list[MapInfo]:
    """The maps that the token counts on."""
    return [service.map_info(row) for row in service.store.maps() if caller.counts_on(row.number)]


@router.put("/maps/{name}", status_code=201)
def create_map(
    name: str,
    body: CreateMap,
    service: Operations,
    caller: Annotated[Caller, Depends(admin)],
    response: Response,
) -> MapInfo:
    """Create a map; 200 if an equal one exists."""
    info, is_new = service.create_map(name, body)
    if is_new:
        service.store.audit_log.add(caller.name, "create_map", name)
    response.status_code = 201 if is_new else 200
    return info


@router.get("/maps/{name}", dependencies=[Depends(allowed(*READING, Role.ENROLLER))])
def get_map(service: Operations, row: Map) -> MapInfo:
    """One map's extent, sizes and head."""
    return service.map_info(row)


@router.post("/maps/{name}/branches", status_code=201)
def register(
    body: Register, service: Operations, row: Map, caller: Annotated[Caller, Depends(allowed(Role.ENROLLER))]
) -> Registered:
    """Register a robot; registering again replaces its token."""
    registered = service.register(row, body)
    service.store.audit_log.add(caller.name, "register", f"map {row.name}: {body.robot}")
    return registered


@router.get("/maps/{name}/branches", dependencies=READERS)
def list_branches(service: Operations, row: Map) -> list[BranchInfo]:
    """All robots, and how far behind each is."""
    return service.branches(row)


@router.delete("/maps/{name}/branches/{branch}", status_code=204)
def deregister(branch: str, service: Operations, row: Map, caller: Annotated[Caller, Depends(own_branch)]) -> None:
    """Deregister a robot; its evidence stays."""
    service.deregister(row, branch)
    service.store.audit_log.add(caller.name, "deregister", f"map {row.name}: {branch}")


@router.post("/maps/{name}/retracts", status_code=201)
def retract(
    body: Retract, service: Operations, row: Map, caller: Annotated[Caller, Depends(allowed(Role.OPERATOR))]
) -> Retracted:
    """Undo commits exactly."""
    return service.retract(row, body, by=caller)


@router.get("/maps/{name}/log", dependencies=READERS)
def log(
    service: Operations,
    row: Map,
    after: Annotated[int, Query(ge=0, lt=1 << 63)] = 0,
    limit: Annotated[int, Query(ge=1, le=LOG_PAGE_MAX)] = 100,
) -> list[LogEntry]:
    """Log entries, oldest first."""
    with service.store.snapshot(row) as snapshot:
        return snapshot.log(after_seq=after, limit=limit)
