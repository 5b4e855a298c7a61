"""Lists of cells as arrays: they say what the messages said, in a tenth of the memory."""

import tracemalloc
from collections.abc import Iterator
from typing import Any

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given
from tests.fixtures.client.made import cursor, header

from cairn_client.cli.maps.map_sides import SIDE_CELL, MapSide, difference
from cairn_client.sync.indexed_cells import ENTRY, IndexedCells, listed_page
from cairn_client.sync.requests import GetIndex, hold, whole_index
from cairn_map.errors import BadInputError
from cairn_map.evidence.grid import CELL_LIMIT, CellKey, Geometry, cell_key, cell_keys, cell_of_key, cells_of_keys
from cairn_map.wire.messages import INDEX_PAGE, CellEntry, CellIndex

COUNT = st.integers(0, (1 << 53) - 1)
AXIS = st.integers(-CELL_LIMIT, CELL_LIMIT - 1)
ENTRIES = st.builds(
    CellEntry,
    cell=st.tuples(AXIS, AXIS, AXIS),
    size_bytes=COUNT,
    digest=st.binary(min_size=32, max_size=32).map(bytes.hex),
    lm=COUNT,
    fingerprint=st.binary(min_size=16, max_size=16).map(bytes.hex),
    voxels=COUNT,
    hottest_k=st.none() | st.floats(allow_nan=False),
    held_lm=st.none() | COUNT,
)


def entry_of(key: int, *, mark: int = 0) -> CellEntry:
    cell, text = cell_of_key(key), f"{mark:032x}"
    return CellEntry(cell=cell, size_bytes=86, digest=text * 2, lm=0, fingerprint=text, voxels=1)


@given(st.lists(ENTRIES, max_size=5, unique_by=lambda entry: entry.cell))
def test_cells_come_out_of_a_list_as_they_came(entries: list[CellEntry]) -> None:
    entries.sort(key=lambda entry: cell_key(entry.cell))
    listed = IndexedCells(listed_page(entries))
    assert list(listed) == entries
    assert [listed.find(cell_key(entry.cell)) for entry in entries] == entries
    assert listed.cells.tolist() == [list(entry.cell) for entry in entries]
    assert cell_keys([entry.cell for entry in entries]).tolist() == listed.table["key"].tolist()
    assert cells_of_keys(listed.table["key"]).tolist() == [list(entry.cell) for entry in entries]
    absent = next(key for key in range(len(entries) + 1) if key not in listed.table["key"])
    assert listed.find(CellKey(absent)) is None


def test_a_cell_beyond_the_numbered_space_is_refused() -> None:
    for number in (CELL_LIMIT, -CELL_LIMIT - 1, 1 << 70):
        with pytest.raises(BadInputError):
            listed_page([entry_of(0).model_copy(update={"cell": (0, 0, number)})])


def test_an_index_takes_a_hundred_bytes_for_a_cell_and_not_the_messages_kilobyte() -> None:
    pages = 12
    stored = [entry_of(key) for key in range(INDEX_PAGE)]

    def answer(ask: Any) -> CellIndex:
        assert isinstance(ask, GetIndex)
        first = 0 if ask.after is None else cell_key(ask.after) + 1
        count = INDEX_PAGE if first < (pages - 1) * INDEX_PAGE else 1
        cells = cells_of_keys(np.arange(first, first + count)).tolist()
        entries = [entry.model_copy(update={"cell": tuple(cell)}) for entry, cell in zip(stored, cells, strict=False)]
        return CellIndex.model_construct(header=header(cursor(1)), cells=entries)

    tracemalloc.start()
    try:
        index = hold(whole_index(), answer)
        held, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert len(index.cells) == (pages - 1) * INDEX_PAGE + 1
    assert held < (ENTRY.itemsize + 10) * len(index.cells) + (1 << 20)
    assert peak < 3 * ENTRY.itemsize * len(index.cells) + (1 << 22)


def sides() -> Iterator[tuple[set[int], dict[int, int]]]:
    for n in range(30):
        rng = np.random.default_rng(n)
        yield set(rng.integers(0, 12, 8).tolist()), {key: int(rng.integers(0, 2)) for key in rng.integers(0, 12, 8)}


def test_two_sides_differ_in_what_one_lacks_or_has_other_content_of() -> None:
    def side(content: dict[int, int]) -> MapSide:
        listed = listed_page([entry_of(key, mark=mark) for key, mark in sorted(content.items())])
        cells = np.zeros(len(listed), SIDE_CELL)
        for name in SIDE_CELL.names or ():
            cells[name] = listed[name]
        return MapSide("x", Geometry(), cells, None)

    for plain, marked in sides():
        a, b = dict.fromkeys(plain, 0), marked
        found = difference(side(a), side(b))
        assert found.only_a == sorted(a.keys() - b.keys())
        assert found.only_b == sorted(b.keys() - a.keys())
        assert found.other == sorted(key for key in a.keys() & b.keys() if a[key] != b[key])
        assert found.is_equal == (a == b)
        assert (side(a).voxels, side(b).size_bytes) == (len(a), 86 * len(b))
