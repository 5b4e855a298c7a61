"""Routes of the cells of a map: the index, cells as files and views, single voxels, and healing."""

import re
from typing import Annotated

from fastapi import APIRouter, Depends, Header, Query, Request, Response

from cairn_map.commits.commit import EPOCH_VERSION
from cairn_map.commits.cursor import cursor_from_text
from cairn_map.commits.ids import author_from_text
from cairn_map.commits.version_vector import vector_digest, vector_text
from cairn_map.epochs.moment import TimeText, time_from_text
from cairn_map.errors import BadInputError
from cairn_map.evidence.grid import cell_from_text, cell_key
from cairn_map.files.cell_files import CELL_MEDIA_TYPE, FORMS, MEDIA_TYPES
from cairn_map.wire.messages import INDEX_PAGE, INDEX_PAGE_MAX, CellIndex
from cairn_map.wire.voxel_messages import VoxelAnswer
from cairn_server.access.auth import Caller
from cairn_server.folding.cell_index import IndexPage, box_from_text
from cairn_server.http.routes.callers import READERS, Format, Map, Operations, body_of, reader
from cairn_server.http.routes.documentation import answers, body, problems
from cairn_server.http.routes.problems import answer_to
from cairn_server.store.store_rows import Head, MapRow
from cairn_server.views.cell_views import BUNDLE_MEDIA_TYPE, TOTAL, CellForm
from cairn_server.views.voxel_report import asked_voxel, voxel_at

ONE_RANGE = re.compile(r"bytes=[ \t]*(\d{0,18})-(\d{0,18})[ \t]*", re.ASCII | re.IGNORECASE)
"""One range of bytes; a request for several, or for none, is answered with the whole, as RFC 9110 allows."""
CELL_TYPES = (CELL_MEDIA_TYPE, *MEDIA_TYPES.values())
CELL_HEADERS = ("ETag", "Cairn-Cursor", "Cairn-Coverage", "Cairn-Coverage-Digest", "Cairn-Fingerprint")
COVERAGE_BYTES_MAX = 4096
"""Longest header `Cairn-Coverage`: a longer one would be refused by proxies and by small HTTP libraries."""

router = APIRouter()


@router.get("/maps/{name}/main/cells", dependencies=READERS, response_model_exclude_unset=True)
def cell_index(
    service: Operations,
    row: Map,
    author: Annotated[str | None, Query(max_length=80)] = None,
    box: Annotated[str | None, Query(max_length=80, description="i0,j0,k0,i1,j1,k1: only these, ends included")] = None,
    after: Annotated[str | None, Query(max_length=32, description="i,j,k: the last cell of the page before")] = None,
    limit: Annotated[int, Query(ge=1, le=INDEX_PAGE_MAX)] = INDEX_PAGE,
    hottest: Annotated[bool, Query(description="each entry has hottest_k, too")] = False,
    held: Annotated[bool, Query(description="each entry has held_lm, too")] = False,
    since: Annotated[
        str | None, Query(max_length=128, description="cursor: the header's vector names only what was folded since")
    ] = None,
) -> CellIndex:
    """Cells that were ever touched, all or those in a box, a page at a time."""
    page = IndexPage(
        after=cell_key(cell_from_text(after)) if after is not None else None,
        limit=limit,
        box=box_from_text(box) if box is not None else None,
        is_hottest_asked=hottest,
        is_held_asked=held,
    )
    return service.sync.replies.cell_index(row, author_from_text(author) if author else None, page, since=since)


@router.get(
    "/maps/{name}/main/views",
    dependencies=READERS,
    response_class=Response,
    responses=answers({200: (BUNDLE_MEDIA_TYPE,)}, headers=("Cairn-View-Depth",)),
)
def views(service: Operations, row: Map) -> Response:
    """Views of all cells at a coarse depth, as far as the server has them ready: for a page's first picture."""
    depth, found = service.views.cells.ready(row)
    headers = {"Cache-Control": "no-store", "Cairn-View-Depth": str(depth)}
    return Response(found, media_type=BUNDLE_MEDIA_TYPE, headers=headers)


@router.get(
    "/maps/{name}/main/vector",
    dependencies=READERS,
    response_class=Response,
    responses=answers({200: ("application/json",)}) | problems(410),
)
def vector(service: Operations, row: Map, at: Annotated[str, Query(max_length=128)]) -> Response:
    """The version vector at a cursor: what `Cairn-Coverage` says where it is short enough."""
    found = service.sync.replies.vector_at(row, cursor_from_text(at))
    return Response(vector_text(found), media_type="application/json", headers={"ETag": f'"{vector_digest(found)}"'})


@router.get("/maps/{name}/main/voxels/{voxel}", dependencies=READERS)
def voxel(voxel: str, service: Operations, row: Map, time: Annotated[TimeText | None, Query()] = None) -> VoxelAnswer:
    """One voxel of the lattice: its exact numbers, and the commits that saw it; now, or as it was at a time."""
    return asked_voxel(service.store, service.cells, row, voxel, at_s=_time_s(time))


@router.get("/maps/{name}/main/voxels", dependencies=READERS)
def voxel_of_point(
    service: Operations,
    row: Map,
    at: Annotated[str, Query(description="x,y,z: metres, map frame")],
    time: Annotated[TimeText | None, Query()] = None,
) -> VoxelAnswer:
    """The voxel in which a point lies: as the one by its numbers."""
    return asked_voxel(service.store, service.cells, row, voxel_at(row.geometry, at), at_s=_time_s(time))


