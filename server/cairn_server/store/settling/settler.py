"""Settler: moves cells and evidence at rest from the database to an object store.

    note    the name in `dead_object`, committed       a kill leaves nothing that is not noted
    put     the object                                 the row still has its bytes
    swap    row: name instead of bytes; note: gone     only if neither the row nor the note changed meanwhile

So every object is named by a row or noted as dead, at every instant, and none of this depends on what the object store
does with two writers of one name. (A settler that slept longer than the grace of dead objects may put one whose note is
gone; the listing of `dead_objects` finds it.) Several settlers do no harm; one at a time works, by a claim that ends by
itself.

Cells move by tiles: those of a tile that nothing changed for a while. Evidence moves by segments, oldest fold first.
"""

from collections.abc import Iterable, Iterator
from contextlib import suppress
from typing import NamedTuple

from cairn_map.errors import CairnError
from cairn_map.evidence.grid import CellKey
from cairn_server.store.objects.bucket import Bucket
from cairn_server.store.objects.cold_bytes import cell_name, cell_object, segment_name
from cairn_server.store.postgres.connections import Connection, Connections, first, rows
from cairn_server.store.postgres.reads import PgReads
from cairn_server.store.postgres.schema import STEPS
from cairn_server.store.postgres.shares import lock_head
from cairn_server.store.postgres.tile_rows import IN_TILES
from cairn_server.store.settling.dead_objects import delete_dead, note_unknown
from cairn_server.store.settling.ownership import TURN_S, Ownership
from cairn_server.store.store_rows import MapRow
from cairn_server.store.tiles import TILE_BITS

TILES_AT_ONCE = 16
"""Tiles whose cells are looked at by one query."""
CELLS_BYTES = 16 << 20
"""Bytes of cells that are moved at once."""
SEGMENT_BYTES = 16 << 20
"""Bytes from which on a segment is full."""
COMMITS_AT_ONCE = 256
"""Most commits whose evidence is in a segment."""
LIST_EVERY_S = 86_400.0
"""Age of the store between two listings of all objects, for those that a restored database does not know."""
CLAIM_S = 60
"""Seconds for which a settler's claim lasts."""
AT_REST = """
    WHERE map IN (
        SELECT head.map FROM head LEFT JOIN settled USING (map)
        WHERE head.seq > coalesce(settled.seq, 0) OR EXISTS (
            SELECT FROM commits AS c
            WHERE c.map = head.map AND NOT gone AND cells > 0 AND folded_seq IS NOT NULL
                AND folded_age_s >= coalesce(settled.age_s, 0) AND folded_age_s < %s::float8
                AND (folded_age_s, c.number) > (coalesce(settled.age_s, 0), coalesce(settled.number, 0))
        )
    ) ORDER BY name"""
NOTE = "INSERT INTO dead_object (map, name, since_age_s) SELECT %s, unnest(%s::text[]), %s"
LOCK_NOTES = "SELECT name FROM dead_object WHERE map = %s AND name = ANY(%s) AND NOT doomed ORDER BY name FOR UPDATE"
DROP_NOTES = "DELETE FROM dead_object WHERE map = %s AND name = ANY(%s)"
SWAP_CELLS = """
    UPDATE cell SET object = u.name, body = NULL, stamps = NULL
    FROM unnest(%s::bigint[], %s::bigint[], %s::bytea[], %s::text[]) AS u (cell, lm, sha, name)
    WHERE cell.map = %s AND cell.layer = 0 AND cell.cell = u.cell AND cell.lm = u.lm AND cell.object IS NULL
        AND sha256(cell.body) = u.sha AND u.name = ANY(%s)
    RETURNING u.name"""
SWAP_DIFFS = """
    WITH moved AS (
        UPDATE diff SET segment = %(name)s, start_bytes = u.start, size_bytes = octet_length(body), body = NULL
        FROM unnest(%(numbers)s::bigint[], %(cells)s::bigint[], %(shas)s::bytea[], %(starts)s::bigint[])
            AS u (number, cell, sha, start)
        WHERE diff.map = %(map)s AND diff.layer = 0 AND commit_number = u.number AND diff.cell = u.cell
            AND sha256(body) = u.sha
        RETURNING 1
    )
    INSERT INTO segment (map, name, live, size_bytes)
    SELECT %(map)s, %(name)s, count(*), %(size_bytes)s FROM moved HAVING count(*) > 0
    RETURNING live"""
