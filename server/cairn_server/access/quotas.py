"""Quotas of pushes: a faulty or hostile robot must not fill the disk or blow up the map for the others.

A quota is checked after the commit's head is read and before its evidence is decoded, that of bricks after it is
checked, which counts them. It is taken at once, so that a
robot's parallel pushes share it, and given back if the commit is refused or was known. An exceeded rate (429) passes
with time; a commit that is too large (400) does not. Days are those of UTC. The accounts are this process's own
(`use_accounts`), or those that all servers of the store share.
"""

import math
import threading
import time
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager

import numpy as np

from cairn_map.errors import BadInputError, UnreachableError
from cairn_map.evidence.grid import CELL_LIMIT, CellKey
from cairn_map.kernels.morton_kernels import deinterleave
from cairn_server.access.auth import UPSTREAM, Caller, Role
from cairn_server.access.use_accounts import DAY_S, OwnUseAccounts
from cairn_server.settings import Quotas
from cairn_server.store.replica_notes import UseAccounts, UseBounds
from cairn_server.store.shares import REGION_BITS
from cairn_server.store.store import Store
from cairn_server.store.store_rows import MapRow, Robot, Use, relay_of, unpaid_bricks

BOX_EVERY_S = 5.0
"""Least time between two readings of a robot's box while its commits beyond it are refused: retracts make it smaller.
"""
BOX_PAUSE_FACTOR = 50.0
"""Pause after a reading, in times of what it took: a robot with millions of cells must not keep the server busy."""
Corner = tuple[int, int, int]
Box = tuple[Corner, Corner]
"""Lowest and highest cell."""
Edges = tuple[float, float, float]
"""Edges of a cell along x, y and z, metres."""


