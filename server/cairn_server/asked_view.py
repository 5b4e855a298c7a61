"""What a cell looks like at an octree depth, as pages ask for it: hundreds at once, nearly all of them made before.

So the cell's bytes are read, but not decoded before there is need to: its row says the digest, and that names the view.
"""

from cairn_map.errors import DamagedDataError
from cairn_map.grid import CellKey
from cairn_map.view import ViewStyle
from cairn_map.view_code import encode_view
from cairn_server.cells_at_rest import stored_evidence, stored_surfaces
from cairn_server.http_ranges import is_same
from cairn_server.service import Service
from cairn_server.store_rows import CellRow, Head, MapRow
from cairn_server.view_cache import view_name, way_of_seeing


def cell_etag(row: MapRow, stored: CellRow, suffix: str, depth: int | None) -> str:
    """Strong: the same cell, seen in the same way, gives the same bytes; its octree (no suffix, no depth) in any."""
    if depth is not None:
        suffix = f"view.{depth}"
    return f'"{stored.digest.hex()}.{suffix}.{way_of_seeing(row)}"' if suffix else f'"{stored.digest.hex()}"'


def asked_cell_view(
    service: Service, row: MapRow, key: CellKey, depth: int, *, known: str | None
) -> tuple[CellRow | None, Head, bytes]:
    """One cell (None: never seen), the state that it was read from, and its view; empty if `known` says its ETag.

    Raises:
        DamagedCellError: kind `damaged_store`: the cell is damaged, and nothing here says what it was.
    """
    try:
        stored, head = service.cell_unchecked(row, key)
        return stored, head, _view(service, row, stored, depth, known)
    except DamagedDataError:
        stored, head = service.cell(row, key)  # made anew from the log, if that says what it was
        return stored, head, _view(service, row, stored, depth, known)


def view_of_stored(row: MapRow, stored: CellRow, depth: int) -> bytes:
    """A stored cell's view.

    Raises:
        DamagedDataError: kind `damaged_store`: its bytes are not sound.
    """
    # What was never hit is below a half: where that does not show, neither does the air, which is most of a cell.
    read = stored_surfaces if row.sensor_model.p_occupied >= 0.5 else stored_evidence
    return encode_view(stored.key, read(stored), row.geometry, row.sensor_model, style=ViewStyle(depth=depth))


def _view(service: Service, row: MapRow, stored: CellRow | None, depth: int, known: str | None) -> bytes:
    if stored is None or is_same(cell_etag(row, stored, "view", depth), known):
        return b""
    return service.cell_views.view(view_name(row, stored, depth), lambda: view_of_stored(row, stored, depth))
