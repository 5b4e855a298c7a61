"""Routes of maps, their layers, their log and their marks."""

from collections.abc import Sequence
from typing import Annotated

from fastapi import APIRouter, Depends, Query, Response

from cairn_map.commits.commit import EPOCH_VERSION
from cairn_map.errors import BadInputError
from cairn_map.wire.layer_messages import (
    KINDS_FORMAT,
    LAYER_FORMAT,
    AddLayer,
    Assignment,
    LayerAdded,
    LayerInfo,
    RobotAssignment,
    is_listed,
)
from cairn_map.wire.live_events import NAMES_MAX
from cairn_map.wire.mark_messages import PAGE_MAX, MarkPage, MarkReceipt, MarkRequest
from cairn_map.wire.messages import CreateMap, LogEntry, MapDeleted, MapInfo, MapSizes, Retract, Retracted
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
    """The maps that the token counts on, and their layers for clients that know of such."""
    rows = [row for row in service.store.maps() if caller.counts_on(row)]
    if known < LAYER_FORMAT:  # such clients refuse the whole list for the name of a layer
        rows = [row for row in rows if row.of_map is None]
    rows = [row for row in rows if is_listed(row.geometry, known)]
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


@router.delete("/maps/{name}", responses=problems(400, 410))
def delete_map(
    service: Operations, row: Map, caller: Annotated[Caller, Depends(allowed())], confirm: str = ""
) -> MapDeleted:
    """Delete a map for good, with its tokens; `confirm` is its name once more."""
    if confirm != row.name:
        raise BadInputError("not_confirmed", f"?confirm={row.name} deletes map {row.name} for good")
    service.store.audit_log.add(
        caller.name, "delete_map", f"map {row.name}: {service.maps.info(row).cursor}", client=caller.address
    )
    return service.maps.delete(row, by=caller.name)


@router.patch("/maps/{name}", status_code=204, responses=problems(400))
def change_map(row: Map, caller: Annotated[Caller, Depends(allowed())]) -> None:
    """Refuse to change a map, and say why."""
    raise BadInputError(
        "map_is_fixed",
        f"map {row.name} keeps its name, grid, channels and epochs: its robots signed their commits for that name, and "
        "its cells are sums on that grid. Make another map, and let robots push there",
    )


@router.get("/maps/{name}", dependencies=[Depends(allowed(*READING, Role.ENROLLER))])
def get_map(service: Operations, row: Map, known: Format) -> MapInfo:
    """One map's extent, sizes and head."""
    return _known_facts(service.maps.info(row), known)


@router.get("/maps/{name}/sizes", dependencies=READERS)
def sizes(service: Operations, row: Map) -> MapSizes:
    """Bytes of a map, by what they are for."""
    return service.maps.sizes(row)


def _known_facts(info: MapInfo, known: int) -> MapInfo:
    """Facts of a map without those that the client's version of the format does not have."""
    return info if known >= EPOCH_VERSION else info.model_copy(update={"epoch_s": None, "history_bytes": 0})


@router.get("/maps/{name}/layers", dependencies=READERS)
def list_layers(service: Operations, row: Map, known: Format) -> list[LayerInfo]:
    """The layers of a map that the client can read: the one that it began with, then the others by name."""
    return [layer for layer in service.sync.layers.list(row) if is_listed(layer.geometry, known)]


@router.post(
    "/maps/{name}/layers",
    status_code=201,
    responses=also(200, LayerAdded) | problems(409),
    openapi_extra=json_body(
        AddLayer, example={"name": "fine", "geometry": {"voxel_edge_um": 10_000, "depth": 7}, "epoch_s": 120}
    ),
)
def add_layer(
    service: Operations,
    row: Map,
    caller: Annotated[Caller, Depends(allowed(Role.OPERATOR))],
    body: Annotated[AddLayer, json_of(AddLayer)],
    response: Response,
) -> LayerAdded:
    """Add a layer to a map, at a resolution of its own; 200 if an equal one is there."""
    service.acts.take(caller.name, is_admin=caller.role is Role.ADMIN)
    added = service.sync.layers.add(row, body, by=caller)
    response.status_code = 201 if added.commit is not None else 200
    return added


