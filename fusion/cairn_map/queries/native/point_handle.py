"""Point handle: a snapshot as a number, and functions that C, C++ and Numba call with it for states at points.

    with PointHandle(robot.snapshot()) as handle:
        planner.plan(handle.state_address, handle.map)          # C: state(map, x, y, z), see `cairn_points.h`

A call takes some tens of nanoseconds, where one of `snapshot.state_at` takes microseconds, however few its points. The
handle keeps the states of the snapshot in memory until it is closed, or is no longer referred to. Then calls with its
number are refused: it holds an address that is never freed, and a generation that never returns (docs/decisions/048).
"""

import os
import time
import weakref
from collections import deque
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from cairn_map.errors import BadInputError
from cairn_map.queries.frozen_map import FrozenMap
from cairn_map.queries.layers.layered_snapshot import LayeredSnapshot
from cairn_map.queries.map_snapshot import MapSnapshot
from cairn_map.queries.native import handle_kernels as kernels
from cairn_map.queries.occupancy_kernels import Grid

Slot = npt.NDArray[np.uint64]
"""(8,) words of one slot, at an address that is a multiple of 64."""
SLOT_WORDS = (1 << kernels.SLOT_BITS) // 8
SLOTS_MADE = 64
"""Slots that are made at a time: 4 KiB."""
GENERATIONS = 1 << kernels.GENERATION_BITS


class _Slots:
    """The slots of this process, which stay where they are until it ends, and the generation of each.

    There is no lock: a finalizer, which gives a slot back, runs wherever Python collects garbage, so in the middle of
    `take`, too, in the thread that would hold the lock. Appending to a deque and popping from it are atomic.
    """

    def __init__(self) -> None:
        self._all: list[Slot] = []
        self._free: deque[tuple[Slot, int]] = deque()

    def take(self) -> tuple[Slot, int]:
        """A slot that is closed, and its next generation."""
        while True:
            try:
                return self._free.pop()
            except IndexError:
                words = np.zeros((SLOTS_MADE + 1) * SLOT_WORDS, np.uint64)
                first = -(words.ctypes.data // words.itemsize) % SLOT_WORDS
                self._all.append(words)
                made = words[first:][: SLOTS_MADE * SLOT_WORDS].reshape(SLOTS_MADE, SLOT_WORDS)
                self._free.extend((slot, 1) for slot in made)

    def give_back(self, slot: Slot, generation: int) -> None:
        """Take a slot back that no call is in; after its last generation it is not used again."""
        if generation + 1 < GENERATIONS:
            self._free.append((slot, generation + 1))


_SLOTS = _Slots()


class PointHandle:
    """States of one snapshot's voxels for compiled code, until it is closed."""

    VERSION = 1
    """`CAIRN_POINTS_VERSION` of the header that these functions have."""
    HEADER = Path(__file__).with_name("cairn_points.h")
    """The header that programs in C and C++ include."""

    def __init__(self, snapshot: MapSnapshot | LayeredSnapshot) -> None:
        """Open a handle on a snapshot, or on the layers of one, of which the finest that knows a point answers."""
        layers = [snapshot] if isinstance(snapshot, MapSnapshot) else [snapshot[name] for name in snapshot.names]
        grids = [layer.frozen.grid for layer in layers]
        rows = np.stack([_row(layer.frozen) for layer in layers])
        slot, generation = _SLOTS.take()
        slot[kernels.LAYERS], slot[kernels.ROWS] = len(rows), rows.ctypes.data
        address: int = slot.ctypes.data
        self._map = (address >> kernels.SLOT_BITS) << kernels.GENERATION_BITS | generation
        kernels.open_slot(address, np.uint64(self._map))
        # The finalizer refers to the arrays, so they live until it has run; at exit, too, before Python frees anything.
        self._close = weakref.finalize(self, _close, slot, generation, os.getpid(), (rows, grids))

    def __repr__(self) -> str:
        return f"PointHandle({'open' if self.is_open else 'closed'})"

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @property
    def is_open(self) -> bool:
        """True until the handle is closed."""
        return self._close.alive

    @property
    def map(self) -> int:
        """Number of the map, 64 bits without sign, the first argument of each function.

        Raises:
            BadInputError: kind `handle_closed`.
        """
        if not self.is_open:
            raise BadInputError("handle_closed", "the handle is closed, and its number answers no more")
        return self._map

    @property
    def state_address(self) -> int:
        """Address of the function `cairn_state` of the header: the state at one point."""
        return int(kernels.state_function().address)

    @property
    def states_address(self) -> int:
        """Address of the function `cairn_states` of the header: the states at many points, in one call."""
        return int(kernels.states_function().address)

    @property
    def state(self) -> Callable[[int, float, float, float], int]:
        """`cairn_state` as an object of ctypes, which functions compiled by Numba call, too."""
        function: Callable[[int, float, float, float], int] = kernels.state_function().ctypes
        return function

    def close(self) -> None:
        """Close the handle, and wait for calls in progress; a second time does nothing."""
        self._close()


def _close(slot: Slot, generation: int, process: int, held: tuple[npt.NDArray[np.uint64], list[Grid]]) -> None:
    """Close a slot; the arrays in `held` are needed until then."""
    # In a forked process the calls of other threads do not go on, and are counted for ever: such a slot is left alone.
    while not (is_left := kernels.close_slot(slot.ctypes.data)) and process == os.getpid():
        time.sleep(0)
    if is_left:
        _SLOTS.give_back(slot, generation)


def _row(frozen: FrozenMap) -> npt.NDArray[np.uint64]:
    """(ROW,) words of one layer."""
    geometry, grid = frozen.geometry, frozen.grid
    row = np.zeros(kernels.ROW, np.uint64)
    row[kernels.EDGE_NM], row[kernels.DEPTH] = grid.edge_nm, grid.depth
    row[kernels.HASH_SIZE], row[kernels.HASH_SHIFT] = len(grid.numbers), grid.hash_shift
    row[kernels.CELLS], row[kernels.BRICKS_EACH] = grid.bricks.shape
    row[kernels.BRICKS] = len(grid.words)
    reals = row.view(np.float64)
    reals[kernels.STRETCH] = geometry.voxel_edge_um / geometry.voxel_height_um
    reals[kernels.REACH] = frozen.reach_m
    arrays: dict[int, npt.NDArray[Any]] = {
        kernels.NUMBERS_AT: grid.numbers,
        kernels.SLOTS_AT: grid.slots,
        kernels.BRICKS_AT: grid.bricks,
        kernels.WORDS_AT: grid.words,
    }
    for word, array in arrays.items():
        if not array.flags.c_contiguous:
            raise AssertionError("the arrays of a grid are contiguous")
        row[word] = array.ctypes.data
    return row
