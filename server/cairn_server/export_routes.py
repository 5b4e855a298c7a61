"""The route by which a part of a map is taken away. Nothing is decided here."""

from typing import Annotated

from fastapi import APIRouter, Query
from fastapi.responses import StreamingResponse

from cairn_map.export_request import EXPORT_TYPES, ExportRequest
from cairn_server.http_access import READERS, Map, Operations

router = APIRouter()


@router.get("/maps/{name}/main/export", dependencies=READERS)
def export(service: Operations, row: Map, asked: Annotated[ExportRequest, Query()]) -> StreamingResponse:
    """Occupied nodes by box, heights, probability, temperature, octree depth: as points, or an octree of OctoMap's."""
    made = service.exports.asked(row, asked)
    headers = {
        "Cache-Control": "no-store",
        "Cairn-Cursor": str(made.head.cursor),
        "Cairn-Points": str(made.count),
        "Content-Disposition": f'attachment; filename="{row.name}.{asked.format}"',
        "X-Content-Type-Options": "nosniff",
    }
    if made.size_bytes is not None:
        headers["Content-Length"] = str(made.size_bytes)
    return StreamingResponse(made.parts, media_type=EXPORT_TYPES[asked.format], headers=headers)