@router.get("/maps/{name}/assignments", dependencies=[Depends(allowed(*READING, Role.ENROLLER))])
def list_assignments(
    service: Operations, row: Map, robot: Annotated[str | None, Query(max_length=32, description="of it alone")] = None
) -> Sequence[RobotAssignment]:
    """Layers that operators assigned to robots: of all by name, or of one; of a layer's map."""
    return service.sync.layers.assignments(row, robot)


@router.put(
    "/maps/{name}/assignments/{robot}",
    status_code=204,
    responses=problems(409),
    openapi_extra=json_body(
        Assignment,
        example={
            "contributes": [
                {"layer": "evidence", "inside_m": [[0, 0, -1], [20, 12, 4]]},
                {"layer": "ground", "outside_m": [[0, 0, -1], [20, 12, 4]]},
            ],
            "fetches": ["fine"],
        },
    ),
)
def assign_layers(
    robot: str,
    service: Operations,
    row: Map,
    caller: Annotated[Caller, Depends(allowed(Role.OPERATOR))],
    body: Annotated[Assignment, json_of(Assignment)],
) -> None:
    """Assign to a robot the layers that it maps into, perhaps by place, and those that it fetches."""
    service.acts.take(caller.name, is_admin=caller.role is Role.ADMIN)
    service.sync.layers.assign(row, robot, body, by=caller)


@router.delete("/maps/{name}/assignments/{robot}", status_code=204)
def unassign_layers(
    robot: str, service: Operations, row: Map, caller: Annotated[Caller, Depends(allowed(Role.OPERATOR))]
) -> None:
    """Leave a robot's layers to its own program again."""
    service.acts.take(caller.name, is_admin=caller.role is Role.ADMIN)
    service.sync.layers.unassign(row, robot, by=caller)


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
    known: Format,
    after: Annotated[int, Query(ge=0, lt=1 << 63)] = 0,
    limit: Annotated[int, Query(ge=1, le=LOG_PAGE_MAX)] = 100,
) -> list[LogEntry]:
    """Log entries, oldest first."""
    with service.store.snapshot(row) as snapshot:
        entries = snapshot.log(after_seq=after, limit=limit, names_max=NAMES_MAX)
    if known < KINDS_FORMAT:
        entries = [entry.without_receipt() for entry in entries]
    return [times(entry) for entry in entries]


@router.get("/maps/{name}/main/marks", dependencies=READERS)
def list_marks(
    service: Operations,
    row: Map,
    box: Annotated[
        str | None, Query(max_length=200, description="x0,y0,z0,x1,y1,z1: marks in this box, metres, map frame")
    ] = None,
    after: Annotated[
        str | None, Query(max_length=128, description="`cursor` of the page before: only what is new")
    ] = None,
    limit: Annotated[int, Query(ge=1, le=PAGE_MAX, description="marks in a page, which ends with a commit")] = PAGE_MAX,
) -> MarkPage:
    """Marks of the map, or of a box: all, or those that came and went after a page that the client has."""
    return service.sync.marking.page(row, after=after, limit=limit, box=box)


@router.post(
    "/maps/{name}/main/marks",
    status_code=201,
    openapi_extra=json_body(
        MarkRequest,
        example={"mark": {"kind": "door", "name": "north door", "place_m": [1.5, -2.0, 1.0], "note": "locked"}},
    ),
)
def put_mark(
    service: Operations,
    row: Map,
    caller: Annotated[Caller, Depends(allowed(Role.OPERATOR))],
    body: Annotated[MarkRequest, json_of(MarkRequest)],
) -> MarkReceipt:
    """Add a mark as an operator, or change or remove any author's; robots push commits with their own."""
    service.acts.take(caller.name, is_admin=caller.role is Role.ADMIN)
    return service.sync.marking.put(row, body, by=caller)
