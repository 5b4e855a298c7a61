"""What a cell looks like at an octree depth, as pages ask for it: hundreds at once, nearly all of them made before.

So the cell's bytes are read, but not decoded before there is need to: its row says the digest, and that names the view.
"""

from cairn_map.codec.view_code import encode_view
from cairn_map.errors import DamagedDataError
from cairn_map.evidence.grid import CellKey
from cairn_map.evidence.view import ViewStyle
from cairn_server.folding.cells import Cells
from cairn_server.folding.cells_at_rest import stored_evidence, stored_surfaces
from cairn_server.store.store_rows import CellRow, Head, MapRow
from cairn_server.views.view_cache import ViewCache, view_name, way_of_seeing


def cell_etag(row: MapRow, stored: CellRow, suffix: str, depth: int | None) -> str:
    """Strong: the same cell, seen in the same way, gives the same bytes; its octree (no suffix, no depth) in any."""
    if depth is not None:
        suffix = f"view.{depth}"
    return f'"{stored.digest.hex()}.{suffix}.{way_of_seeing(row)}"' if suffix else f'"{stored.digest.hex()}"'


def asked_cell_view(
    cells: Cells, views: ViewCache, row: MapRow, key: CellKey, depth: int, *, known: str | None
) -> tuple[CellRow | None, Head, bytes | None]:
    """One cell (None: never seen), the state that it was read from, and its view (None: `known` names its ETag).

    Raises:
        DamagedCellError: kind `damaged_store`: the cell is damaged, and nothing here says what it was.
    """
    try:
        stored, head = cells.unchecked(row, key)
        return stored, head, _view(views, row, stored, depth, known)
    except DamagedDataError:
        stored, head = cells.sound(row, key)  # made anew from the log, if that says what it was
        return stored, head, _view(views, row, stored, depth, known)


def view_of_stored(row: MapRow, stored: CellRow, depth: int) -> bytes:
    """A stored cell's view.

    Raises:
        DamagedDataError: kind `damaged_store`: its bytes are not sound.
    """
    # What was never hit is below a half: where that does not show, neither does the air, which is most of a cell.
    read = stored_surfaces if row.sensor_model.p_occupied >= 0.5 else stored_evidence
    return encode_view(stored.key, read(stored), row.geometry, row.sensor_model, style=ViewStyle(depth=depth))


def _view(views: ViewCache, row: MapRow, stored: CellRow | None, depth: int, known: str | None) -> bytes | None:
    if stored is None or is_same(cell_etag(row, stored, "view", depth), known):
        return None
    return views.view(view_name(row, stored, depth), lambda: view_of_stored(row, stored, depth))


def is_same(etag: str, if_none_match: str | None) -> bool:
    """Whether `If-None-Match` names this ETag (or any); a weak one counts, too (section 13.1.2)."""
    if if_none_match is None:
        return False
    named = [text.strip().removeprefix("W/") for text in if_none_match.split(",")]
    return if_none_match.strip() == "*" or etag in named
