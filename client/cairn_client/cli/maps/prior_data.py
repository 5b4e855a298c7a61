"""A map that starts from prior data: a folder of cells or another map, as the first commits, author `initial`.

They are commits like any other: every robot gets them by ordinary sync, and a retract takes them out again.
"""

import hashlib
from collections.abc import Iterable, Iterator
from pathlib import Path

from cairn_client.cli.arguments import api_of
from cairn_client.cli.maps.map_export import fetch_map
from cairn_client.http.api import MapApi
from cairn_map.codec.cell_code import DecodedCell
from cairn_map.commits.commit import Commit, CommitMeta, make_commit
from cairn_map.commits.ids import INITIAL, Author, CommitId, Incarnation
from cairn_map.evidence.grid import Geometry
from cairn_map.files.cell_folder import FolderHead, read_cells, read_head
from cairn_map.wire.messages import CreateMap, MapInfo

CELLS_A_COMMIT = 16
"""So many cells of prior data go into one commit: it stays far below a commit's largest size."""


def push_prior_data(api: MapApi, name: str, source: str, *, token: str | None) -> tuple[MapInfo, int, int]:
    """Create a map with the grid and the evidence of a folder or another map; returns it, the
    count of cells, and how many of them were added.

    It may be repeated after a cut link: evidence that is there already is not added again.

    Raises:
        BadInputError: the source is neither a folder of cells nor a map's URL.
        ConflictError: the map exists with another grid.
    """
    head, cells = _open(source, token)
    api.create_map(name, CreateMap(geometry=head.geometry, sensor_model=head.sensor_model))
    count = added = 0
    author: Author | None = None
    for n, group in enumerate(_groups(cells)):
        author = author or Author(INITIAL, _incarnation(group))
        pushed = api.push(name, _commit(CommitId(author, n), group, head.geometry))
        count += len(group)
        added += len(group) if pushed.state == "new" else 0
    return api.map_info(name), count, added


def _open(source: str, token: str | None) -> tuple[FolderHead, Iterable[DecodedCell]]:
    if "://" not in source:
        head = read_head(Path(source))
        return head, read_cells(Path(source), head.geometry)
    api, name = api_of(source, token)
    info = api.map_info(name)
    return FolderHead(geometry=info.geometry, sensor_model=info.sensor_model), _fetched(api, name)


def _fetched(api: MapApi, name: str) -> Iterator[DecodedCell]:
    with api:
        for _, cell in fetch_map(api, name):
            yield cell


def _groups(cells: Iterable[DecodedCell]) -> Iterator[list[DecodedCell]]:
    group: list[DecodedCell] = []
    for cell in cells:
        if len(cell.evidence):
            group.append(cell)
        if len(group) == CELLS_A_COMMIT:
            yield group
            group = []
    if group:
        yield group


def _incarnation(cells: list[DecodedCell]) -> Incarnation:
    """An incarnation that follows from the first commit's evidence, so that doing it again adds nothing."""
    return Incarnation(hashlib.sha256(b"".join(cell.digest for cell in cells)).hexdigest()[:16])


def _commit(commit: CommitId, cells: list[DecodedCell], geometry: Geometry) -> Commit:
    meta = CommitMeta(id=str(commit), geometry=geometry.digest().hex(), note="prior data")
    return make_commit(meta, {cell.key: cell.evidence for cell in cells}, geometry)