class Meter:
    """Use of the quotas by every robot; called from many threads."""

    def __init__(
        self,
        store: Store,
        quotas: Quotas,
        *,
        wall_s: Callable[[], float] = time.time,
        steady_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._store = store
        self._quotas = quotas
        self._wall_s = wall_s
        self._steady_s = steady_s
        self._is_shared = store.replicas is not None
        self.accounts: UseAccounts = (
            OwnUseAccounts(store.uses, wall_s=wall_s, steady_s=steady_s)
            if store.replicas is None
            else store.replicas.uses
        )
        self._bounds = UseBounds(
            size_bytes=quotas.bytes_per_day,
            cells=quotas.cells_per_day,
            bricks=quotas.bricks_per_day,
            commits_per_minute=quotas.commits_per_minute,
        )
        self._lock = threading.Lock()
        self._reaches: dict[Robot, _Reach] = {}

    @contextmanager
    def spending(
        self,
        row: MapRow,
        caller: Caller,
        *,
        size_bytes: int,
        cells: Collection[CellKey],
        author: str = "",
        via: str | None = None,
    ) -> Iterator["Spending"]:
        """Take a commit off its robot's quotas for the length of a `with`; what it yields may keep it taken.

        Where it lies is compared with the other cells of `author`, the robot that made it: what another robot has
        pushed, however far away, is no reason to refuse it.

        What a relay hands over (`via`: its token) is taken off the relay's quotas. What this server fetches itself
        from its upstream is held to the limits of one commit only: it may be all of a map that grew for years.

        Raises:
            UnreachableError: kind `quota`: too much for now, with the seconds until it is not.
            BadInputError: kind `beyond_quota`: too much at any time.
        """
        if caller.role is Role.ADMIN:
            yield Spending(Use(), _charge_nothing)
            return
        robot = row.number, relay_of(via) if via else caller.robot or caller.name
        use, box, is_metered = Use(size_bytes, len(cells)), _box_of(cells), caller != UPSTREAM
        reach = self._check_commit(row, use, author, box)
        day = self._take(robot, use, commits=1) if is_metered else 0

        def charge(more: Use) -> None:
            if is_metered:
                self._take(robot, more, commits=0)

        spending = Spending(use, charge)
        try:
            yield spending
        finally:
            if spending.is_kept and reach is not None and box is not None:
                reach.widen(box)
            if is_metered and not spending.is_kept:
                self.accounts.give_back(robot, spending.use, day=day, commits=1)

    def _check_commit(self, row: MapRow, use: Use, author: str, box: Box | None) -> "_Reach | None":
        """Refuse what no waiting mends; the reach of the author's cells, if the commit may widen it."""
        most = self._quotas.cells_per_commit
        if most is not None and use.cells > most:
            raise BadInputError("beyond_quota", f"a commit may touch {most} cells here, this one touches {use.cells}")
        most_m = self._quotas.map_extent_m
        if most_m is None or box is None:
            return None
        with self._lock:
            reach = self._reaches.setdefault((row.number, author), _Reach(is_shared=self._is_shared))

        def regions() -> Box | None:
            return _box_of_regions(self._store.shares.regions(row, author))

        edges_m = row.geometry.cell_edges_m
        wide_m = reach.edge_m(box, edges_m, within_m=most_m, read=regions, steady_s=self._steady_s)
        if wide_m > most_m:
            raise BadInputError(
                "beyond_quota",
                f"with this commit all cells of {author} in map {row.name} would span {wide_m:.0f} m, and they may "
                f"span {most_m:.0f} m: is the robot where it believes to be? If it was not before, an operator can "
                "retract what lies too far away",
            )
        return reach

    def _take(self, robot: Robot, use: Use, *, commits: int) -> int:
        """Take use of the day, and commits of the minute; the day.

        Raises:
            UnreachableError: kind `quota`; nothing is taken.
        """
        answer = self.accounts.take(robot, use, self._bounds, commits=commits)
        used, quotas = answer.of_day, self._quotas
        until_midnight_s = (answer.day + 1) * DAY_S - self._wall_s()
        for what, setting, spent, most in (
            ("bytes", "bytes_per_day", used.size_bytes, quotas.bytes_per_day),
            ("cells", "cells_per_day", used.cells, quotas.cells_per_day),
            ("bricks beyond one for each byte", "bricks_per_day", used.bricks, quotas.bricks_per_day),
        ):
            if most is not None and spent > most:
                raise _quota(
                    f"{robot[1]} may push {most} {what} a day (UTC), this makes {spent}; push it again after midnight, "
                    f"or have an administrator raise quotas.{setting}",
                    until_midnight_s,
                )
        if answer.wait_s:
            raise _quota(f"{robot[1]} may push {quotas.commits_per_minute} commits a minute", answer.wait_s)
        return answer.day


class Spending:
    """One commit's use of the quotas, taken for as long as it is checked and written."""

    def __init__(self, use: Use, charge: Callable[[Use], None]) -> None:
        """`charge` takes more of what `use` was taken from, or refuses."""
        self.use = use
        self.is_kept = False
        self._charge = charge

    def charge_bricks(self, bricks: int) -> None:
        """Take the bricks that the commit touches and its bytes do not pay for.

        Raises:
            UnreachableError: kind `quota`.
        """
        more = Use(bricks=unpaid_bricks(bricks, size_bytes=self.use.size_bytes))
        if more.bricks:
            self._charge(more)
            self.use += more

    def keep(self) -> None:
        """Keep it taken after the `with`: the commit was accepted as new."""
        self.is_kept = True


def _charge_nothing(_: Use) -> None:
    """Quotas of an admin."""


class _Reach:
    """Box of the cells in which one robot has evidence, folded or not; thread-safe."""

    def __init__(self, *, is_shared: bool) -> None:
        """`is_shared`: other servers of the store may accept commits of this robot, too."""
        self._is_shared = is_shared
        self._lock = threading.Lock()
        self._box: Box | None = None
        self._next_s = -math.inf
        """Steady time before which the box is not read again."""

    def edge_m(
        self,
        box: Box,
        edges_m: Edges,
        *,
        within_m: float,
        read: Callable[[], Box | None],
        steady_s: Callable[[], float],
    ) -> float:
        """Longest edge of the robot's box and another one together, metres; read again if it exceeds `within_m`."""
        with self._lock:
            is_known = self._next_s > -math.inf
            both = _widened(self._box, box)
            begun_s = steady_s()
            if not is_known or (_edge_m(both, edges_m) > within_m and begun_s >= self._next_s):
                self._box = read()
                self._next_s = begun_s + max(BOX_EVERY_S, BOX_PAUSE_FACTOR * (steady_s() - begun_s))
            elif self._is_shared and both != self._box and _edge_m(both, edges_m) <= within_m:
                # A robot is seldom at its border: what another server accepted there is read for each commit there.
                found = read()
                self._box = _widened(self._box, found) if found is not None else self._box
            return _edge_m(_widened(self._box, box), edges_m)

    def widen(self, box: Box) -> None:
        """Note that the robot has evidence in this box, too."""
        with self._lock:
            self._box = _widened(self._box, box)


def _widened(known: Box | None, box: Box) -> Box:
    if known is None:
        return box
    return _corner(np.minimum(known[0], box[0])), _corner(np.maximum(known[1], box[1]))


def _box_of(cells: Collection[CellKey]) -> Box | None:
    if not cells:
        return None
    found = deinterleave(np.fromiter(cells, np.uint64, len(cells))) - CELL_LIMIT
    return _corner(found.min(axis=0)), _corner(found.max(axis=0))


def _box_of_regions(regions: Collection[int]) -> Box | None:
    """Box that all cells of a robot reach, by a side of a region less than they may: it is no reason to refuse one."""
    box = _box_of([CellKey(region << REGION_BITS) for region in regions])
    if box is None:
        return None
    low, high = box
    last = (1 << REGION_BITS // 3) - 1
    return (low[0] + last, low[1] + last, low[2] + last), high


def _corner(values: np.ndarray[tuple[int, ...], np.dtype[np.int64]]) -> Corner:
    i, j, k = values.tolist()
    return i, j, k


def _edge_m(box: Box, edges_m: Edges) -> float:
    """Longest edge of a box of cells with these edges, metres."""
    return max((high - low + 1) * edge_m for low, high, edge_m in zip(*box, edges_m, strict=True))


def _quota(message: str, wait_s: float) -> UnreachableError:
    return UnreachableError("quota", message, retry_after_s=max(1.0, math.ceil(wait_s)))
