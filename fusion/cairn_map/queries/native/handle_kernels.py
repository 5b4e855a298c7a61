"""Functions with C's calling convention that look up states at points, in a map that is given as a number.

    number   bits 22 to 63: address of a slot / 64; bits 0 to 21: the slot's generation
    slot     64 bytes that are never freed: calls in progress, the number while open, layers, address of their rows
    row      of one layer: its `Grid` as addresses and lengths; the rows of a map are the finest layer's first

A call counts itself in, then compares its number with the slot's. Closing takes the slot's number away, then waits
until no call is counted. Both orders are sequentially consistent, so closing waits for each call that found its number
(Dekker's algorithm), and no array is freed while a call reads it.
"""

from collections.abc import Callable
from functools import cache
from typing import Any, cast

import numba as nb
import numpy as np
from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic
from numba.np.numpy_support import carray

from cairn_map.kernels.integer_kernels import U
from cairn_map.queries.occupancy_kernels import NONE, UNKNOWN, Grid, place_of, slot_of, state_in, voxel_of

SLOT_BITS, GENERATION_BITS = 6, 22
"""A slot's address is a multiple of 2^6, its generation less than 2^22; both are one number of 64 bits."""
CALLS, NUMBER, LAYERS, ROWS = range(4)
"""Words of a slot."""
EDGE_NM, DEPTH, HASH_SIZE, HASH_SHIFT, CELLS, BRICKS_EACH, BRICKS, STRETCH, REACH = range(9)
"""Words of a row. STRETCH and REACH are float64: the factor of heights, and the metres within which points lie."""
NUMBERS_AT, SLOTS_AT, BRICKS_AT, WORDS_AT = range(9, 13)
"""Words of a row, too: addresses of arrays of the `Grid`."""
ROW = 13
WORD = U(8)
"""Bytes of a word."""
OUTSIDE, CLOSED = np.int32(-1), np.int32(-2)

as_intrinsic = cast("Callable[[Callable[..., Any]], Any]", intrinsic)
"""Numba's decorator, without its types, which count the context as an argument."""


