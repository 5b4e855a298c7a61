"""Routes of main's cells. Nothing is decided here."""

import json
from typing import Annotated

from fastapi import APIRouter, Header, Query, Response

from cairn_map.cell_files import CELL_MEDIA_TYPE, FORMS, MEDIA_TYPES, cell_file
from cairn_map.errors import BadInputError, NotFoundError
from cairn_map.grid import cell_from_text, cell_key
from cairn_map.ids import author_from_text
from cairn_map.messages import CellIndex
from cairn_server.cells_at_rest import stored_evidence
from cairn_server.http_access import READERS, Map, Operations

router = APIRouter()


@router.get("/maps/{name}/main/cells", dependencies=READERS)
def cell_index(service: Operations, row: Map, author: Annotated[str | None, Query(max_length=80)] = None) -> CellIndex:
    """All cells that were ever touched, from one state."""
    return service.cell_index(row, author_from_text(author) if author else None)


@router.get("/maps/{name}/main/cells/{cell}", dependencies=READERS)
def get_cell(
    cell: str,
    service: Operations,
    row: Map,
    if_none_match: Annotated[str | None, Header()] = None,
) -> Response:
    """One cell: the octree, or by suffix `.npz`, `.ply`, `.view`; strong ETag, cursor and coverage in the headers."""
    number, dot, suffix = cell.partition(".")
    key = cell_key(cell_from_text(number))
    if dot and suffix not in MEDIA_TYPES:
        raise BadInputError("unknown_format", f"cells come as {FORMS}, not as .{suffix[:16]}")
    stored, head = service.cell(row, key)
    if stored is None:
        raise NotFoundError("no_cell", f"nobody has seen cell {number} of map {row.name}")
    etag = f'"{stored.digest.hex()}{dot}{suffix}"'
    headers = {
        "ETag": etag,
        "Cache-Control": "no-cache",
        "Cairn-Cursor": str(head.cursor),
        "Cairn-Coverage": json.dumps(head.vector.to_json(), separators=(",", ":")),
        "Cairn-Fingerprint": stored.fingerprint.hex(),
    }
    if if_none_match and (if_none_match.strip() == "*" or etag in [t.strip() for t in if_none_match.split(",")]):
        return Response(status_code=304, headers=headers)
    if not suffix:
        return Response(stored.body, media_type=CELL_MEDIA_TYPE, headers=headers)
    data, media_type = cell_file(suffix, key, stored_evidence(stored), row.geometry, row.sensor_model)
    headers["Content-Disposition"] = f'attachment; filename="{row.name}_{number}.{suffix}"'
    return Response(data, media_type=media_type, headers=headers)
