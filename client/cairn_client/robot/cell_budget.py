"""What a robot with limits keeps of its server's map: the cells around it, as many as fit.

Full is said by `NO_ROOM` out of whatever would hold one cell more. Then the index of the server's cells tells how far
around the robot they fit, all farther ones are dropped, and the fetch begins anew with a box around the robot. The box
goes with the robot. Dropped cells count as not held (`UNPROVEN`): the rules of sync need no exception for them.
"""

import logging
import time
from collections.abc import Callable, Iterable

import numpy as np
from pydantic import BaseModel, ConfigDict

from cairn_client.replica.replica import UNPROVEN, Replica
from cairn_client.robot.limits import Limits
from cairn_client.robot.robot_events import CellsDropped, Events, OutboxNearlyFull
from cairn_client.sync.cell_index import whole_index
from cairn_client.sync.requests import Box, Conversation
from cairn_map.arrays import Ints
from cairn_map.errors import UnreachableError
from cairn_map.evidence.grid import CELL_LIMIT, Cell, CellKey, cell_of_key

log = logging.getLogger(__name__)

NO_ROOM = "no_room"
ROOM_KEY = "room"
FILL = 0.75
"""Part of the limits that a box is chosen to fill; the rest is for what the map grows by."""
TIGHTER = 0.7
"""A box that was too large after all is chosen anew, to fill this part of what the one before was to fill."""
NEARLY = 0.8
"""Part of the outbox's room from which on it is told."""
CHOOSE_AGAIN_S = 300.0
"""How often it is asked whether more fits, while half of the limits is free."""
ROW_BYTES = 8192
"""What a cell takes on the disk beyond its bytes: half a page on average, and its row."""
VOXEL_BYTES = 16
CELL_BYTES = 8192
"""Memory of a known voxel and of a cell: 9 to 13 bytes were measured with all channels."""
SLACK_BYTES = 1 << 16
"""Pages that a transaction may need beyond what it writes."""

Place = Callable[[], tuple[float, float, float] | None]
"""Where the robot is, metres, map frame; None if nobody knows."""


class Kept(BaseModel):
    """The cells that are kept, of a full robot; remembered."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    centre: tuple[int, int, int]
    radius: int
    """Of a cube of cells around the centre's: 0 is the centre alone."""


