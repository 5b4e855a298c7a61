"""Maps of levels and of classes: what was retracted, amended or forgotten leaves the bytes of a map without it."""

import pytest
from tests.fixtures.map.classed import CLASSED, classed_evidence
from tests.fixtures.map.made import random_evidence
from tests.fixtures.server.answers import kind_of
from tests.fixtures.server.live import Live
from tests.fixtures.server.pushes import KEYS, MOLE, WREN, pushed

from cairn_map.commits.commit import Commit
from cairn_map.commits.ids import Author
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.grid import Geometry, level_geometry
from cairn_server.store.store_rows import MapRow

LEVEL = level_geometry().model_copy(update={"depth": 3})
EYES = ("a", "b", "c")
"""As many cameras as `classed_evidence` needs for its votes."""


def evidence_of(seed: int, grid: Geometry) -> Evidence:
    return random_evidence(seed, grid) if grid.is_flat else classed_evidence(seed, grid)


def seen(n: int, seed: int, grid: Geometry, author: Author = MOLE, *, instead_of: tuple[Commit, ...] = ()) -> Commit:
    """A commit of two cells."""
    cells = {key: evidence_of(10 * seed + n, grid) for n, key in enumerate(KEYS[:2])}
    return pushed(n, seed, author, geometry=grid, cells=cells, sensors=EYES, retracts=instead_of)


def map_of(live: Live, *commits: Commit, grid: Geometry) -> MapRow:
    row = live.new_map(grid)
    for commit in commits:
        answer = live.push(row, commit)
        assert answer.status_code == 201, answer.text
    live.folded(row)
    return row


@pytest.mark.parametrize("grid", [LEVEL, CLASSED], ids=["level", "classes"])
def test_what_was_taken_out_or_forgotten_leaves_the_map_without_it(live: Live, grid: Geometry) -> None:
    first, second, third = (seen(n, n, grid) for n in range(3))
    other, amend = seen(0, 7, grid, WREN), seen(3, 9, grid, instead_of=(first,))
    row = map_of(live, first, second, third, other, amend, grid=grid)
    assert live.cells(row) == live.cells(map_of(live, second, third, other, amend, grid=grid))
    assert live.retract(row, second).status_code == 201
    left = live.cells(map_of(live, third, other, amend, grid=grid))
    assert live.cells(row) == left
    # The sums stay when the commits' own evidence goes; then none of it can be taken out again.
    assert live.service.store.forget_evidence(row, before_s=float("inf"), limit=99) > 0
    answer = live.retract(row, other)
    assert (answer.status_code, kind_of(answer)) == (409, "evidence_gone")
    assert live.cells(row) == left
    # A robot that still has it pushes it again, and it is taken out as exactly as before it was forgotten.
    assert live.push(row, other).is_success
    assert live.retract(row, other).status_code == 201
    assert live.cells(row) == live.cells(map_of(live, third, amend, grid=grid))
