"""Request to fetch-missing as it is worked with: the cells that it lists as arrays.

A request may list 100 000 cells. As objects of Python they take 0.1 s to parse, and as long again for each sweep of the
garbage collector; no other thread runs meanwhile. So a long request is parsed and made into arrays in another process
(`http.routes.long_bodies`), and nothing but arrays comes back. They stay arrays until they are answered.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cairn_map.commits.cursor import Cursor
from cairn_map.errors import BadInputError
from cairn_map.evidence.grid import cell_keys
from cairn_map.kernels.morton_kernels import UInts
from cairn_map.wire.messages import CURSORS_MAX, MissingRequest


@dataclass(frozen=True, slots=True, eq=False)
class Asked:
    """One request, and the cells that it lists."""

    request: MissingRequest
    """All but the lists of cells, which are empty here."""
    keys: UInts
    """Numbers of the cells listed, shape (n,), none twice."""
    states: npt.NDArray[np.int64]
    """Index in `cursors` of each of these cells, shape (n,)."""
    cursors: tuple[str | None, ...]
    """States at which the cells stand; None: the asker holds nothing of them."""


@dataclass(frozen=True, slots=True, eq=False)
class ListedCells:
    """Cells that a request lists, each at its own state."""

    keys: UInts
    """Numbers of the cells, shape (n,), as the request lists them."""
    states: npt.NDArray[np.int64]
    """Index in `cursors` of the state of each, shape (n,)."""
    cursors: tuple[Cursor | None, ...]
    rising: npt.NDArray[np.int64]
    """Index of each cell in the order of the numbers, shape (n,)."""

    def places(self, keys: UInts) -> npt.NDArray[np.int64]:
        """Index here of each of these cells, shape (len(keys),); -1 where it is not listed."""
        if not len(self.keys):
            return np.full(len(keys), -1)
        above = np.searchsorted(self.keys, keys, sorter=self.rising)
        found = self.rising[np.minimum(above, len(self.keys) - 1)]
        return np.where(self.keys[found] == keys, found, -1)

    def cursor(self, place: int) -> Cursor | None:
        """State of the cell of this index."""
        return self.cursors[int(self.states[place])]

    def by_cursor(self, chosen: npt.NDArray[np.bool_]) -> Iterator[tuple[Cursor | None, UInts]]:
        """Each state with those of the chosen cells that stand at it, where there are any."""
        # Sorted once: a request may name as many states as cells, and a look at all cells for each took a minute.
        places = np.flatnonzero(chosen)
        places = places[np.argsort(self.states[places], kind="stable")]
        firsts = np.flatnonzero(np.diff(self.states[places], prepend=-1))
        for group in np.split(places, firsts[1:]) if len(places) else ():
            yield self.cursor(int(group[0])), self.keys[group]


def listed_cells(asked: Asked, cursors: tuple[Cursor | None, ...]) -> ListedCells:
    """Cells of a request, with its cursors parsed."""
    return ListedCells(asked.keys, asked.states, cursors, np.argsort(asked.keys))


def asked_of(request: MissingRequest) -> Asked:
    """Request with its lists as arrays.

    Raises:
        BadInputError: kind `bad_message`: too many cells are listed, or one twice, or one outside all maps.
    """
    groups = [*request.groups, *((entry.cursor, [entry.cell]) for entry in request.cells)]
    sizes = [len(cells) for _, cells in groups]
    # Counted before any number is computed.
    if sum(sizes) > CURSORS_MAX:
        raise BadInputError("bad_message", f"{sum(sizes)} cells are listed, at most {CURSORS_MAX} may be")
    keys = cell_keys([cell for _, cells in groups for cell in cells])
    # A cell under two cursors would have no right answer.
    if len(np.unique(keys)) != len(keys):
        raise BadInputError("bad_message", "a cell is named twice in the request")
    places = {cursor: n for n, cursor in enumerate(dict.fromkeys(cursor for cursor, _ in groups))}
    states = np.repeat(np.array([places[cursor] for cursor, _ in groups], np.int64), sizes)
    return Asked(request.model_copy(update={"groups": [], "cells": []}), keys, states, tuple(places))
