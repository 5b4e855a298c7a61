"""The views that are ready, in one answer: a page shows all of a map after one request, not after one for each cell.

For each cell, numbers little endian:

    uint32  bytes of the head      head: JSON, `cell` [i, j, k] and `etag` of the cell's own route
    uint32  bytes of the view      view (FORMAT.md 15)

Nothing is made for it (`views_ahead` does that): 15 us a cell. What is missing is asked for by cell.
"""

import json
import struct

from cairn_map.evidence.grid import cell_of_key
from cairn_server.store.store import Store
from cairn_server.store.store_rows import MapRow
from cairn_server.views.cell_view import cell_etag
from cairn_server.views.view_cache import ViewCache, view_name
from cairn_server.views.views_ahead import first_depth

MEDIA_TYPE = "application/vnd.cairn.views"
CELLS_MAX = 10_000
SIZE_BYTES_MAX = 8 << 20


def ready_views(store: Store, views: ViewCache, row: MapRow) -> tuple[int, bytes]:
    """Octree depth of the views, and those of the first cells that are ready, as above."""
    depth = first_depth(row.geometry.depth)
    with store.snapshot(row) as snapshot:
        cells = [cell for cell in snapshot.cells(limit=CELLS_MAX) if cell.voxels]
    found = bytearray()
    for cell in cells:
        view = views.ready(view_name(row, cell, depth))
        if view is None:
            continue
        head = json.dumps({"cell": cell_of_key(cell.key), "etag": cell_etag(row, cell, "view", depth)}).encode()
        if len(found) + 8 + len(head) + len(view) > SIZE_BYTES_MAX:
            break
        for part in (head, view):
            found += struct.pack("<I", len(part)) + part
    return depth, bytes(found)
