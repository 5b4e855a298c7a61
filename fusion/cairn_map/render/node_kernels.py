"""Reading the nodes that pixels see from the tables of their cells; no checks."""

import numba as nb
import numpy as np
import numpy.typing as npt

from cairn_map.arrays import Bytes, Int32s
from cairn_map.queries.occupancy_kernels import U

Places = npt.NDArray[np.uint32]
Table = npt.NDArray[np.float32]


@nb.njit(cache=True, nogil=True)
def read_nodes_into(
    rows: Int32s, places: Places, nodes: Bytes, bricks: npt.NDArray[np.int16], table: Table, out: Table
) -> None:
    """Of the listed pixels of one cell: (N, P) what `node_tables` say of their nodes, all in its bricks."""
    firsts = (0, 512, 576, 584)
    for n in range(U(rows.shape[0])):
        row = U(rows[n])
        place, node = places[row], nodes[row]
        brick = U(bricks[place >> U(9)])
        at = U(firsts[node]) + ((place & U(511)) >> U(3 * node))
        for p in range(out.shape[1]):
            out[row, p] = table[brick, at, p]