@router.get(
    "/maps/{name}/main/cells/{cell}",
    dependencies=READERS,
    response_class=Response,
    responses=answers({200: CELL_TYPES, 206: CELL_TYPES, 304: ()}, headers=CELL_HEADERS) | problems(416),
)
def get_cell(
    cell: str,
    request: Request,
    service: Operations,
    row: Map,
    version: Format,
    depth: Annotated[
        int | None, Query(ge=1, le=64, description="octree depth of a view; only without suffix or .view")
    ] = None,
    known: Annotated[
        bool, Query(description="a view of free nodes, too, with log-odds; only with .view or depth")
    ] = False,
    at: Annotated[TimeText | None, Query()] = None,
    if_none_match: Annotated[str | None, Header()] = None,
    if_range: Annotated[str | None, Header()] = None,
    range_: Annotated[str | None, Header(alias="Range")] = None,
) -> Response:
    """One cell: the octree, or by suffix `.npz`, `.ply`, `.view`; strong ETag, cursor and coverage in the headers.

    With `at` it is the cell as it was at that time, by capture. Of a map with epochs clients that do not state
    `Cairn-Format: 2` get the sum of all epochs.
    """
    number, dot, suffix = cell.partition(".")
    key = cell_key(cell_from_text(number))
    _check_form(dot, suffix, depth, row, has_style=depth is not None or known)
    # A client that cannot read rows by epoch gets their sum (rule T5).
    is_total = not suffix and depth is None and row.layer.has_epochs and version < EPOCH_VERSION
    form = CellForm(TOTAL if is_total else suffix, depth, _time_s(at), known)
    found = service.views.cells.asked(row, key, form, known=if_none_match)
    headers = {
        "ETag": found.etag,
        "Cache-Control": "no-cache",
        "Accept-Ranges": "bytes",
        "Cairn-Cursor": str(found.head.cursor),
        **_coverage(found.head),
    }
    if row.layer.has_epochs:
        headers["Vary"] = "Cairn-Format"
    if found.fingerprint is not None:
        headers["Cairn-Fingerprint"] = found.fingerprint.hex()
    if found.data is None:
        return Response(status_code=304, headers=headers)
    if suffix:
        headers["Content-Disposition"] = f'attachment; filename="{row.name}_{number}.{suffix}"'
    asked_range = range_ if request.method == "GET" else None
    return _whole_or_part(found.data, form.media_type, headers, asked_range, if_range)


@router.put(
    "/maps/{name}/main/cells/{cell}",
    status_code=204,
    responses=problems(409),
    openapi_extra=body(CELL_MEDIA_TYPE),
)
def heal_cell(
    cell: str,
    service: Operations,
    row: Map,
    caller: Annotated[Caller, Depends(reader)],
    data: Annotated[bytes, Depends(body_of)],
) -> None:
    """Restore a cell that the server's disk damaged: only exactly the bytes that it had are accepted."""
    service.cells.heal(row, cell_key(cell_from_text(cell)), data, by=caller.name, client=caller.address)


def _whole_or_part(
    data: bytes, media_type: str, headers: dict[str, str], range_: str | None, if_range: str | None
) -> Response:
    """Answer 200 with all bytes, 206 with the range that the client asks for, or 416 if there is no such range."""
    try:
        part = part_of(len(data), range_, etag=headers["ETag"], if_range=if_range)
    except BadInputError as exc:
        refused = answer_to(exc)
        refused.headers["Content-Range"] = f"bytes */{len(data)}"
        return refused
    if part is None:
        return Response(data, media_type=media_type, headers=headers)
    start, stop = part
    headers |= {"Content-Range": f"bytes {start}-{stop - 1}/{len(data)}"}
    return Response(data[start:stop], 206, media_type=media_type, headers=headers)


def _time_s(text: str | None) -> float | None:
    return None if text is None else time_from_text(text)


def _check_form(dot: str, suffix: str, depth: int | None, row: MapRow, *, has_style: bool) -> None:
    if dot and suffix not in MEDIA_TYPES:
        raise BadInputError("unknown_format", f"cells come as {FORMS}, not as .{suffix[:16]}")
    if has_style and (suffix not in ("", "view") or (not suffix and depth is None)):
        raise BadInputError("unknown_format", f"only a view has a depth or a style, .{suffix or 'octree'} has none")
    if depth is not None and depth > row.geometry.depth:
        raise BadInputError("bad_style", f"a view's depth must be 1 to {row.geometry.depth}, got {depth}")


def _coverage(head: Head) -> dict[str, str]:
    """Header with the version vector at the cursor, or with its digest if the vector is long."""
    text = vector_text(head.vector)
    if len(text) <= COVERAGE_BYTES_MAX:
        return {"Cairn-Coverage": text}
    return {"Cairn-Coverage-Digest": vector_digest(head.vector)}


def part_of(size_bytes: int, asked: str | None, *, etag: str, if_range: str | None) -> tuple[int, int] | None:
    """First byte and the one after the last that a request asks for; None: the whole.

    `Range` and `If-Range` of RFC 9110, sections 13.1.5 and 14.

    Raises:
        BadInputError: kind `bad_range`: it begins behind the end (416).
    """
    found = ONE_RANGE.fullmatch(asked) if asked else None
    # Only the very ETag, and a strong one, promises that the parts belong together; a date never does.
    if found is None or found.groups() == ("", "") or (if_range is not None and if_range.strip() != etag):
        return None
    first, last = found.groups()
    if not first:  # the last so many
        start, stop = max(0, size_bytes - int(last)), size_bytes
    else:
        start, stop = int(first), min(size_bytes, int(last) + 1 if last else size_bytes)
        if last and int(last) < int(first):
            return None  # no range at all
    if start >= size_bytes:
        raise BadInputError("bad_range", f"there are {size_bytes} bytes; the range asked for begins behind them")
    return start, stop
