"""Budget of a robot with limits: it keeps the cells of the server around the robot, as many as fit.

    hold one cell more     raises `NO_ROOM` when the limits are reached
    tighten                the server's index tells how far around the robot cells fit; all farther ones are dropped
    fetch                  begins again, with a box around the robot
    keep_up                moves the box with the robot

Dropped cells count as not held (`UNPROVEN`): the rules of sync need no exception for them.
"""

import logging
import time
from collections.abc import Callable, Iterable

import numpy as np

from cairn_client.replica.limits import NO_LIMITS, Limits
from cairn_client.replica.replica import Replica
from cairn_client.replica.replica_state import CellCube
from cairn_client.replica.server_cells import UNPROVEN
from cairn_client.robot.robot_events import CellsDropped, Events, OutboxNearlyFull
from cairn_client.sync.indexed_cells import IndexedCells
from cairn_client.sync.requests import Box, Conversation, whole_index
from cairn_map.arrays import Ints
from cairn_map.errors import UnreachableError
from cairn_map.evidence.compact_cell import HELD_PER_BYTE
from cairn_map.evidence.grid import CELL_LIMIT, Cell, CellKey, cell_of_key

log = logging.getLogger(__name__)

NO_ROOM = "no_room"
"""Error kind of a cell for which there is no room."""
FILL = 0.75
"""Fraction of the limits that a box is chosen to fill; the rest is for the growth of the map."""
TIGHTER = 0.7
"""Fraction by which the fill is reduced when a box was too large after all."""
NEARLY = 0.8
"""Fraction of the outbox's budget above which a warning is sent."""
CHOOSE_AGAIN_S = 300.0
"""Least seconds between two tries of a larger box, while half of the limits is free."""
ROW_BYTES = 8192
"""Bytes of a cell on the disk beyond its content: half a page on average, and its row."""
COUNT_MAX = 1 << 36
"""Bytes or voxels of a listed cell that are believed: more than any cell has, and a million of them can be added."""
VOXEL_BYTES = 16
"""Memory of a known voxel: 9 to 13 bytes were measured with all channels."""
CELL_BYTES = 8192
"""Memory of a cell beyond its voxels."""
SLACK_BYTES = 1 << 16
"""Pages that a transaction may need beyond what it writes."""

Place = Callable[[], tuple[float, float, float] | None]
"""Returns the robot's position, metres, map frame; None if it is unknown."""


