"""Memory for the cells at work at the same time: as many as fit, the others wait in order.

    617 MB to decode    one full cell of 128^3 voxels with the standard channels, or five of 400 000 known voxels
    847 MB to change    one full cell is decoded, a diff added, and encoded again

A thread enters for the whole size of what it is about to do, taken from the number of known voxels, and leaves when it
has what it made of the evidence. Room is taken around single cells only, never while another thread's result is waited
for. What a cell takes is bounded by its map's geometry, so a map of which one full cell does not fit is not made
(`check_geometry`).
"""

import threading
from collections import deque
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager

from cairn_map.codec.cell_reading import VOXEL_BYTES
from cairn_map.codec.history_code import is_history, split_history
from cairn_map.codec.octree.cell_head import head_sizes
from cairn_map.errors import BadInputError, DamagedDataError, UnreachableError
from cairn_map.evidence.grid import Geometry
from cairn_server.memory_shares import DECODING_MIN_BYTES, SPOOL_BYTES, MemoryShares, limit_for_cells

WAIT_S = 30.0
DECODED_BYTES = 40, 10, 27
"""Most memory for each known voxel of a cell that is decoded, more if it has samples, and more for each plane of them:
the leaves of its octree, their counts and samples, the raw streams, and the evidence
(docs/decisions/022-memory-as-one-sum.md)."""
CHANGED_BYTES = 64, 50, 32
"""The same for a cell that is changed: its sums, packed, and encoded."""
COMPARED_BYTES = 175, 10, 33
"""The same for a cell that is compared with itself less a part: the cell, the part, what is left, and both views. Of
2^21 voxels 419 were measured for each with nine planes, and 164 with none."""
SPOOLS_BYTES = 3 * SPOOL_BYTES
"""Memory for encoded cells on their way to the store: of two lanes, and once more in the server."""


class CellRoom:
    """Bytes that threads share while they work on cells; a thread that is inside enters again without waiting."""

    def __init__(self, limit_bytes: int, *, wait_s: float = WAIT_S) -> None:
        """A cell above `limit_bytes` enters alone."""
        self.limit_bytes = limit_bytes
        self._wait_s = wait_s
        self._changed = threading.Condition()
        self._waiting: deque[object] = deque()
        self._inside = threading.local()
        self.taken_bytes = 0
        """Bytes of all that are inside."""

    @property
    def waiting(self) -> int:
        """Threads that wait."""
        return len(self._waiting)

    @contextmanager
    def of(self, size_bytes: int) -> Iterator[None]:
        """Room of this size, for the length of a `with`.

        Raises:
            UnreachableError: kind `busy`: it did not come in time.
        """
        if getattr(self._inside, "is_set", False):
            yield
            return
        size_bytes = min(size_bytes, self.limit_bytes)
        self._enter(size_bytes)
        self._inside.is_set = True
        try:
            yield
        finally:
            self._inside.is_set = False
            with self._changed:
                self.taken_bytes -= size_bytes
                self._changed.notify_all()

    def _enter(self, size_bytes: int) -> None:
        mine = object()
        with self._changed:
            self._waiting.append(mine)
            try:
                has_room = self._changed.wait_for(
                    lambda: self._waiting[0] is mine and self.taken_bytes + size_bytes <= self.limit_bytes,
                    timeout=self._wait_s,
                )
                if not has_room:
                    raise UnreachableError(
                        "busy",
                        f"no memory to decode a cell came free in {self._wait_s:g} s; ask again",
                        retry_after_s=2.0,
                    )
                self.taken_bytes += size_bytes
            finally:
                self._waiting.remove(mine)
                self._changed.notify_all()


class DecodingRoom(CellRoom):
    """Room of the requests of a process."""

    def of_cell(self, geometry: Geometry, voxels: int) -> AbstractContextManager[None]:
        """Room to decode one cell of this geometry with so many known voxels.

        Raises:
            UnreachableError: kind `busy`: it did not come in time.
        """
        return self.of(decoded_bytes(geometry, voxels))


def voxels_of_cell(geometry: Geometry) -> int:
    """Voxels of a full cell."""
    return 1 << 3 * geometry.depth


def decoded_bytes(geometry: Geometry, voxels: int) -> int:
    """Most memory that decoding a cell takes: its grid, seen or not, or its known voxels, each with all samples.

    Of a cell with epochs the voxels are those of all its rows.
    """
    return max(VOXEL_BYTES * voxels_of_cell(geometry), _each_bytes(DECODED_BYTES, geometry) * voxels)


def changed_bytes(geometry: Geometry, voxels: int, *, rows: int = 1) -> int:
    """Most memory that a cell of so many voxels takes that is decoded, changed, and encoded again.

    Args:
        geometry: the map's.
        voxels: known ones, counted in each row of the cell.
        rows: count of the rows that are at work at once; all others are bytes.
    """
    return _each_bytes(CHANGED_BYTES, geometry) * min(voxels, rows * voxels_of_cell(geometry))


def compared_bytes(geometry: Geometry, voxels: int) -> int:
    """Most memory that a cell of so many voxels takes that is decoded, and compared with itself less a part."""
    return max(VOXEL_BYTES * voxels_of_cell(geometry), _each_bytes(COMPARED_BYTES, geometry) * voxels)


def _each_bytes(parts: tuple[int, int, int], geometry: Geometry) -> int:
    counts, sampled, plane = parts
    return counts + (sampled if geometry.plane_count else 0) + plane * geometry.plane_count


def check_geometry(geometry: Geometry, shares: MemoryShares) -> None:
    """Refuse a geometry of which one full cell takes more memory than there is for it.

    Raises:
        BadInputError: kind `cell_too_large`.
    """
    decoding_bytes = decoded_bytes(geometry, voxels_of_cell(geometry))
    folding_bytes = changed_bytes(geometry, voxels_of_cell(geometry)) + SPOOLS_BYTES
    if decoding_bytes > shares.decoding_bytes or folding_bytes > shares.folding_bytes:
        depth = geometry.depth - 1
        raise BadInputError(
            "cell_too_large",
            f"a full cell of this map, {geometry.side}^3 voxels with {len(geometry.channels)} channels, takes "
            f"{folding_bytes / 1e6:.0f} MB of memory to change and {decoding_bytes / 1e6:.0f} MB to read; this server "
            f"has {shares.folding_bytes / 1e6:.0f} and {shares.decoding_bytes / 1e6:.0f} MB for that: choose smaller "
            f"cells (depth {depth}: {1 << depth}^3 voxels), or have its administrator set memory_bytes to "
            f"{limit_for_cells(decoding_bytes, folding_bytes)} or more",
        )


def voxels_of(body: bytes) -> int:
    """Known voxels that the heads of a cell's rows, or of a diff, claim; 0 where damaged, which decoding finds."""
    try:
        if is_history(body):
            return sum(head_sizes(row)[1] for row in split_history(body).rows.values())
        return head_sizes(body)[1]
    except (DamagedDataError, BadInputError):
        return 0


DECODING = DecodingRoom(DECODING_MIN_BYTES)
"""Room of all requests of this process."""