CLAIM = """
    UPDATE object_store SET holder = %(holder)s, until = clock_timestamp() + make_interval(secs => %(for_s)s::float8)
    WHERE (holder = %(holder)s OR until < clock_timestamp()) AND (SELECT oldest FROM cairn_schema) <= %(known)s
    RETURNING 1"""


class Moved(NamedTuple):
    """Count and size of what moved."""

    pieces: int = 0
    size_bytes: int = 0

    def plus(self, more: "Moved") -> "Moved":
        """Sum of both."""
        return Moved(self.pieces + more.pieces, self.size_bytes + more.size_bytes)


class _Cell(NamedTuple):
    key: int
    lm: int
    sha: bytes
    body: bytes
    stamps: bytes
    name: str


class _Piece(NamedTuple):
    number: int
    cell: int
    sha: bytes
    body: bytes


class Settler:
    """Moves of one database's bytes to a bucket; one thread at a time."""

    def __init__(self, connections: Connections, bucket: Bucket, *, holder: str, turn_s: float = TURN_S) -> None:
        """Settle over these connections; `holder` is this process's own name, `turn_s` the time between its turns."""
        self._connections = connections
        self._ownership = Ownership(connections, bucket, holder=holder, every_s=turn_s)
        self._reads = PgReads(connections, bucket)
        self._bucket = bucket
        self._holder = holder

    def may_work(self) -> bool:
        """True if this settler is the one of its database, and its database the owner of the bucket.

        Raises:
            BadInputError: kind `bad_objects`: the bucket is another database's.
            AwayError: the object store does not answer.
        """
        return self.claim() and self._ownership.holds()

    def claim(self) -> bool:
        """True if this settler is the one of its database that works, for `CLAIM_S` from now on."""
        with self._connections.lent() as connection:
            return first(connection, CLAIM, {"holder": self._holder, "for_s": CLAIM_S, "known": len(STEPS)}) is not None

    def release(self) -> None:
        """End the claim."""
        with self._connections.lent() as connection:
            connection.execute("UPDATE object_store SET until = '-infinity' WHERE holder = %s", (self._holder,))

    def close(self) -> None:
        """End the claim, and close the connections."""
        with suppress(CairnError):  # it ends by itself
            self.release()
        self._connections.close()

    def maps_at_rest(self, *, evidence_before_s: float) -> list[MapRow]:
        """Maps with changes since they were settled, or evidence to be moved, by name; one query for all maps."""
        return self._reads.map_rows(AT_REST, (evidence_before_s,))

    def settle_cells(self, row: MapRow, *, to_seq: int, age_s: float) -> Iterator[Moved]:
        """Move the cells of all tiles that did not change after an entry; what moved, step by step.

        Raises:
            AwayError: the object store does not take them; what moved before stays there.
        """
        query = "SELECT tile, lm FROM tile WHERE map = %s AND layer = 0 AND lm > %s AND lm <= %s ORDER BY lm"
        with self._connections.lent() as connection:
            mark = first(connection, "SELECT seq FROM settled WHERE map = %s", (row.number,)) or 0
            tiles = rows(connection, query, (row.number, mark, to_seq))
        for start in range(0, len(tiles), TILES_AT_ONCE):
            for cells in self._hot_cells(row, [tile for tile, _ in tiles[start : start + TILES_AT_ONCE]]):
                yield self._move_cells(row, cells, age_s)
            # A stop here costs these tiles only; the next ones may have the same entry as the last of them.
            for _, lm in tiles[start + TILES_AT_ONCE : start + TILES_AT_ONCE + 1]:
                self._note_settled(row, lm - 1)
        self._note_settled(row, to_seq)

    def _note_settled(self, row: MapRow, seq: int) -> None:
        """Note that the tiles that changed up to an entry, and not after it, were moved."""
        query = (
            "INSERT INTO settled (map, seq) VALUES (%s, %s)"
            " ON CONFLICT (map) DO UPDATE SET seq = greatest(settled.seq, excluded.seq)"
        )
        with self._connections.lent() as connection:
            connection.execute(query, (row.number, seq))

    def settle_evidence(self, row: MapRow, *, before_s: float, age_s: float) -> Iterator[Moved]:
        """Move the evidence of all commits folded before an age of the store; what moved, segment by segment.

        Raises:
            AwayError: the object store does not take it; what moved before stays there.
        """
        while True:
            with self._connections.lent() as connection:
                commits = _commits_after_mark(connection, row, before_s)
                pieces = _pieces(connection, row, [number for number, *_ in commits])
            if not commits:
                return
            if pieces:
                yield self._move_pieces(row, pieces, age_s)
            *_, (number, folded_s, _) = commits
            query = (
                "INSERT INTO settled (map, age_s, number) VALUES (%s, %s, %s)"
                " ON CONFLICT (map) DO UPDATE SET age_s = excluded.age_s, number = excluded.number"
            )
            with self._connections.lent() as connection:
                connection.execute(query, (row.number, folded_s, number))

    def delete_dead(self, *, before_s: float) -> int:
        """Delete objects that have been dead since before an age of the store (`dead_objects.delete_dead`)."""
        return delete_dead(self._connections, self._bucket, before_s=before_s)

    def is_listing_due(self, *, age_s: float) -> bool:
        """True if the objects were not listed for `LIST_EVERY_S`, by any server's settler."""
        with self._connections.lent() as connection:
            listed_s: float = first(connection, "SELECT listed_age_s FROM object_store") or 0.0
        return age_s - listed_s > LIST_EVERY_S

    def note_unknown(self, *, age_s: float) -> Iterator[int]:
        """List all objects, and note those that the database does not know (`dead_objects.note_unknown`)."""
        yield from note_unknown(self._connections, self._bucket, age_s=age_s)
        with self._connections.lent() as connection:
            connection.execute("UPDATE object_store SET listed_age_s = %s", (age_s,))

    def cell_count(self) -> int:
        """Count of the cells of all maps."""
        with self._connections.lent() as connection:
            return int(first(connection, "SELECT coalesce(sum(cells), 0)::bigint FROM head"))

    def cold_cell(self, place: float) -> tuple[MapRow, CellKey] | None:
        """A cold cell of some map, about at this part (0 to 1) of the map's cells; None: there is none after it."""
        maps = self._reads.map_rows("WHERE map IN (SELECT map FROM head WHERE cells > 0 ORDER BY random() LIMIT 1)", ())
        if not maps:
            return None
        query = (
            "SELECT cell FROM cell WHERE map = %(map)s AND layer = 0 AND object IS NOT NULL AND cell >= ("
            " SELECT (min(tile) + floor(%(place)s::float8 * (max(tile) - min(tile)))::bigint) * %(cells)s"
            " FROM tile WHERE map = %(map)s AND layer = 0) ORDER BY cell LIMIT 1"
        )
        with self._connections.lent() as connection:
            found = first(connection, query, {"map": maps[0].number, "place": place, "cells": 1 << TILE_BITS})
        return None if found is None else (maps[0], CellKey(found))

    def _hot_cells(self, row: MapRow, tiles: list[int]) -> Iterator[list[_Cell]]:
        """Cells of tiles whose bytes are here, some megabytes at a time."""
        of_map = {"map": row.number, "tiles": tiles}
        query = f"SELECT cell.cell, cell.size_bytes FROM {IN_TILES} WHERE object IS NULL"
        with self._connections.lent() as connection:
            sizes = rows(connection, query, of_map)
        for keys in _groups(sizes, CELLS_BYTES):
            query = (
                "SELECT cell, lm, sha256(body), body, stamps, digest FROM cell"
                " WHERE map = %s AND layer = 0 AND cell = ANY(%s) AND object IS NULL"
            )
            with self._connections.lent() as connection:
                found = rows(connection, query, (row.number, keys))
            if not found:  # another one moved them meanwhile
                continue
            yield [
                _Cell(key, lm, sha, body, stamps, cell_name(row.number, key, lm=lm, digest=digest))
                for key, lm, sha, body, stamps, digest in found
            ]

    def _move_cells(self, row: MapRow, cells: list[_Cell], age_s: float) -> Moved:
        names = [cell.name for cell in cells]
        self._note(row, names, age_s)
        objects = [(cell.name, cell_object(cell.body, cell.stamps)) for cell in cells]
        self._bucket.put_all(objects)

        def swap(connection: Connection) -> set[str]:
            lock_head(connection, row)  # cells of a map are only written under its head
            sound = [name for (name,) in rows(connection, LOCK_NOTES, (row.number, names))]
            columns = zip(*((cell.key, cell.lm, cell.sha, cell.name) for cell in cells), strict=True)
            moved = {name for (name,) in rows(connection, SWAP_CELLS, (*map(list, columns), row.number, sound))}
            connection.execute(DROP_NOTES, (row.number, sorted(moved)))
            return moved

        moved = self._connections.run(swap)
        return Moved(len(moved), sum(len(data) for name, data in objects if name in moved))

    def _move_pieces(self, row: MapRow, pieces: list[_Piece], age_s: float) -> Moved:
        name, data = segment_name(row.number), b"".join(piece.body for piece in pieces)
        self._note(row, [name], age_s)
        self._bucket.put(name, data)
        starts, at = [], 0
        for piece in pieces:
            starts.append(at)
            at += len(piece.body)
        values = {
            "map": row.number,
            "name": name,
            "numbers": [piece.number for piece in pieces],
            "cells": [piece.cell for piece in pieces],
            "shas": [piece.sha for piece in pieces],
            "starts": starts,
            "size_bytes": len(data),
        }

        def swap(connection: Connection) -> int:
            lock_head(connection, row)  # or evidence that is forgotten now would not be counted off the segment
            if not rows(connection, LOCK_NOTES, (row.number, [name])):
                return 0
            moved = first(connection, SWAP_DIFFS, values)
            if moved:
                connection.execute(DROP_NOTES, (row.number, [name]))
            return moved or 0

        moved = self._connections.run(swap)
        return Moved(moved, len(data) if moved else 0)

    def _note(self, row: MapRow, names: list[str], age_s: float) -> None:
        """Note objects that are about to be made as dead, durably."""
        with self._connections.lent() as connection:
            connection.execute(NOTE, (row.number, names, age_s))


