"""The routes by which a part of a map is taken away. Nothing is decided here."""

from typing import Annotated

from fastapi import APIRouter, Depends, Query, Request
from fastapi.responses import StreamingResponse

from cairn_map.files.export_request import EXPORT_TYPES, ExportRequest, ExportTicket, TicketedExport
from cairn_server.access.auth import READING, require
from cairn_server.http.routes.callers import READERS, Credentials, Map, Operations, caller_now, map_now
from cairn_server.store.store_rows import MapRow

router = APIRouter()


async def map_without_ticket(
    name: str, request: Request, service: Operations, credentials: Credentials
) -> MapRow | None:
    """The map, for who may read it by a token; None: a ticket is shown, and tells what it is for."""
    if "ticket" in request.query_params:
        return None
    row = map_now(name, service, credentials)
    require(caller_now(service, row, credentials), *READING)
    return row


@router.get("/maps/{name}/main/export")
def export(
    service: Operations,
    name: str,
    row: Annotated[MapRow | None, Depends(map_without_ticket)],
    asked: Annotated[TicketedExport, Query()],
) -> StreamingResponse:
    """Occupied nodes by box, heights, probability, temperature, octree depth: as points, or an octree of OctoMap's."""
    if row is None:
        made = service.tickets.shown(asked.ticket or "", name, asked.request)
    else:
        made = service.exports.asked(row, asked.request)
    headers = {
        "Cache-Control": "no-store",
        "Cairn-Cursor": str(made.head.cursor),
        "Cairn-Points": str(made.count),
        "Content-Disposition": f'attachment; filename="{name}.{asked.format}"',
        "X-Content-Type-Options": "nosniff",
    }
    if made.size_bytes is not None:
        headers["Content-Length"] = str(made.size_bytes)
    return StreamingResponse(made.parts, media_type=EXPORT_TYPES[asked.format], headers=headers)


@router.post("/maps/{name}/main/export/tickets", dependencies=READERS, status_code=201)
def ask_for_ticket(service: Operations, row: Map, asked: ExportRequest, credentials: Credentials) -> ExportTicket:
    """A ticket that stands for the token shown, once and for this export: what a link to save it by has instead."""
    return service.tickets.give(row, asked, credentials.credentials if credentials else None)
