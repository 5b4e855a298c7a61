"""The cell index in pages, from a real server whose map may change between two of them."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.fixtures.client.live_server import LiveServer
from tests.fixtures.client.made import MAP, cells_of, cursor, header, seen
from tests.fixtures.client.team import Team

from cairn_client.http import api as api_module
from cairn_client.http.api import MapApi
from cairn_client.http.http_link import Link, index_of
from cairn_client.sync import requests as index_module
from cairn_client.sync.requests import Box, whole_index
from cairn_client.sync.sync import fetch_cells
from cairn_map.commits.ids import Author
from cairn_map.errors import UnreachableError
from cairn_map.evidence.grid import Cell, CellKey, cell_key, cell_of_key
from cairn_map.wire.messages import CellEntry, CellIndex, ReplyHeader, Retract

PAGE = 2
KEYS = sorted(cell_key((i, 0, 0)) for i in range(-3, 4))
FIRST, LAST = KEYS[0], KEYS[-1]


@pytest.fixture
def team(server: LiveServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Team]:
    """A map of seven cells whose index comes in pages of two."""
    for module in (api_module, index_module):
        monkeypatch.setattr(module, "INDEX_PAGE", PAGE)
    team = Team(server, tmp_path)
    team["mole"].commit({key: seen(1, 2, kelvin_steps=3) for key in KEYS})
    team.push("mole")
    yield team
    team.close()


class Between(MapApi):
    """Before a page it lets something happen."""

    def __init__(self, team: Team, changed: list[CellKey], *, page: int) -> None:
        super().__init__(team.server.url)
        self._team, self._changed, self._page = team, changed, page
        self.pages = 0

    def cell_index(
        self,
        name: str,
        author: Author | None = None,
        *,
        box: Box | None = None,
        after: Cell | None = None,
        held: ReplyHeader | None = None,
    ) -> CellIndex:
        if self.pages == self._page:
            self._team["mole"].commit({key: seen(9) for key in self._changed})
            self._team.push("mole")
        self.pages += 1
        found = super().cell_index(name, author, box=box, after=after, held=held)
        assert len(found.cells) <= PAGE
        return found


def test_all_pages_together_are_the_index(team: Team) -> None:
    with Between(team, [], page=-1) as api:
        assert [cell_key(entry.cell) for entry in index_of(api, MAP).cells] == KEYS
        assert api.pages == 4
        assert [
            entry.cell
            for entry in Link(api, MAP, branch="fox").hold(whole_index(box=(Cell(-1, 0, 0), Cell(1, 0, 0)))).cells
        ] == [
            (-1, 0, 0),
            (0, 0, 0),
            (1, 0, 0),
        ]


@pytest.mark.slow
@pytest.mark.parametrize(("page", "changed"), [(1, [FIRST]), (1, [LAST]), (3, KEYS)])
def test_a_map_that_changes_between_two_pages_is_fetched_as_it_is(
    team: Team, page: int, changed: list[CellKey]
) -> None:
    fox, plain = team["fox"], team.robots["fox"][1]
    Link(plain, MAP, branch="fox").hold(fetch_cells(fox))
    with Between(team, changed, page=page) as api:
        api.token = plain.token
        Link(api, MAP, branch="fox").hold(fetch_cells(fox))
        listed = {entry.cell: entry for entry in index_of(plain, MAP).cells}
    for entry in listed.values():  # a cell that stands at a cursor is the cell of that cursor
        base = fox.cells[cell_key(entry.cell)]
        assert base.cursor is not None
        assert base.etag == f'"{entry.digest}"' or base.cursor.seq < entry.lm
    Link(plain, MAP, branch="fox").hold(fetch_cells(fox))
    assert cells_of(fox.view) == cells_of(team["mole"].view)


@pytest.mark.slow
def test_a_cell_that_became_again_what_it_was_stands_where_it_became_so(team: Team) -> None:
    fox, plain = team["fox"], team.robots["fox"][1]
    Link(plain, MAP, branch="fox").hold(fetch_cells(fox))
    wrong = team["mole"].commit({LAST: seen(9)})
    team.push("mole")

    class Retracted(Between):
        def cell_index(
            self,
            name: str,
            author: Author | None = None,
            *,
            box: Box | None = None,
            after: Cell | None = None,
            held: ReplyHeader | None = None,
        ) -> CellIndex:
            if self.pages == 1:
                self.retract(name, Retract(commits=[str(wrong.id)]))
                team.server.wait_for_fold()
            return super().cell_index(name, author, box=box, after=after, held=held)

    with Retracted(team, [], page=-1) as api:
        api.token = None
        Link(api, MAP, branch="fox").hold(fetch_cells(fox))
    with MapApi(team.server.url) as api:
        [entry] = [entry for entry in index_of(api, MAP).cells if cell_key(entry.cell) == LAST]
    assert fox.cells[LAST].etag == f'"{entry.digest}"'
    cursor_of_last = fox.cells[LAST].cursor
    assert cursor_of_last is not None
    assert cursor_of_last.seq >= entry.lm


class Replaced:
    """A server that was restored between two pages."""

    def cell_index(
        self,
        name: str,
        author: Author | None = None,
        *,
        box: Box | None = None,
        after: Cell | None = None,
        held: ReplyHeader | None = None,
    ) -> CellIndex:
        cells = [
            CellEntry(cell=cell_of_key(key), size_bytes=1, digest="0" * 64, lm=1, fingerprint="0" * 32, voxels=1)
            for key in range(PAGE)
        ]
        return CellIndex(header=header(cursor(3 if after else 5)), cells=cells)


def test_a_server_that_was_restored_between_two_pages_is_asked_again_later(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(index_module, "INDEX_PAGE", PAGE)
    with pytest.raises(UnreachableError, match="replaced"):
        index_of(Replaced(), MAP)  # type: ignore[arg-type]
