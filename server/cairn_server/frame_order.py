"""Which cells come first in a reply: a link that is slow or breaks soon has carried what matters most by then.

Any order is right (each frame stands alone), so it is the asker's wish: the cells around it, and of those equally far
away the ones that changed last.
"""

from collections.abc import Sequence

import numpy as np

from cairn_map.grid import CELL_LIMIT, Cell
from cairn_map.morton_kernels import deinterleave
from cairn_server.store_rows import CellRow


def in_order(rows: Sequence[CellRow], near: Cell | None) -> list[CellRow]:
    """The cells by their distance from a cell, in cells along the farthest axis; then, or without one, newest first."""
    if near is None or not rows:
        return sorted(rows, key=lambda row: -row.lm)
    cells = deinterleave(np.fromiter((row.key for row in rows), np.uint64, len(rows))) - CELL_LIMIT
    rings = np.abs(cells - np.array(near)).max(axis=1)
    newest = -np.fromiter((row.lm for row in rows), np.int64, len(rows))
    return [rows[n] for n in np.lexsort((newest, rings))]
