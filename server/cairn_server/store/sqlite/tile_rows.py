"""Tiles and totals of maps in SQLite: read for requests, written by folds, made for stores of before tiles."""

import json
from collections.abc import Iterable

import apsw
import numpy as np

from cairn_map.commits.cursor import ENTRY_FOLD
from cairn_map.commits.ids import Author, CommitId
from cairn_map.commits.version_vector import EMPTY, VersionVector
from cairn_map.evidence.fingerprint import ZERO, Fingerprint, fingerprint_from_bytes
from cairn_map.evidence.grid import CellKey
from cairn_map.kernels.morton_kernels import UInts
from cairn_server.store.history import MARK_EVERY
from cairn_server.store.sqlite.writer import first, rows
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

CELL_COLUMNS = "cell, lm, digest, fingerprint, voxels, size_bytes, gone_seq, hottest_k, history_bytes"
SUM_COLUMNS = "lm, voxels > 0, size_bytes, fingerprint, history_bytes"
"""SQL of what a tile counts of a cell (`_sums_of`)."""
IN_TILES = (
    # CROSS JOIN keeps the order: a range of the index over listed cells for each tile.
    f"json_each(?) AS tile CROSS JOIN cell INDEXED BY cell_listed ON cell.map = ?"
    f" AND cell.cell BETWEEN tile.value << {TILE_BITS} AND (tile.value << {TILE_BITS}) + {(1 << TILE_BITS) - 1}"
)
"""SQL of the cells of tiles; takes their numbers as JSON, and the map."""


def totals_of(connection: apsw.Connection, map_number: int) -> tuple[TileSums, Corners | None]:
    """Sums over all cells of a map, and the corners of those with a voxel."""
    query = "SELECT cells, cells_bytes, fingerprint, history_bytes, corners FROM map WHERE number = ?"
    cells, size_bytes, fingerprint, history_bytes, corners = first(connection, query, (map_number,))
    found = fingerprint_from_bytes(fingerprint) if fingerprint else ZERO
    return TileSums(0, cells, size_bytes, found, history_bytes), _corners_from_text(corners)


def tiles_changed(connection: apsw.Connection, map_number: int, *, after_seq: int, box: Box | None) -> list[int]:
    """Numbers of the tiles with a cell that changed after a log entry, of those that touch a box, rising."""
    asked = tiles_in_box(box) if box else None
    if asked is not None:
        query = "SELECT tile FROM tile WHERE map = ? AND lm > ? AND tile IN (SELECT value FROM json_each(?))"
        found = rows(connection, query, (map_number, after_seq, json.dumps(asked)))
        return sorted(tile for (tile,) in found)
    tiles = _numbers(rows(connection, "SELECT tile FROM tile WHERE map = ? AND lm > ?", (map_number, after_seq)))
    return sorted((tiles[touches_box(tiles, box)] if box else tiles).tolist())


def fingerprint_in_box(connection: apsw.Connection, map_number: int, box: Box) -> Fingerprint:
    """Sum of the fingerprints of the cells of a map in a box."""
    tiles = tiles_changed(connection, map_number, after_seq=-1, box=box)
    numbers = np.array(tiles, np.uint64)
    is_inside = is_inside_box(numbers, box)
    query = "SELECT fingerprint FROM tile WHERE map = ? AND tile IN (SELECT value FROM json_each(?))"
    inside = rows(connection, query, (map_number, json.dumps(numbers[is_inside].tolist())))
    query = f"SELECT cell, fingerprint FROM {IN_TILES}"  # noqa: S608 - our own clause
    border = rows(connection, query, (json.dumps(numbers[~is_inside].tolist()), map_number))
    is_asked = is_in_box(_numbers(border), box).tolist()
    sums = [*(sums for (sums,) in inside), *(each[1] for each, asked in zip(border, is_asked, strict=True) if asked)]
    return sum(map(fingerprint_from_bytes, sums), ZERO)


class TileWriter:
    """Tiles and totals of one map, changed along with its cells, in one transaction of the writer."""

    def __init__(self, connection: apsw.Connection, map_number: int) -> None:
        self._connection = connection
        self._map = map_number
        _, corners = totals_of(connection, map_number)
        self._changes = TileChanges(corners)

    def note(self, after: CellRow) -> None:
        """Count a cell that is about to be written."""
        columns = "fingerprint, voxels, size_bytes, history_bytes"
        query = f"SELECT {columns} FROM cell INDEXED BY cell_listed WHERE map = ? AND cell = ?"  # noqa: S608 - constant
        found = first(self._connection, query, (self._map, after.key))
        before = None
        if found:
            fingerprint, voxels, size_bytes, history_bytes = found
            before = CellRow(
                key=after.key,
                lm=0,
                digest=b"",
                fingerprint=fingerprint_from_bytes(fingerprint),
                voxels=voxels,
                body=b"",
                size_bytes=size_bytes,
                history_bytes=history_bytes,
            )
        self._changes.add(before, after)

    def write(self, *, folded: int) -> None:
        """Write what changed, after the cells; so many commits are folded with it."""
        changes = self._changes
        known = _tiles(self._connection, self._map, changes.tiles)
        _put_tiles(
            self._connection,
            self._map,
            ((tile, known.get(tile, TileSums()) + change) for tile, change in sorted(changes.tiles.items())),
        )
        corners = changes.corners
        if changes.has_emptied_border:
            corners = _measured_corners(self._connection, self._map)
        sums, _ = totals_of(self._connection, self._map)
        _put_totals(self._connection, self._map, sums + changes.total, corners)
        self._connection.execute("UPDATE map SET folded = folded + ? WHERE number = ?", (folded, self._map))