class Room:
    """One robot's room; without limits it does nothing."""

    def __init__(
        self, replica: Replica, limits: Limits, events: Events, *, place: Place, scope_box: Box | None
    ) -> None:
        """Watch over a replica from here on.

        Args:
            replica: its `admit` and its outbox's `make_room` are set.
            limits: see there.
            events: told of what is dropped.
            place: of the robot; the centre of what is kept.
            scope_box: the cells that the robot fetches at all.
        """
        self._replica = replica
        self._limits = limits
        self._events = events
        self._place = place
        self._scope_box = scope_box
        text = replica.store.get(ROOM_KEY) if limits.disk_bytes_max or limits.memory_bytes_max else None
        self.kept: Kept | None = Kept.model_validate_json(text) if text else None
        """None: the whole map fits, as far as is known."""
        self._is_old = self.kept is not None
        """The box is to be chosen anew: there may be more room, or another map, than when it was chosen."""
        self._fill = FILL
        self._chosen_s = float("-inf")
        self._is_nearly_full = False
        self._view_bytes = 0
        self._last: tuple[CellKey, int] | None = None
        if limits.disk_bytes_max or limits.memory_bytes_max:
            replica.admit = self._admit
        if limits != Limits():
            replica.outbox.make_room = self._make_room

    def box(self) -> Box | None:
        """The cells to fetch; None: those of the scope."""
        if self.kept is None:
            return None
        low, high = (np.array(self.kept.centre) + offset for offset in (-self.kept.radius, self.kept.radius))
        if self._scope_box is not None:
            low, high = np.maximum(low, self._scope_box[0]), np.minimum(high, self._scope_box[1])
        low, high = np.maximum(low, -CELL_LIMIT), np.minimum(high, CELL_LIMIT - 1)
        return Cell(*low.tolist()), Cell(*high.tolist())

    def keep_up(self) -> Conversation[None]:
        """Before a fetch: move the box if the robot has moved."""
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
        """After `NO_ROOM`: a smaller box; False if there is none."""
        before = self.kept
        yield from self._choose()
        self._fill *= TIGHTER
        return before is None or self.kept is None or self.kept != before

    def _choose(self) -> Conversation[None]:
        """The largest cube around the robot whose cells fit, by the server's index; drop the others."""
        index = yield from whole_index(self._replica.author, box=self._scope_box)
        self._chosen_s = time.monotonic()
        with self._replica.lock:
            self._replica.forget_stable_commits(wanted=self._is_kept)
            centre = self._centre()
            cells = np.array([entry.cell for entry in index.cells], np.int64).reshape(-1, 3)
            far = np.abs(cells - centre).max(axis=1, initial=0)
            disk = np.array([entry.size_bytes + ROW_BYTES for entry in index.cells], np.int64)
            memory = np.array([entry.voxels * VOXEL_BYTES + CELL_BYTES for entry in index.cells], np.int64)
            disk_max, memory_max = self._for_cells()
            order = np.argsort(far, kind="stable")
            too_much = (disk[order].cumsum() > disk_max) | (memory[order].cumsum() > memory_max)
            self._is_old = False
            if too_much.any():
                first_out = int(far[order][int(too_much.argmax())])
                self._keep(Kept(centre=_triple(centre), radius=max(first_out - 1, 0)))
                self._drop(key for key in self._held() if self._distance(key, centre) >= max(first_out, 1))
            else:
                self._keep(None)

    def _admit(self, key: CellKey, size_bytes: int) -> None:
        """May a cell of so many bytes be held? Raises: UnreachableError: kind `no_room`."""
        limits = self._limits
        if self._last is not None:  # it is in the view by now
            last, before = self._last
            self._view_bytes += self._cell_bytes(last) - before
        self._last = (key, self._cell_bytes(key))
        used = self._replica.store.used_bytes() if limits.disk_bytes_max else 0
        if limits.disk_bytes_max and used + size_bytes + SLACK_BYTES > limits.disk_bytes_max:
            raise UnreachableError(NO_ROOM, f"{used} bytes of {limits.disk_bytes_max} on the disk are in use")
        if limits.memory_bytes_max and self._view_bytes + CELL_BYTES > limits.memory_bytes_max:
            raise UnreachableError(NO_ROOM, f"the map takes {self._view_bytes} of {limits.memory_bytes_max} bytes")

    def _make_room(self, size_bytes: int) -> None:
        """For a commit: see the module's head of `limits`.

        Raises:
            UnreachableError: kind `outbox_full`: there is no more to drop; try again after a sync.
        """
        replica = self._replica
        if self._complaint(size_bytes):
            replica.forget_stable_commits(wanted=self._is_kept)
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
        self._tell_if_nearly_full(size_bytes)

    def _tell_if_nearly_full(self, size_bytes: int) -> None:
        limits, store = self._limits, self._replica.store
        parts = []
        if limits.outbox_bytes_max:
            parts.append((self._outbox_bytes() + size_bytes, limits.outbox_bytes_max))
        if limits.disk_bytes_max:
            parts.append((store.used_bytes() - sum(store.cell_bytes().values()) + size_bytes, limits.disk_bytes_max))
        used, limit = max(parts, key=lambda part: part[0] / part[1], default=(0, 1))
        was_told, self._is_nearly_full = self._is_nearly_full, used > NEARLY * limit
        if self._is_nearly_full and not was_told:
            self._events.tell(OutboxNearlyFull(size_bytes=used, max_bytes=limit))

    def _complaint(self, size_bytes: int) -> tuple[str, int, int] | None:
        """Which limit a commit of so many bytes would break, what is in use, and the limit."""
        limits, store = self._limits, self._replica.store
        if limits.outbox_bytes_max and (kept := self._outbox_bytes()) + size_bytes > limits.outbox_bytes_max:
            return "outbox", kept, limits.outbox_bytes_max
        if limits.disk_bytes_max and (used := store.used_bytes()) + size_bytes + SLACK_BYTES > limits.disk_bytes_max:
            return "disk", used, limits.disk_bytes_max
        if limits.memory_bytes_max and (view := self._measured()) > limits.memory_bytes_max:
            return "memory", view, limits.memory_bytes_max
        return None

    def _drop_farthest(self) -> bool:
        """Drop the farthest tenth of the cells held; False if there are none."""
        held = self._held()
        if not held:
            return False
        centre = self._centre()
        by_distance = sorted(held, key=lambda key: self._distance(key, centre))
        gone = by_distance[len(held) - (len(held) + 9) // 10 :]
        self._keep(Kept(centre=_triple(centre), radius=max(self._distance(gone[0], centre) - 1, 0)))
        self._drop(gone)
        return True

    def _drop(self, keys: Iterable[CellKey]) -> None:
        gone = list(keys)
        if not gone:
            return
        drop_cells(self._replica, gone)
        log.warning("%d cells of the server made room", len(gone))
        self._events.tell(CellsDropped(cells=tuple(cell_of_key(key) for key in sorted(gone))))
        self._view_bytes, self._last = self._measured(), None

    def _keep(self, kept: Kept | None) -> None:
        self.kept = kept
        with self._replica.store.transaction():
            self._replica.store.put(ROOM_KEY, kept.model_dump_json() if kept else None)

    def _is_half_empty(self) -> bool:
        limits = self._limits
        used = self._replica.store.used_bytes() if limits.disk_bytes_max else 0
        return used * 2 < (limits.disk_bytes_max or 1) and self._view_bytes * 2 < (limits.memory_bytes_max or 1)

    def _held(self) -> list[CellKey]:
        return [key for key, cell in self._replica.cells.items() if cell != UNPROVEN]

    def _is_kept(self, cell: Cell) -> bool:
        box = self.box() or self._scope_box
        return box is None or all(a <= b <= c for a, b, c in zip(box[0], cell, box[1], strict=True))

    def _for_cells(self) -> tuple[float, float]:
        """Bytes on the disk and in memory that cells of the server may take."""
        limits, store = self._limits, self._replica.store
        sizes = store.cell_bytes()
        others = store.used_bytes() - sum(size + ROW_BYTES for size in sizes.values() if size)
        disk = limits.disk_bytes_max * self._fill - max(others, 0) if limits.disk_bytes_max else float("inf")
        own = self._replica.outbox.cells - set(self._held())
        memory = limits.memory_bytes_max or float("inf")
        return disk, memory * self._fill - sum(map(self._cell_bytes, own))

    def _centre(self) -> Ints:
        """The robot's cell, or where it was last, or the middle of what is held; within the scope."""
        place = self._place()
        edge_m = self._replica.geometry.cell_edge_m
        if place is not None:
            centre = np.floor(np.array(place) / edge_m).astype(np.int64)
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
        cell = self._replica.view.cell(key)
        return cell.size_bytes if cell else 0

    def _measured(self) -> int:
        return self._replica.view.size_bytes if self._limits.memory_bytes_max else 0

    def _outbox_bytes(self) -> int:
        return self._replica.store.data_bytes([kept.id for kept in self._replica.outbox])


def drop_cells(replica: Replica, keys: Iterable[CellKey]) -> None:
    """Hold nothing of some held cells; the view shows of them what the robot made itself."""
    gone = list(keys)
    with replica.lock:
        with replica.store.transaction():
            for key in gone:
                replica.store.put_cell(key, UNPROVEN, body=b"")
        for key in gone:
            replica.cells[key] = UNPROVEN
            replica.refresh_view(key)


def _triple(cell: Ints) -> tuple[int, int, int]:
    i, j, k = (int(number) for number in cell)
    return i, j, k
