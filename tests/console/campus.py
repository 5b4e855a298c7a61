"""Maps of one building's cells again and again: side by side, a campus, or one over the other, a tower."""

from collections.abc import Sequence
from itertools import count, islice, product

from tests.fixtures.server.live import until
from tests.fixtures.server.pushes import MOLE, pushed

from cairn_client.cli.maps.map_export import fetch_map
from cairn_client.http.api import MapApi
from cairn_map.evidence.brick_cell import sum_evidence
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.grid import CellKey, cell_key, cell_of_key
from cairn_map.wire.messages import CreateMap

CELLS_A_COMMIT = 60
SCANS = 4000
"""Enough for the counts of any building."""
Step = tuple[int, int, int]
"""Cells by which a copy lies elsewhere."""


def make_campus(api: MapApi, building: str, name: str, *, cells: int) -> None:
    """Make a map of copies of a building, a cell apart, until it has so many cells."""
    info = api.map_info(building)
    places = [cell_of_key(cell.key) for _, cell in fetch_map(api, info)]
    wide, deep = (max(each[axis] for each in places) - min(each[axis] for each in places) + 2 for axis in (0, 1))
    copies = -(-cells // len(places))
    side = next(side for side in count(1) if side * side >= copies)
    steps = [(right * wide, back * deep, 0) for right, back in product(range(side), repeat=2)]
    make_copies(api, building, name, steps=steps[:copies])


def make_copies(api: MapApi, building: str, name: str, *, steps: Sequence[Step]) -> None:
    """Make a map of copies of a building, each so many cells away from it; return when all of it is folded."""
    info = api.map_info(building)
    geometry = info.geometry
    api.create_map(name, CreateMap(geometry=geometry))
    cells: dict[CellKey, Evidence] = {}
    for _, cell in fetch_map(api, info):
        place, total = cell_of_key(cell.key), cell.history.total(geometry)
        for step in steps:
            i, j, k = (a + b for a, b in zip(place, step, strict=True))
            key = cell_key((i, j, k))
            cells[key] = sum_evidence([cells[key], total], geometry) if key in cells else total
    commits = range(-(-len(cells) // CELLS_A_COMMIT))
    for n in commits:
        part = dict(islice(cells.items(), n * CELLS_A_COMMIT, (n + 1) * CELLS_A_COMMIT))
        api.push(name, pushed(n, 0, MOLE, geometry=geometry, cells=part, scans=SCANS))
    until(lambda: len(api.log(name)) == len(commits), "all copies are folded")