@as_intrinsic
def add_at(typing: Any, address: Any, step: Any) -> Any:
    """Add to the word at an address, atomically; returns what was there."""

    def build(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.atomic_rmw("add", _word(builder, args[0]), args[1], "seq_cst")

    return types.uint64(types.uint64, types.uint64), build


@as_intrinsic
def exchange_at(typing: Any, address: Any, value: Any) -> Any:
    """Replace the word at an address, atomically; returns what was there."""

    def build(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.atomic_rmw("xchg", _word(builder, args[0]), args[1], "seq_cst")

    return types.uint64(types.uint64, types.uint64), build


@as_intrinsic
def load_at(typing: Any, address: Any) -> Any:
    """The word at an address, atomically."""

    def build(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.load_atomic(_word(builder, args[0]), "seq_cst", 8)

    return types.uint64(types.uint64), build


@as_intrinsic
def pointer_to(typing: Any, address: Any, kind: Any) -> Any:
    """An address as a pointer to numbers of a kind, such as `nb.int32`."""
    pointer = types.CPointer(kind.dtype)  # type: ignore[no-untyped-call]

    def build(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.inttoptr(args[0], context.get_value_type(pointer))

    return pointer(types.uint64, kind), build


@nb.njit(nogil=True, forceinline=True)
def _array(address: np.uint64, kind: Any, shape: Any) -> Any:
    """The numbers at an address as an array."""
    return carray(pointer_to(address, kind), shape)


def _word(builder: Any, address: Any) -> Any:
    return builder.inttoptr(address, ir.IntType(64).as_pointer())


@nb.njit(nogil=True, forceinline=True)
def _begin(number: np.uint64) -> np.uint64:
    """Slot of a map for one call, counted in; 0 if it is closed, and then not counted."""
    # The number without its generation, as an address; 0 is what a caller has that was given nothing.
    slot = (number >> U(GENERATION_BITS)) << U(SLOT_BITS)
    if slot == 0:
        return U(0)
    # Counted before it is compared: the other way round the arrays could be freed between the two.
    add_at(slot, U(1))
    if load_at(slot + U(NUMBER) * WORD) != number:
        _end(slot)
        return U(0)
    return slot


@nb.njit(nogil=True, forceinline=True)
def _end(slot: np.uint64) -> None:
    # Less one, without a sign: reads that come before it are done before closing sees the counter.
    add_at(slot, U(0xFFFFFFFFFFFFFFFF))


@nb.njit(nogil=True, forceinline=True)
def _state(slot: np.uint64, x_m: float, y_m: float, z_m: float) -> np.int32:
    """State at a point, of the finest layer that knows it; OUTSIDE if the point is outside of any layer's space."""
    # Of the slot, which does not change while this call is counted.
    words = _array(slot, nb.uint64, 8)
    count, found = words[LAYERS], np.int32(UNKNOWN)
    for layer in range(count):
        # The row of one layer, its words read as the types that they are.
        row = words[ROWS] + U(layer) * U(ROW) * WORD
        integers, reals = _array(row, nb.int64, ROW), _array(row, nb.float64, ROW)
        addresses = _array(row, nb.uint64, ROW)
        # As `FrozenMap.on_lattice`: flat voxels are looked up as cubes.
        height_m, reach_m = z_m * reals[STRETCH], reals[REACH]
        # Of NaN each comparison is false.
        if not ((abs(x_m) < reach_m) & (abs(y_m) < reach_m) & (abs(height_m) < reach_m)):
            return OUTSIDE
        # Layers behind the one that answers only say whether the point is outside, as `LayeredSnapshot` asks them all.
        if found != UNKNOWN:
            continue
        # The grid that `states_into` has; its list of cells and their box are not needed for a point.
        none = _array(addresses[NUMBERS_AT], nb.int64, (0, 3))
        grid = Grid(
            integers[EDGE_NM],
            integers[DEPTH],
            _array(addresses[NUMBERS_AT], nb.int64, integers[HASH_SIZE]),
            _array(addresses[SLOTS_AT], nb.int32, integers[HASH_SIZE]),
            integers[HASH_SHIFT],
            none,
            none[:, 0],
            none[:, 0],
            _array(addresses[BRICKS_AT], nb.int32, (integers[CELLS], integers[BRICKS_EACH])),
            _array(addresses[WORDS_AT], nb.uint64, (integers[BRICKS], 8, 2)),
        )
        found = np.int32(_state_in_grid(grid, x_m, y_m, height_m))
    return found


@nb.njit(nogil=True, forceinline=True)
def _state_in_grid(grid: Grid, x_m: float, y_m: float, z_m: float) -> np.uint8:
    # Voxel, cell, brick, bits: the steps of `point_kernels.states_into`, for one point.
    x, y, z = voxel_of(x_m, grid.edge_nm), voxel_of(y_m, grid.edge_nm), voxel_of(z_m, grid.edge_nm)
    slot = slot_of(grid, x >> grid.depth, y >> grid.depth, z >> grid.depth)
    if slot == NONE:
        return UNKNOWN
    place = place_of(x, y, z, (1 << grid.depth) - 1)
    brick = grid.bricks[U(slot), U(place >> 9)]
    return state_in(grid.words, brick, place) if brick >= 0 else UNKNOWN


def _state_at(number: np.uint64, x_m: float, y_m: float, z_m: float) -> np.int32:
    """`cairn_state` of the header."""
    slot = _begin(number)
    if slot == 0:
        return CLOSED
    found = _state(slot, x_m, y_m, z_m)
    _end(slot)
    return found


def _states_at(number: np.uint64, points_m: Any, count: int, states: Any) -> np.int32:
    """`cairn_states` of the header."""
    # Counted once for all points, so that many threads do not wait for each other's counting.
    slot = _begin(number)
    if slot == 0:
        return CLOSED
    worst = np.int32(0)
    for n in range(count):
        state = _state(slot, points_m[3 * n], points_m[3 * n + 1], points_m[3 * n + 2])
        worst = min(worst, state)
        states[n] = state
    _end(slot)
    return worst


@cache
def state_function() -> Any:
    """`cairn_state` of the header as an object of Numba: its address, and itself for ctypes."""
    return nb.cfunc("int32(uint64, float64, float64, float64)", cache=True)(_state_at)


@cache
def states_function() -> Any:
    """`cairn_states` of the header as an object of Numba."""
    return nb.cfunc("int32(uint64, CPointer(float64), int64, CPointer(int8))", cache=True)(_states_at)


@nb.njit(cache=True, nogil=True)
def close_slot(address: int) -> bool:
    """Take a slot's number away; True once no call is in progress. To be called until it is True."""
    # The number first, then the counter: the mirror of `_begin`.
    slot = U(address)
    exchange_at(slot + U(NUMBER) * WORD, U(0))
    return bool(load_at(slot) == U(0))


@nb.njit(cache=True, nogil=True)
def open_slot(address: int, number: np.uint64) -> None:
    """Give a slot, whose other words are written, its number."""
    # Last of all, with everything that was written before: a call that finds the number finds the rows.
    exchange_at(U(address) + U(NUMBER) * WORD, number)
