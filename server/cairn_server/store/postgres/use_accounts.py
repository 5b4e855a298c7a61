"""Use of quotas in PostgreSQL (`replica_notes.UseAccounts`): one row for each robot, changed by one statement.

    day, sizes       use of the day; another day begins with nothing
    turns, turned    token bucket of its commits: what was left when it was last looked at

No request waits for the disk here: the push that follows flushes what was taken before it.
"""

from typing import Any

from cairn_server.store.postgres.connections import Connections, first
from cairn_server.store.replica_notes import UseAnswer, UseBounds
from cairn_server.store.store_rows import Robot, Use

MINUTE_S = 60
TRIES_MAX = 4
"""Most attempts to take what did not fit a moment ago, and does now."""
NEXT_TO_NOTHING_S = 1e-3
"""Wait for what fits already."""
DAY = "floor(extract(epoch FROM clock_timestamp()) / 86400)::bigint"
"""SQL of the days since 1970."""
SIZES = ("size_bytes", "cells", "bricks")
FITS = " AND ".join(f"(%(most_{size})s::bigint IS NULL OR {{{size}}} <= %(most_{size})s)" for size in SIZES)
"""SQL of the bounds of a day, for an expression of each size."""
HAD = {size: f"CASE WHEN a.day = excluded.day THEN a.{size} ELSE 0 END" for size in SIZES}
"""SQL of what was taken on the day before this."""
LEFT = (
    "least(%(most)s::float8, coalesce(a.turns, %(most)s::float8)"
    " + extract(epoch FROM clock_timestamp() - a.turned)::float8 * %(per_s)s::float8)"
)
"""SQL of the turns that a bucket has by now; NULL without a bound."""
TAKE = f"""
INSERT INTO use_day AS a (map, robot, day, size_bytes, cells, bricks, turns, turned)
SELECT %(map)s, %(robot)s, {DAY}, %(size_bytes)s, %(cells)s, %(bricks)s, %(most)s::float8 - %(commits)s,
    clock_timestamp()
WHERE {FITS.format(**{size: f"%({size})s" for size in SIZES})}
ON CONFLICT (map, robot) DO UPDATE SET
    day = excluded.day,
    {", ".join(f"{size} = {HAD[size]} + excluded.{size}" for size in SIZES)},
    turns = {LEFT} - %(commits)s,
    turned = clock_timestamp()
WHERE {FITS.format(**{size: f"{HAD[size]} + excluded.{size}" for size in SIZES})}
    AND (%(commits)s = 0 OR %(most)s::float8 IS NULL OR {LEFT} >= %(commits)s)
RETURNING day, size_bytes, cells, bricks
"""
LOOK = f"""
SELECT excluded.day, {", ".join(HAD.values())}, {LEFT}
FROM use_day AS a, (SELECT {DAY} AS day) AS excluded WHERE map = %(map)s AND robot = %(robot)s
"""
TAKE_TURN = f"""
INSERT INTO bucket AS a (name, turns, turned) VALUES (%(name)s, %(most)s::float8 - 1, clock_timestamp())
ON CONFLICT (name) DO UPDATE SET turns = {LEFT} - 1, turned = clock_timestamp() WHERE {LEFT} >= 1
RETURNING 1
"""


class PgUseAccounts:
    """`replica_notes.UseAccounts`."""

    def __init__(self, noting: Connections) -> None:
        self._noting = noting

    def take(self, robot: Robot, use: Use, bounds: UseBounds, *, commits: int) -> UseAnswer:
        """Take use of the day and commits of the minute, or nothing."""
        most = bounds.commits_per_minute
        values: dict[str, Any] = {
            "map": robot[0],
            "robot": robot[1],
            "size_bytes": use.size_bytes,
            "cells": use.cells,
            "bricks": use.bricks,
            "most_size_bytes": bounds.size_bytes,
            "most_cells": bounds.cells,
            "most_bricks": bounds.bricks,
            "most": most,
            "per_s": None if most is None else most / MINUTE_S,
            "commits": commits,
        }
        tries = 0
        with self._noting.lent() as connection:
            while True:
                taken = first(connection, TAKE, values)
                if taken is not None:
                    return UseAnswer(taken[0], Use(*taken[1:]))
                none = (*first(connection, f"SELECT {DAY}, 0, 0, 0"), most)
                day, *used, left = first(connection, LOOK, values) or none
                of_day = Use(*used) + use
                if not bounds.hold(of_day):
                    return UseAnswer(day, of_day)
                # Use or a turn that came back since fits by now, and is taken all the same: nothing was yet.
                if most is not None and left is not None and left < commits:
                    return UseAnswer(day, of_day, max(NEXT_TO_NOTHING_S, (1 - left) * MINUTE_S / most))
                tries += 1
                if tries == TRIES_MAX:
                    return UseAnswer(day, of_day, NEXT_TO_NOTHING_S)

    def give_back(self, robot: Robot, use: Use, *, day: int, commits: int) -> None:
        """Give back what was taken on a day."""
        less = ", ".join(f"{size} = {size} - CASE WHEN day = %(day)s THEN %({size})s ELSE 0 END" for size in SIZES)
        query = f"UPDATE use_day SET {less}, turns = turns + %(commits)s WHERE map = %(map)s AND robot = %(robot)s"
        values = {"map": robot[0], "robot": robot[1], "day": day, "commits": commits}
        sizes = {"size_bytes": use.size_bytes, "cells": use.cells, "bricks": use.bricks}
        with self._noting.lent() as connection:
            connection.execute(query, values | sizes)

    def take_turn(self, bucket: str, *, most: float, per_s: float) -> float:
        """Take one from a token bucket; 0, or the seconds to wait."""
        values = {"name": bucket, "most": most, "per_s": per_s}
        with self._noting.lent() as connection:
            if first(connection, TAKE_TURN, values) is not None:
                return 0.0
            left = first(connection, f"SELECT {LEFT} FROM bucket AS a WHERE name = %(name)s", values)
        return max(NEXT_TO_NOTHING_S, (1 - (left or 0.0)) / per_s)

    def give_turn(self, bucket: str) -> None:
        """Put one back."""
        with self._noting.lent() as connection:
            connection.execute("UPDATE bucket SET turns = turns + 1 WHERE name = %s", (bucket,))