def _commits_after_mark(connection: Connection, row: MapRow, before_s: float) -> list[tuple[int, float, int]]:
    """Number, age and size of the next commits whose evidence is to be moved, oldest first: one segment's."""
    query = (
        "SELECT number, folded_age_s, size_bytes FROM commits"
        " WHERE map = %(map)s AND NOT gone AND cells > 0 AND folded_seq IS NOT NULL"
        " AND folded_age_s >= %(age_s)s::float8 AND folded_age_s < %(before)s::float8"
        " AND (folded_age_s, number) > (%(age_s)s::float8, %(number)s)"
        " ORDER BY folded_age_s, number LIMIT %(limit)s"
    )
    mark = first(connection, "SELECT age_s, number FROM settled WHERE map = %s", (row.number,)) or (0.0, 0)
    values = {"map": row.number, "age_s": mark[0], "number": mark[1], "before": before_s, "limit": COMMITS_AT_ONCE}
    found = rows(connection, query, values)
    size_bytes = 0
    for count, (_, _, size) in enumerate(found, start=1):
        size_bytes += size
        if size_bytes >= SEGMENT_BYTES:
            return [(number, age_s, size) for number, age_s, size in found[:count]]
    return [(number, age_s, size) for number, age_s, size in found]


def _pieces(connection: Connection, row: MapRow, numbers: list[int]) -> list[_Piece]:
    """Evidence of commits that is here: that of each commit side by side."""
    query = (
        "SELECT commit_number, cell, sha256(body), body FROM diff"
        " WHERE map = %s AND layer = 0 AND commit_number = ANY(%s) AND body IS NOT NULL ORDER BY commit_number, cell"
    )
    return [_Piece(*found) for found in rows(connection, query, (row.number, numbers))]


def _groups(sizes: Iterable[tuple[int, int]], limit_bytes: int) -> Iterator[list[int]]:
    """Keys of (key, size) pairs in groups of about so many bytes."""
    group: list[int] = []
    total_bytes = 0
    for key, size_bytes in sizes:
        group.append(key)
        total_bytes += size_bytes
        if total_bytes > limit_bytes:
            yield group
            group, total_bytes = [], 0
    if group:
        yield group
