"""Tiles and totals of maps in PostgreSQL: read for requests, written by folds and heals under the head's lock."""

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from cairn_map.evidence.fingerprint import ZERO, Fingerprint, fingerprint_from_bytes
from cairn_map.evidence.grid import CellKey
from cairn_map.kernels.morton_kernels import UInts
from cairn_server.store.postgres.connections import Connection, first, rows
from cairn_server.store.store_rows import CellRow
from cairn_server.store.tiles import (
    TILE_BITS,
    Box,
    Corners,
    TileChanges,
    TileSums,
    corners_of,
    is_in_box,
    is_inside_box,
    tiles_in_box,
    touches_box,
)

CELL_COLUMNS = (
    "cell.cell, cell.lm, digest, cell.fingerprint, voxels, cell.size_bytes, gone_seq, hottest_k, cell.history_bytes"
)
IN_TILES = (
    "unnest(%(tiles)s::bigint[]) AS t (tile) CROSS JOIN LATERAL ("
    " SELECT * FROM cell AS c WHERE c.map = %(map)s AND c.layer = 0"
    f" AND c.cell BETWEEN t.tile << {TILE_BITS} AND (t.tile << {TILE_BITS}) + {(1 << TILE_BITS) - 1}"
    f" ORDER BY c.cell LIMIT {1 << TILE_BITS}"
    ") AS cell"
)
"""SQL of the cells of tiles: a range of the primary key for each. Without the limit, which is never reached, a range is
taken for a ninth of the table, and the whole map is read."""
OF_MAP = "map = %(map)s AND layer = 0"
COUNTED = f"""
SELECT false, cell, 0::bigint, fingerprint, voxels, size_bytes, history_bytes FROM cell
WHERE {OF_MAP} AND cell = ANY(%(keys)s::bigint[])
UNION ALL
SELECT true, tile, lm, fingerprint, cells, size_bytes, history_bytes FROM tile
WHERE {OF_MAP} AND tile = ANY(%(tiles)s::bigint[])"""
"""SQL of what cells and tiles are counted as (`Counted`), before the statement that it is a part of."""
TOTALS = "cells = %s, cells_bytes = %s, fingerprint = %s, corners = %s::bigint[], history_bytes = %s"
"""SQL that sets a head's totals to `totals_values`."""


Totals = tuple[TileSums, Corners | None]
"""Sums over all cells of a map, and the corners of those with a voxel."""


class Counted(NamedTuple):
    """Sums of a cell or a tile as they are stored."""

    is_tile: bool
    number: int
    lm: int
    fingerprint: bytes
    content: int
    """Voxels of a cell, cells of a tile."""
    size_bytes: int
    history_bytes: int


def totals_of(connection: Connection, map_number: int) -> Totals:
    """Sums over all cells of a map, and the corners of those with a voxel."""
    query = "SELECT cells, cells_bytes, fingerprint, corners, history_bytes FROM head WHERE map = %s"
    return totals_from(first(connection, query, (map_number,)))


def totals_from(columns: tuple[Any, ...]) -> Totals:
    """Totals in these columns of a head: cells, cells_bytes, fingerprint, corners, history_bytes."""
    cells, size_bytes, fingerprint, corners, history_bytes = columns
    found = (tuple(corners[:3]), tuple(corners[3:])) if corners else None
    return TileSums(0, cells, size_bytes, fingerprint_from_bytes(fingerprint), history_bytes), found


def totals_values(sums: TileSums, corners: Corners | None) -> tuple[Any, ...]:
    """Values of `TOTALS`."""
    ends = [*corners[0], *corners[1]] if corners else None
    return sums.cells, sums.size_bytes, sums.fingerprint.to_bytes(), ends, sums.history_bytes


def tiles_changed(connection: Connection, map_number: int, *, after_seq: int, box: Box | None) -> list[int]:
    """Numbers of the tiles with a cell that changed after a log entry, of those that touch a box, rising."""
    query = f"SELECT tile FROM tile WHERE {OF_MAP} AND lm > %(after)s"
    values: dict[str, Any] = {"map": map_number, "after": after_seq}
    asked = tiles_in_box(box) if box else None
    if asked is not None:
        found = rows(connection, f"{query} AND tile = ANY(%(tiles)s)", {**values, "tiles": asked})
        return sorted(tile for (tile,) in found)
    tiles = _numbers(rows(connection, query, values))
    return sorted((tiles[touches_box(tiles, box)] if box else tiles).tolist())


def fingerprint_in_box(connection: Connection, map_number: int, box: Box) -> Fingerprint:
    """Sum of the fingerprints of the cells of a map in a box."""
    tiles = np.array(tiles_changed(connection, map_number, after_seq=-1, box=box), np.uint64)
    is_inside = is_inside_box(tiles, box)
    query = f"SELECT fingerprint FROM tile WHERE {OF_MAP} AND tile = ANY(%(tiles)s)"
    inside = rows(connection, query, {"map": map_number, "tiles": tiles[is_inside].tolist()})
    query = f"SELECT cell.cell, fingerprint FROM {IN_TILES}"
    border = rows(connection, query, {"map": map_number, "tiles": tiles[~is_inside].tolist()})
    is_asked = is_in_box(_numbers(border), box).tolist()
    sums = [*(sums for (sums,) in inside), *(each[1] for each, asked in zip(border, is_asked, strict=True) if asked)]
    return sum(map(fingerprint_from_bytes, sums), ZERO)


