"""Cells that a request lists, by the states at which they stand."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from cairn_map.commits.cursor import Cursor
from cairn_server.sync.asked_cells import ListedCells

CURSORS = (None, *(Cursor(bytes(16), n, bytes(16)) for n in range(4)))


@given(st.lists(st.tuples(st.integers(0, 99), st.integers(0, 4), st.booleans()), unique_by=lambda cell: cell[0]))
def test_each_state_comes_once_with_its_chosen_cells_in_their_order(cells: list[tuple[int, int, bool]]) -> None:
    keys = np.array([key for key, _, _ in cells], np.uint64)
    states = np.array([state for _, state, _ in cells], np.int64)
    listed = ListedCells(keys, states, CURSORS, np.argsort(keys))
    found = [(cursor, group.tolist()) for cursor, group in listed.by_cursor(np.array([c for *_, c in cells], bool))]
    expected = [
        (cursor, [key for key, state, is_chosen in cells if is_chosen and state == n])
        for n, cursor in enumerate(CURSORS)
    ]
    assert found == [(cursor, group) for cursor, group in expected if group]
