"""Dead objects: those that no row names are deleted after a time of grace.

A reader may still hold the name of an object that a row named a moment ago; a standby that lags, or a database that is
restored to an earlier time, may name it for longer: the grace is to exceed all of these. An object is first doomed, so
that no row can come to name it any more, then deleted, then forgotten: a kill in between leaves it to the next one.
"""

import re
from collections import defaultdict
from collections.abc import Iterator

from cairn_server.store.objects.bucket import Bucket
from cairn_server.store.postgres.connections import Connections, rows

OURS = re.compile(r"(cells/\d{1,18}/\d{1,19}|segments/\d{1,18})/[0-9a-f.]+$")
"""Names that a settler gives."""
AT_ONCE = 256
"""Objects that are deleted, or looked up, by one query."""
DOOM = """
    UPDATE dead_object SET doomed = true WHERE (map, name) IN (
        SELECT map, name FROM dead_object WHERE since_age_s < %s AND NOT doomed ORDER BY since_age_s LIMIT %s
    ) AND since_age_s < %s AND NOT doomed"""
FORGET = """
    DELETE FROM dead_object USING unnest(%s::bigint[], %s::text[]) AS u (map, name)
    WHERE dead_object.map = u.map AND dead_object.name = u.name"""
UNKNOWN = """
    SELECT name FROM unnest(%(names)s::text[]) AS u (name)
    WHERE NOT EXISTS (SELECT FROM dead_object AS d WHERE d.map = %(map)s AND d.name = u.name)
        AND NOT EXISTS (SELECT FROM segment AS s WHERE s.map = %(map)s AND s.name = u.name)
        AND NOT EXISTS (
            SELECT FROM cell AS c WHERE c.map = %(map)s AND c.layer = 0 AND c.object = u.name
                AND c.cell = CASE WHEN u.name LIKE 'cells/%%' THEN split_part(u.name, '/', 3)::bigint ELSE -1 END
        )"""


def delete_dead(connections: Connections, bucket: Bucket, *, before_s: float) -> int:
    """Delete objects that have been dead since before an age of the store, at most `AT_ONCE`; their count.

    Raises:
        AwayError: the object store does not delete them; they are tried again.
    """
    with connections.lent() as connection:
        connection.execute(DOOM, (before_s, AT_ONCE, before_s))
        found = rows(connection, "SELECT map, name FROM dead_object WHERE doomed LIMIT %s", (AT_ONCE,))
    if found:
        bucket.delete_all([name for _, name in found])
        with connections.lent() as connection:
            connection.execute(FORGET, ([number for number, _ in found], [name for _, name in found]))
    return len(found)


def note_unknown(connections: Connections, bucket: Bucket, *, age_s: float) -> Iterator[int]:
    """Note objects that the database does not know as dead since now; their count, page by page of the listing.

    There are some after a restore to an earlier time: every name is noted before its object is made. And of a settler
    that slept longer than the time of grace.

    Raises:
        AwayError: the object store does not answer.
    """
    for prefix in ("cells", "segments"):
        for page in bucket.names(prefix):
            by_map: defaultdict[int, list[str]] = defaultdict(list)
            for name in filter(OURS.match, page):
                by_map[int(name.split("/")[1])].append(name)
            yield sum(_note_unknown(connections, number, names, age_s) for number, names in by_map.items())


def _note_unknown(connections: Connections, map_number: int, names: list[str], age_s: float) -> int:
    with connections.lent() as connection:
        unknown = [name for (name,) in rows(connection, UNKNOWN, {"map": map_number, "names": names})]
        connection.execute(
            "INSERT INTO dead_object (map, name, since_age_s) SELECT %s, unnest(%s::text[]), %s ON CONFLICT DO NOTHING",
            (map_number, unknown, age_s),
        )
    return len(unknown)