class PgTileWriter:
    """Tiles and totals of one map, changed along with its cells, in one transaction that has locked its head."""

    def __init__(self, connection: Connection, map_number: int, totals: Totals) -> None:
        """Change them from these totals on."""
        self._connection = connection
        self._map = map_number
        self._sums, corners = totals
        self._changes = TileChanges(corners)
        self._known: dict[int, TileSums] = {}

    def note(self, cells: Sequence[CellRow], before: Sequence[Counted]) -> None:
        """Count cells, each of them once, which with their tiles were counted as this before they were written."""
        self._known |= {known.number: _tile_sums(*known[1:]) for known in before if known.is_tile}
        had = {known.number: _counted(known) for known in before if not known.is_tile}
        for cell in cells:
            self._changes.add(had.get(cell.key), cell)

    def write(self) -> Totals:
        """Write the tiles, after the cells; the totals of the map, which are written with its head."""
        changes = self._changes
        tiles = {tile: self._known.get(tile, TileSums()) + change for tile, change in changes.tiles.items()}
        if tiles:
            _put_tiles(self._connection, self._map, tiles)
        corners = changes.corners
        if changes.has_emptied_border:
            corners = _measured_corners(self._connection, self._map)
        return self._sums + changes.total, corners


def recount_tile(connection: Connection, map_number: int, tile: int) -> None:
    """Compute a tile's sums again from its cells: the row of a damaged cell does not say what it was counted as."""
    columns = "tile, lm, fingerprint, cells, size_bytes, history_bytes"
    query = f"SELECT {columns} FROM tile WHERE {OF_MAP} AND tile = %(tile)s"
    known = first(connection, query, {"map": map_number, "tile": tile})
    before = _tile_sums(*known) if known is not None else TileSums()
    query = f"SELECT cell.cell, lm, fingerprint, voxels > 0, size_bytes, history_bytes FROM {IN_TILES}"
    found = rows(connection, query, {"map": map_number, "tiles": [tile]})
    after = sum(
        (
            _tile_sums(key, lm, fingerprint, int(is_known), size_bytes * is_known, history_bytes * is_known)
            for key, lm, fingerprint, is_known, size_bytes, history_bytes in found
        ),
        TileSums(),
    )
    _put_tiles(connection, map_number, {tile: after})
    sums, _ = totals_of(connection, map_number)
    _put_totals(connection, map_number, sums + after - before, _measured_corners(connection, map_number))


def _counted(known: Counted) -> CellRow:
    """A cell with what is counted of it."""
    return CellRow(
        key=CellKey(known.number),
        lm=0,
        digest=b"",
        fingerprint=fingerprint_from_bytes(known.fingerprint),
        voxels=known.content,
        body=b"",
        size_bytes=known.size_bytes,
        history_bytes=known.history_bytes,
    )


def _tile_sums(_: int, lm: int, fingerprint: bytes, cells: int, size_bytes: int, history_bytes: int) -> TileSums:
    return TileSums(lm, cells, size_bytes, fingerprint_from_bytes(fingerprint), history_bytes)


def _put_tiles(connection: Connection, map_number: int, tiles: dict[int, TileSums]) -> None:
    sums = list(tiles.values())
    connection.execute(
        "INSERT INTO tile (map, tile, lm, cells, size_bytes, fingerprint, history_bytes)"
        " SELECT %s, u.* FROM unnest(%s::bigint[], %s::bigint[], %s::bigint[], %s::bigint[], %s::bytea[], %s::bigint[])"
        " AS u ON CONFLICT (map, layer, tile) DO UPDATE SET lm = excluded.lm, cells = excluded.cells,"
        " size_bytes = excluded.size_bytes, fingerprint = excluded.fingerprint,"
        " history_bytes = excluded.history_bytes",
        (
            map_number,
            list(tiles),
            [one.lm for one in sums],
            [one.cells for one in sums],
            [one.size_bytes for one in sums],
            [one.fingerprint.to_bytes() for one in sums],
            [one.history_bytes for one in sums],
        ),
    )


def _put_totals(connection: Connection, map_number: int, sums: TileSums, corners: Corners | None) -> None:
    query = f"UPDATE head SET {TOTALS} WHERE map = %s".encode()
    connection.execute(query, (*totals_values(sums, corners), map_number))


def _measured_corners(connection: Connection, map_number: int) -> Corners | None:
    query = f"SELECT tile FROM tile WHERE {OF_MAP} AND cells > 0"
    tiles = _numbers(rows(connection, query, {"map": map_number}))

    def keys_of(asked: list[int]) -> Iterable[CellKey]:
        query = f"SELECT cell.cell FROM {IN_TILES} WHERE voxels > 0"
        return (CellKey(key) for (key,) in rows(connection, query, {"map": map_number, "tiles": asked}))

    return corners_of(tiles, keys_of)


def _numbers(found: list[tuple[Any, ...]]) -> UInts:
    """(N,) first columns of rows."""
    return np.fromiter((row[0] for row in found), np.uint64, len(found))
