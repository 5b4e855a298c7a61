"""Routes of maps, their branches and their log. Nothing is decided here."""

from typing import Annotated

from fastapi import APIRouter, Depends, Query, Response

from cairn_map.messages import BranchInfo, CreateMap, LogEntry, MapInfo, Register, Registered, Retract, Retracted
from cairn_server.auth import Role
from cairn_server.http_access import ADMIN, OWNERS, READERS, Map, Operations, allowed

LOG_PAGE_MAX = 1000

router = APIRouter()


@router.get("/maps", dependencies=ADMIN)
def list_maps(service: Operations) -> list[MapInfo]:
    """All maps."""
    return [service.map_info(row) for row in service.store.maps()]


@router.put("/maps/{name}", status_code=201, dependencies=ADMIN)
def create_map(
    name: str,
    body: CreateMap,
    service: Operations,
    response: Response,
) -> MapInfo:
    """Create a map; 200 if an equal one exists."""
    info, is_new = service.create_map(name, body)
    response.status_code = 201 if is_new else 200
    return info


@router.get("/maps/{name}", dependencies=[Depends(allowed(Role.ROBOT, Role.ENROLLER))])
def get_map(service: Operations, row: Map) -> MapInfo:
    """One map's extent, sizes and head."""
    return service.map_info(row)


@router.post("/maps/{name}/branches", status_code=201, dependencies=[Depends(allowed(Role.ENROLLER))])
def register(body: Register, service: Operations, row: Map) -> Registered:
    """Register a robot; registering again replaces its token."""
    return service.register(row, body)


@router.get("/maps/{name}/branches", dependencies=READERS)
def list_branches(service: Operations, row: Map) -> list[BranchInfo]:
    """All robots, and how far behind each is."""
    return service.branches(row)


@router.delete("/maps/{name}/branches/{branch}", status_code=204, dependencies=OWNERS)
def deregister(branch: str, service: Operations, row: Map) -> None:
    """Deregister a robot; its evidence stays."""
    service.store.deregister(row, branch)


@router.post("/maps/{name}/retracts", status_code=201, dependencies=[Depends(allowed())])
def retract(body: Retract, service: Operations, row: Map) -> Retracted:
    """Undo commits exactly."""
    return service.retract(row, body)


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
