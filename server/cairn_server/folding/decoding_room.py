"""Memory for the cells that requests decode at the same time: as many as fit, the others wait in order.

    256 MB    ten cells of 128^3 voxels at once, or one of 256^3

A request enters for the cell's whole size at 12 bytes a voxel, whatever few bytes it comes from, or for more if its
voxels can have samples of many channels; it leaves when it has what it made of the evidence. Room is taken around
single cells only, never while another thread's result is waited for.
"""

import threading
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager

from cairn_map.codec.cell_reading import VOXEL_BYTES
from cairn_map.codec.octree.cell_head import head_sizes
from cairn_map.errors import DamagedDataError, UnreachableError
from cairn_map.evidence.grid import Geometry
from cairn_server.memory_shares import DECODING_BYTES

WAIT_S = 30.0


class DecodingRoom:
    """Bytes that threads share while they decode cells; a thread that is inside enters again without waiting."""

    def __init__(self, limit_bytes: int, *, wait_s: float = WAIT_S) -> None:
        """A cell above `limit_bytes` enters alone."""
        self._limit_bytes = limit_bytes
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
    def of_cell(self, geometry: Geometry, voxels: int) -> Iterator[None]:
        """Room to decode one cell of this geometry with so many known voxels, for the length of a `with`.

        Raises:
            UnreachableError: kind `busy`: it did not come in time.
        """
        if getattr(self._inside, "is_set", False):
            yield
            return
        size_bytes = min(decoded_bytes(geometry, voxels), self._limit_bytes)
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
                    lambda: self._waiting[0] is mine and self.taken_bytes + size_bytes <= self._limit_bytes,
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


def decoded_bytes(geometry: Geometry, voxels: int) -> int:
    """Memory that a cell takes decoded: its grid, seen or not, or all of its voxels with a sample of each channel."""
    planes_bytes = 4 + 8 * geometry.plane_count if geometry.plane_count else 0
    return max(VOXEL_BYTES << (3 * geometry.depth), (VOXEL_BYTES + planes_bytes) * voxels)


def voxels_of(body: bytes) -> int:
    """Known voxels that the head of a cell's or diff's bytes claims; 0 where it is damaged, which decoding finds."""
    try:
        return head_sizes(body)[1]
    except DamagedDataError:
        return 0


DECODING = DecodingRoom(DECODING_BYTES)
"""Room of all requests of this process."""