class CellBudget:
    """Budget of one robot's disk and memory (`replica.StorageBudget`); without limits it does nothing."""

    def __init__(
        self, replica: Replica, limits: Limits, events: Events, *, place: Place, scope_box: Box | None
    ) -> None:
        """Watch over a replica from here on.

        Args:
            replica: the robot's state; it obeys this budget from here on.
            limits: bytes on the disk, in the outbox and in memory.
            events: streams to which dropped cells and a full outbox are reported.
            place: returns the robot's position, around which cells are kept.
            scope_box: cells that the robot fetches at all; None: all.
        """
        self._replica = replica
        self._limits = limits
        self._events = events
        self._place = place
        self._scope_box = scope_box
        self._memory_max = limits.map_bytes_max
        self._limits_cells = bool(limits.disk_bytes_max or self._memory_max)
        self.kept: CellCube | None = replica.state.kept_cube if self._limits_cells else None
        """Cells of the server that are kept; None while the whole map fits."""
        self._is_old = self.kept is not None
        """True if the box is to be chosen again: there may be more room, or another map, than when it was chosen."""
        self._fill = FILL
        self._chosen_s = float("-inf")
        self._is_nearly_full = False
        self._view_bytes = 0
        self._last: tuple[CellKey, int] | None = None
        if limits != NO_LIMITS:
            replica.obey(self)

    def box(self) -> Box | None:
        """Box of the cells to fetch; None: those of the scope."""
        if self.kept is None:
            return None
        low, high = (np.array(self.kept.centre) + offset for offset in (-self.kept.radius, self.kept.radius))
        if self._scope_box is not None:
            low, high = np.maximum(low, self._scope_box[0]), np.minimum(high, self._scope_box[1])
        low, high = np.maximum(low, -CELL_LIMIT), np.minimum(high, CELL_LIMIT - 1)
        return Cell(*low.tolist()), Cell(*high.tolist())

    def keep_up(self) -> Conversation[None]:
        """Move the box if the robot has moved; before each fetch."""
        while self._memory_max and self._measured() > self._memory_max and self._drop_farthest():
            pass
        self._view_bytes, self._last = self._measured(), None
        kept = self.kept
        if kept is None:
            return
        moved = int(np.abs(self._centre() - np.array(kept.centre)).max())
        if time.monotonic() - self._chosen_s > CHOOSE_AGAIN_S and self._is_half_empty():
            self._is_old = True
        if self._is_old or moved > kept.radius // 2:
            self._fill = FILL
            yield from self._choose()

    def tighten(self) -> Conversation[bool]:
        """Choose a smaller box, after `NO_ROOM`; False if there is none."""
        before = self.kept
        yield from self._choose()
        self._fill *= TIGHTER
        return before is None or self.kept is None or self.kept != before

    def _choose(self) -> Conversation[None]:
        """Choose the largest cube around the robot whose cells fit, by the server's index; drop the others."""
        index = yield from whole_index(self._replica.author, box=self._scope_box)
        self._chosen_s = time.monotonic()
        with self._replica.changing():
            # Where the disk is short, what the server has for good goes before a cell near the robot does. Memory is no
            # reason: the bytes of commits take none, and a server can make a map as large as it likes.
            if self._limits.disk_bytes_max:
                while self._replica.make_room_of_stable_commits(wanted=self._is_kept):
                    pass
            self._replica.forget_stable_commits(wanted=self._is_kept)
            # Bytes of each cell that the server has, and its distance from the robot's cell.
            centre = self._centre()
            far = np.abs(index.cells.cells - centre).max(axis=1, initial=0)
            disk = np.minimum(index.cells.table["size_bytes"], COUNT_MAX) + ROW_BYTES
            memory = _memory_of(index.cells)
            # The first ring of cells with which the sum, from the centre outwards, breaks a limit is the first one out.
            disk_max, memory_max = self._for_cells()
            order = np.argsort(far, kind="stable")
            too_much = (disk[order].cumsum() > disk_max) | (memory[order].cumsum() > memory_max)
            self._is_old = False
            if too_much.any():
                first_out = int(far[order][int(too_much.argmax())])
                self._keep(CellCube(centre=_triple(centre), radius=max(first_out - 1, 0)))
                self._drop(key for key in self._held() if self._distance(key, centre) >= max(first_out, 1))
            else:
                self._keep(None)

    def admit_cell(self, key: CellKey, size_bytes: int) -> None:
        """Check that a cell of so many bytes may be held.

        Raises:
            UnreachableError: kind `no_room`.
        """
        limits = self._limits
        if not self._limits_cells:
            return
        # The memory of the view is kept as a sum: the cell admitted before this one has changed since, and no other.
        if self._last is not None:
            last, before = self._last
            self._view_bytes += self._cell_bytes(last) - before
        self._last = (key, self._cell_bytes(key))
        used = self._replica.store.used_bytes() if limits.disk_bytes_max else 0
        if limits.disk_bytes_max and used + size_bytes + SLACK_BYTES > limits.disk_bytes_max:
            raise UnreachableError(NO_ROOM, f"{used} bytes of {limits.disk_bytes_max} on the disk are in use")
        if self._memory_max and self._view_bytes + CELL_BYTES > self._memory_max:
            raise UnreachableError(NO_ROOM, f"the map takes {self._view_bytes} of {self._memory_max} bytes")

    def make_room(self, size_bytes: int) -> None:
        """Drop, in the order of `limits`, until a commit of so many bytes fits.

        Raises:
            UnreachableError: kind `outbox_full`: nothing is left to drop; try again after a sync.
        """
        replica = self._replica
        while self._complaint(size_bytes) and replica.make_room_of_stable_commits(wanted=self._is_kept):
            pass
        while (complaint := self._complaint(size_bytes)) and complaint[0] != "outbox" and self._drop_farthest():
            pass
        if complaint:
            which, used, limit = complaint
            waiting = len(replica.push_set())
            raise UnreachableError(
                "outbox_full",
                f"no room for a commit of {size_bytes} bytes: {used} of {limit} ({which}_bytes_max) are taken by "
                f"commits that the server does not have for good, {waiting} of them unpushed; the measurement stays "
                "open: sync, or raise the limit",
            )
        self._warn_if_nearly_full(size_bytes)

    def _warn_if_nearly_full(self, size_bytes: int) -> None:
        limits, store = self._limits, self._replica.store
        parts = []
        if limits.outbox_bytes_max:
            parts.append((self._outbox_bytes() + size_bytes, limits.outbox_bytes_max))
        if limits.disk_bytes_max:
            parts.append((store.used_bytes() - sum(store.cell_bytes().values()) + size_bytes, limits.disk_bytes_max))
        used, limit = max(parts, key=lambda part: part[0] / part[1], default=(0, 1))
        was_warned, self._is_nearly_full = self._is_nearly_full, used > NEARLY * limit
        if self._is_nearly_full and not was_warned:
            self._events.send(OutboxNearlyFull(size_bytes=used, max_bytes=limit))

    def _complaint(self, size_bytes: int) -> tuple[str, int, int] | None:
        """Limit that a commit of so many bytes would break, the bytes in use, and the limit's; None if it fits."""
        limits, store = self._limits, self._replica.store
        if limits.outbox_bytes_max and (kept := self._outbox_bytes()) + size_bytes > limits.outbox_bytes_max:
            return "outbox", kept, limits.outbox_bytes_max
        if limits.disk_bytes_max and (used := store.used_bytes()) + size_bytes + SLACK_BYTES > limits.disk_bytes_max:
            return "disk", used, limits.disk_bytes_max
        if self._memory_max and (view := self._measured()) > self._memory_max:
            return "memory", view, self._memory_max
        return None

    def _drop_farthest(self) -> bool:
        """Drop the farthest tenth of the cells held; False if there are none."""
        held = self._held()
        if not held:
            return False
        centre = self._centre()
        by_distance = sorted(held, key=lambda key: self._distance(key, centre))
        gone = by_distance[len(held) - (len(held) + 9) // 10 :]
        self._keep(CellCube(centre=_triple(centre), radius=max(self._distance(gone[0], centre) - 1, 0)))
        self._drop(gone)
        return True

    def _drop(self, keys: Iterable[CellKey]) -> None:
        gone = list(keys)
        if not gone:
            return
        self._replica.drop_cells(gone)
        log.warning("%d cells of the server made room", len(gone))
        self._events.send(CellsDropped(cells=tuple(cell_of_key(key) for key in sorted(gone))))
        self._view_bytes, self._last = self._measured(), None

    def _keep(self, kept: CellCube | None) -> None:
        self.kept = kept
        self._replica.state.kept_cube = kept

    def _is_half_empty(self) -> bool:
        limits = self._limits
        used = self._replica.store.used_bytes() if limits.disk_bytes_max else 0
        return used * 2 < (limits.disk_bytes_max or 1) and self._view_bytes * 2 < (self._memory_max or 1)

    def _held(self) -> list[CellKey]:
        return [key for key, cell in self._replica.cells.items() if cell != UNPROVEN]

    def _is_kept(self, cell: Cell) -> bool:
        box = self.box() or self._scope_box
        return box is None or all(a <= b <= c for a, b, c in zip(box[0], cell, box[1], strict=True))

    def _for_cells(self) -> tuple[float, float]:
        """Bytes on the disk and in memory that are left for cells of the server."""
        limits, store = self._limits, self._replica.store
        sizes = store.cell_bytes()
        others = store.used_bytes() - sum(size + ROW_BYTES for size in sizes.values() if size)
        disk = limits.disk_bytes_max * self._fill - max(others, 0) if limits.disk_bytes_max else float("inf")
        own = self._replica.own_cells() - set(self._held())
        memory = self._memory_max or float("inf")
        return disk, memory * self._fill - sum(map(self._cell_bytes, own))

    def _centre(self) -> Ints:
        """The robot's cell, else the last centre, else the middle of the cells that are held; within the scope."""
        place = self._place()
        edges_m = self._replica.geometry.cell_edges_m
        if place is not None:
            centre = np.floor(np.array(place) / edges_m).astype(np.int64)
        elif self.kept is not None:
            centre = np.array(self.kept.centre, np.int64)
        else:
            cells = [cell_of_key(key) for key in self._replica.cells] or [Cell(0, 0, 0)]
            centre = np.median(np.array(cells), axis=0).astype(np.int64)
        if self._scope_box is not None:
            centre = np.clip(centre, self._scope_box[0], self._scope_box[1])
        return np.clip(centre, -CELL_LIMIT, CELL_LIMIT - 1)

    def _distance(self, key: CellKey, centre: Ints) -> int:
        return int(np.abs(np.array(cell_of_key(key)) - centre).max())

    def _cell_bytes(self, key: CellKey) -> int:
        return self._replica.view.cell_bytes(key)

    def _measured(self) -> int:
        return self._replica.memory_bytes() if self._memory_max else 0

    def _outbox_bytes(self) -> int:
        return self._replica.kept_bytes()


def _memory_of(listed: IndexedCells) -> Ints:
    """(N,) memory that each listed cell takes at most: few bytes never take much."""
    voxels, size_bytes = (np.minimum(listed.table[name], COUNT_MAX) for name in ("voxels", "size_bytes"))
    memory: Ints = np.minimum(voxels * VOXEL_BYTES, size_bytes * HELD_PER_BYTE) + CELL_BYTES
    return memory


def _triple(cell: Ints) -> tuple[int, int, int]:
    i, j, k = (int(number) for number in cell)
    return i, j, k
