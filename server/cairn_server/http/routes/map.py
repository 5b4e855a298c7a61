"""Routes of maps and their log."""

from typing import Annotated

from fastapi import APIRouter, Depends, Query, Response

from cairn_map.commits.commit import EPOCH_VERSION
from cairn_map.wire.live_events import NAMES_MAX
from cairn_map.wire.messages import CreateMap, LogEntry, MapInfo, Retract, Retracted
from cairn_server.access.auth import READING, Caller, Role
from cairn_server.http.routes.callers import READERS, Format, Map, Operations, Times, admin, allowed, reader_somewhere
from cairn_server.http.routes.documentation import also, json_body, problems
from cairn_server.http.routes.json_bodies import json_of

LOG_PAGE_MAX = 1000

router = APIRouter()


@router.get("/maps")
def list_maps(
    service: Operations, caller: Annotated[Caller, Depends(reader_somewhere)], known: Format
) -> list[MapInfo]:
    """The maps that the token counts on."""
    rows = [row for row in service.store.maps() if caller.counts_on(row.number)]
    return [_known_facts(service.maps.info(row), known) for row in rows]


@router.put(
    "/maps/{name}",
    status_code=201,
    responses=also(200, MapInfo) | problems(409),
    openapi_extra=json_body(
        CreateMap,
        example={"geometry": {"voxel_edge_um": 40_000, "depth": 7}, "sensor_model": {"p_hit": 0.7, "p_miss": 0.4}},
    ),
)
def create_map(
    name: str,
    service: Operations,
    caller: Annotated[Caller, Depends(admin)],
    body: Annotated[CreateMap, json_of(CreateMap)],
    response: Response,
    known: Format,
) -> MapInfo:
    """Create a map; 200 if an equal one exists."""
    info, is_new = service.maps.create(name, body)
    if is_new:
        service.store.audit_log.add(caller.name, "create_map", f"map {name}: created", client=caller.address)
    response.status_code = 201 if is_new else 200
    return _known_facts(info, known)


@router.get("/maps/{name}", dependencies=[Depends(allowed(*READING, Role.ENROLLER))])
def get_map(service: Operations, row: Map, known: Format) -> MapInfo:
    """One map's extent, sizes and head."""
    return _known_facts(service.maps.info(row), known)


def _known_facts(info: MapInfo, known: int) -> MapInfo:
    """Facts of a map without those that the client's version of the format does not have."""
    return info if known >= EPOCH_VERSION else info.model_copy(update={"epoch_s": None, "history_bytes": 0})


@router.post(
    "/maps/{name}/retracts",
    status_code=201,
    responses=problems(409),
    openapi_extra=json_body(Retract, example={"commits": ["mole.1f2e3d4c5b6a7988.12"], "note": "wrong calibration"}),
)
def retract(
    service: Operations,
    row: Map,
    caller: Annotated[Caller, Depends(allowed(Role.OPERATOR))],
    body: Annotated[Retract, json_of(Retract)],
) -> Retracted:
    """Undo commits exactly."""
    service.acts.take(caller.name, is_admin=caller.role is Role.ADMIN)
    return service.sync.retracts.retract(row, body, by=caller)


@router.get("/maps/{name}/log", dependencies=READERS)
def log(
    service: Operations,
    row: Map,
    times: Times,
    after: Annotated[int, Query(ge=0, lt=1 << 63)] = 0,
    limit: Annotated[int, Query(ge=1, le=LOG_PAGE_MAX)] = 100,
) -> list[LogEntry]:
    """Log entries, oldest first."""
    with service.store.snapshot(row) as snapshot:
        return [times(entry) for entry in snapshot.log(after_seq=after, limit=limit, names_max=NAMES_MAX)]
