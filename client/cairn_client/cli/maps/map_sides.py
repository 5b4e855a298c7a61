"""Two maps side by side: the cells and commits that only one of them has, and the cells that differ.

http://HOST:PORT/maps/NAME     a server's map, by its cell index; no cell is downloaded
DIR with robot.sqlite          a copy's or robot's folder: the map that it sees, commits that wait included
DIR with map.json              a folder of cells (`cairn map export --cells`); it knows of no commits
"""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from cairn_client.cli.arguments import api_of
from cairn_client.folders.state_folder import is_state_folder, opened_replica
from cairn_client.http.http_link import index_of
from cairn_client.http.origin_tokens import OriginTokens
from cairn_map.codec.layer_code import encode_layer_cell
from cairn_map.commits.version_vector import EMPTY, VersionVector
from cairn_map.epochs.cell_history import CellHistory, history_fingerprint
from cairn_map.epochs.layer import MapLayer
from cairn_map.errors import BadInputError
from cairn_map.evidence.grid import CellKey
from cairn_map.files.cell_folder import MAP_FILE, read_cells, read_head

SIDE_CELL = np.dtype([("key", np.uint64), ("fingerprint", "V16"), ("voxels", np.int64), ("size_bytes", np.int64)])
"""One cell of one side: its number, what it holds, its known voxels, and its bytes as they are kept."""


@dataclass(frozen=True, slots=True)
class MapSide:
    """One of two maps that are compared."""

    name: str
    layer: MapLayer
    cells: npt.NDArray[np.void]
    """(N,) `SIDE_CELL`, the cells that hold evidence, by rising number: a server may list a million of them."""
    commits: VersionVector | None
    """Commits in the map; None: unknown."""

    @property
    def voxels(self) -> int:
        """Known voxels of all cells."""
        return sum(self.cells["voxels"].tolist())

    @property
    def size_bytes(self) -> int:
        """Bytes of all cells as they are kept."""
        return sum(self.cells["size_bytes"].tolist())


@dataclass(frozen=True, slots=True)
class Difference:
    """Cells and commits that two sides do not have in common."""

    only_a: list[CellKey]
    only_b: list[CellKey]
    other: list[CellKey]
    """Cells in both, with different evidence."""
    commits_only_a: int | None
    """Count; None if one of the sides does not know its commits."""
    commits_only_b: int | None

    @property
    def is_equal(self) -> bool:
        """True if both are the same map: all cells equal, whichever commits made them."""
        return not (self.only_a or self.only_b or self.other)


def side_of(place: str, *, tokens: OriginTokens) -> MapSide:
    """The map at a place.

    Raises:
        BadInputError: it is none of the three kinds.
        CairnError: it cannot be read, or is damaged.
    """
    if "://" in place:
        return _of_server(place, tokens)
    folder = Path(place)
    if is_state_folder(folder):
        return _of_state(folder)
    if (folder / MAP_FILE).is_file():
        return _of_cells(folder)
    raise BadInputError(
        "no_map",
        f"{place} is no map: a URL http://HOST:PORT/maps/NAME, a folder of `cairn clone` or of a robot, or one "
        "of `cairn map export --cells` is expected",
    )


def difference(a: MapSide, b: MapSide) -> Difference:
    """Difference of two sides, by the fingerprints of their cells.

    Raises:
        BadInputError: kind `other_geometry`: their grids differ, so nothing can be compared.
    """
    if a.layer != b.layer:
        raise BadInputError(
            "other_geometry",
            f"{a.name} has {a.layer}, {b.name} has {b.layer}: they cannot be compared",
        )
    of_a, of_b = a.cells["key"], b.cells["key"]
    common, rows_a, rows_b = np.intersect1d(of_a, of_b, assume_unique=True, return_indices=True)
    is_other = a.cells["fingerprint"][rows_a] != b.cells["fingerprint"][rows_b]
    only_a = None if a.commits is None or b.commits is None else len(a.commits.minus(b.commits))
    only_b = None if a.commits is None or b.commits is None else len(b.commits.minus(a.commits))
    return Difference(
        only_a=np.setdiff1d(of_a, of_b, assume_unique=True).tolist(),
        only_b=np.setdiff1d(of_b, of_a, assume_unique=True).tolist(),
        other=common[is_other].tolist(),
        commits_only_a=only_a,
        commits_only_b=only_b,
    )


def _of_server(url: str, tokens: OriginTokens) -> MapSide:
    api, name = api_of(url, tokens)
    with api:
        layer, index = api.map_info(name).layer, index_of(api, name)
    listed = index.cells.table[index.cells.table["voxels"] > 0]
    cells = np.zeros(len(listed), SIDE_CELL)
    for name in SIDE_CELL.names or ():
        cells[name] = listed[name]
    return MapSide(url, layer, cells, index.header.coverage)


def _of_state(folder: Path) -> MapSide:
    with opened_replica(folder) as replica:
        layer, cells = replica.layer, [(key, replica.view.history(key)) for key in replica.view]
        folded = replica.header.coverage if replica.header else EMPTY
        commits = folded.with_commits(replica.commits)
    return MapSide(str(folder), layer, _side_cells(cells, layer), commits)


def _of_cells(folder: Path) -> MapSide:
    layer = read_head(folder).layer
    cells = ((cell.key, cell.history) for cell in read_cells(folder, layer))
    return MapSide(str(folder), layer, _side_cells(cells, layer), None)


def _side_cells(cells: Iterable[tuple[CellKey, CellHistory]], layer: MapLayer) -> npt.NDArray[np.void]:
    """(N,) `SIDE_CELL` of cells that are here, in order of their numbers."""
    rows = [
        (
            key,
            history_fingerprint(history, key, layer_word=layer.word).to_bytes(),
            sum(map(len, history.rows.values())),
            len(encode_layer_cell(key, history, layer).data),
        )
        for key, history in cells
        if len(history)
    ]
    return np.sort(np.array(rows, SIDE_CELL), order="key")
