"""Which cells come first in a reply; any order is right (each frame stands alone), so it is the asker's wish."""

from collections.abc import Sequence

import numpy as np

from cairn_map.evidence.cell_order import first_to_last
from cairn_map.evidence.grid import CELL_LIMIT, Cell
from cairn_map.kernels.morton_kernels import deinterleave
from cairn_server.store.store_rows import CellRow


def in_order(rows: Sequence[CellRow], near: Cell | None) -> list[CellRow]:
    """The cells around a cell first, and hot ones before others (`cell_order`)."""
    order = first_to_last(
        deinterleave(np.fromiter((row.key for row in rows), np.uint64, len(rows))) - CELL_LIMIT,
        near=near,
        changed=np.fromiter((row.lm for row in rows), np.int64, len(rows)),
        hottest_k=np.array([row.hottest_k for row in rows], np.float64),
    )
    return [rows[n] for n in order]