def recount_tile(connection: apsw.Connection, map_number: int, tile: int) -> None:
    """Compute a tile's sums again from its cells: the row of a damaged cell does not say what it was counted as."""
    before = _tiles(connection, map_number, [tile]).get(tile, TileSums())
    query = f"SELECT {SUM_COLUMNS} FROM {IN_TILES}"  # noqa: S608 - our own clause
    found = rows(connection, query, (json.dumps([tile]), map_number))
    after = sum((_sums_of(*cell) for cell in found), TileSums())
    _put_tiles(connection, map_number, [(tile, after)])
    sums, _ = totals_of(connection, map_number)
    _put_totals(connection, map_number, sums + after - before, _measured_corners(connection, map_number))


def mark_at(connection: apsw.Connection, map_number: int, seq: int, vector: VersionVector) -> None:
    """Store the vector at a log entry."""
    connection.execute(
        "INSERT INTO vector_mark (map, seq, vector) VALUES (?, ?, ?)", (map_number, seq, json.dumps(vector.to_json()))
    )


def fill_tiles(connection: apsw.Connection) -> None:
    """Make the tiles, totals and marks of all maps; some microseconds a cell and a log entry."""
    connection.execute("DELETE FROM tile; DELETE FROM vector_mark")
    for (number,) in rows(connection, "SELECT number FROM map WHERE number NOT IN (SELECT number FROM gone_map)"):
        sums: dict[int, TileSums] = {}
        query = f"SELECT cell >> {TILE_BITS}, {SUM_COLUMNS} FROM cell WHERE map = ?"  # noqa: S608
        for tile, *cell in connection.execute(query, (number,)):
            sums[tile] = sums.get(tile, TileSums()) + _sums_of(*cell)
        _put_tiles(connection, number, sums.items())
        _put_totals(connection, number, sum(sums.values(), TileSums()), _measured_corners(connection, number))
        _fill_marks(connection, number)


def _fill_marks(connection: apsw.Connection, map_number: int) -> None:
    query = (
        "SELECT seq, kind, robot, incarnation, n FROM log JOIN commits ON commits.number = commit_number"
        " WHERE log.map = ? AND seq > ? ORDER BY seq LIMIT ?"
    )
    vector, seq, folded = EMPTY, 0, 0
    while entries := rows(connection, query, (map_number, seq, MARK_EVERY)):
        ids = [CommitId(Author(robot, inc), n) for _, kind, robot, inc, n in entries if kind == ENTRY_FOLD]
        vector, seq, folded = vector.with_commits(ids), entries[-1][0], folded + len(ids)
        mark_at(connection, map_number, seq, vector)
    connection.execute("UPDATE map SET folded = ? WHERE number = ?", (folded, map_number))


def _tiles(connection: apsw.Connection, map_number: int, tiles: Iterable[int]) -> dict[int, TileSums]:
    query = (
        "SELECT tile, lm, cells, size_bytes, fingerprint, history_bytes FROM tile"
        " WHERE map = ? AND tile IN (SELECT value FROM json_each(?))"
    )
    found = rows(connection, query, (map_number, json.dumps(sorted(tiles))))
    return {
        tile: TileSums(lm, cells, size_bytes, fingerprint_from_bytes(fingerprint), history_bytes)
        for tile, lm, cells, size_bytes, fingerprint, history_bytes in found
    }


def _sums_of(lm: int, is_known: int, size_bytes: int, fingerprint: bytes, history_bytes: int) -> TileSums:
    """Sums of a tile of one cell."""
    found = fingerprint_from_bytes(fingerprint)
    return TileSums(lm, is_known, size_bytes * is_known, found, history_bytes * is_known)


def _put_tiles(connection: apsw.Connection, map_number: int, sums: Iterable[tuple[int, TileSums]]) -> None:
    connection.executemany(
        "INSERT INTO tile (map, tile, lm, cells, size_bytes, fingerprint, history_bytes) VALUES (?, ?, ?, ?, ?, ?, ?)"
        " ON CONFLICT (map, tile) DO UPDATE SET lm = excluded.lm, cells = excluded.cells,"
        " size_bytes = excluded.size_bytes, fingerprint = excluded.fingerprint,"
        " history_bytes = excluded.history_bytes",
        (
            (map_number, tile, one.lm, one.cells, one.size_bytes, one.fingerprint.to_bytes(), one.history_bytes)
            for tile, one in sums
        ),
    )


def _put_totals(connection: apsw.Connection, map_number: int, sums: TileSums, corners: Corners | None) -> None:
    text = json.dumps(corners) if corners else None
    connection.execute(
        "UPDATE map SET cells = ?, cells_bytes = ?, fingerprint = ?, history_bytes = ?, corners = ? WHERE number = ?",
        (sums.cells, sums.size_bytes, sums.fingerprint.to_bytes(), sums.history_bytes, text, map_number),
    )


def _measured_corners(connection: apsw.Connection, map_number: int) -> Corners | None:
    tiles = _numbers(rows(connection, "SELECT tile FROM tile WHERE map = ? AND cells > 0", (map_number,)))

    def keys_of(asked: list[int]) -> Iterable[CellKey]:
        query = f"SELECT cell FROM {IN_TILES} WHERE voxels > 0"  # noqa: S608 - our own clause
        return (CellKey(key) for (key,) in rows(connection, query, (json.dumps(asked), map_number)))

    return corners_of(tiles, keys_of)


def _numbers(found: list[tuple[int, ...]]) -> UInts:
    """(N,) first columns of rows."""
    return np.fromiter((row[0] for row in found), np.uint64, len(found))


def _corners_from_text(text: str | None) -> Corners | None:
    if text is None:
        return None
    low, high = json.loads(text)
    return (low[0], low[1], low[2]), (high[0], high[1], high[2])
