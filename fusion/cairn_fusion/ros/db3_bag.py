"""Bags of ROS 2 in SQLite (.db3): the tables `topics` and `messages`, which all versions of rosbag2 have.

A file that somebody hands over may be any database: a view in the place of a table, whose query never ends; a column
that computes 900 MB; pages that lead to each other, so that a small file has 10^12 rows. So both names must be plain
tables, and a query may take no more steps, and give no more bytes, than the file's size allows.
"""

from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

import apsw
import zstandard

from cairn_fusion.ros.bag import CHUNK_BYTES_MAX, MESSAGES_MAX, BagMessage, Topic, Wire, translate_damage
from cairn_fusion.ros.mcap_bag import unpack
from cairn_fusion.ros.messages import plain_type

ADVICE = "`ros2 bag reindex DIR` saves what is whole"
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
"""A message packed by `ros2 bag record --compression-mode message`; plain CDR begins with a zero."""
TABLES = {"topics": {"id", "name", "type", "serialization_format"}, "messages": {"topic_id", "timestamp", "data"}}
ROW_BYTES_MIN = 8
"""Least size of a message in the file: its place in the page, its head, topic and time."""
STEPS_PER_ROW_MAX = 100
"""Instructions of SQLite for a row of a pass; honest queries take about 20."""
STEPS_MIN = 1_000_000
STEPS_AT_ONCE = 10_000
EMPTY_START_NS = 2**63 - 1
"""Start of a bag without messages."""


class Db3Bag:
    """A .db3 file; see `bag.Bag`."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.topics: dict[str, Topic] = {}
        self.start_ns = EMPTY_START_NS
        self._names: dict[int, str] = {}
        self._steps_left = 0
        with translate_damage(path, apsw.Error, advice=ADVICE):
            self._size_bytes = path.stat().st_size
            flags = apsw.SQLITE_OPEN_READONLY | apsw.SQLITE_OPEN_URI
            self._connection = apsw.Connection(f"{path.absolute().as_uri()}?immutable=1", flags=flags)
            try:
                self._connection.limit(apsw.SQLITE_LIMIT_LENGTH, CHUNK_BYTES_MAX)
                self._connection.set_progress_handler(self._is_too_long, STEPS_AT_ONCE)
                self._read_topics()
            except BaseException:
                self._connection.close()
                raise

    def messages(self, topics: Collection[str], *, start_ns: int = 0) -> Iterator[BagMessage]:
        """Messages as `Bag.messages`."""
        ids = [number for number, name in self._names.items() if name in topics]
        query = (
            f"SELECT topic_id, timestamp, rowid FROM messages WHERE topic_id IN ({', '.join('?' * len(ids))})"  # noqa: S608
            " AND timestamp >= ? ORDER BY timestamp"
        )
        left = self._size_bytes
        with translate_damage(self.path, apsw.Error, advice=ADVICE):
            # Places are sorted, not messages, so that a file without an index on the times fills no disk.
            for topic, log_ns, row in self._rows(query, (*ids, start_ns)):
                for (data,) in self._connection.execute("SELECT data FROM messages WHERE rowid = ?", (row,)):
                    if not isinstance(data, bytes) or not isinstance(log_ns, int):
                        raise ValueError(f"a message of {self._names[topic]} is no bytes, or its time no number")
                    left -= len(data)
                    if left < 0:
                        raise ValueError("its messages have more bytes than the file")
                    yield BagMessage(self._names[topic], log_ns, _plain(data))

    def close(self) -> None:
        """Close the file."""
        self._connection.close()

    def _read_topics(self) -> None:
        for table, columns in TABLES.items():
            self._check_table(table, columns)
        counts: dict[int, int] = {}
        for number, count, start_ns in self._rows(
            "SELECT topic_id, count(*), min(timestamp) FROM messages GROUP BY topic_id"
        ):
            if not isinstance(start_ns, int):
                raise ValueError(f"a message has the time {str(start_ns)[:40]!r}")
            counts[number] = count
            self.start_ns = min(self.start_ns, start_ns)
        for number, name, kind, coding in self._rows("SELECT id, name, type, serialization_format FROM topics"):
            if not (isinstance(number, int) and isinstance(name, str) and isinstance(kind, str)):
                raise ValueError("a topic's id is no number, or its name or type no text")
            self._names[number] = name
            found = Topic(name, plain_type(kind), Wire.CDR if coding == "cdr" else None, counts.get(number, 0))
            known = self.topics.get(name)
            self.topics[name] = found if known is None else _joined(known, found)

    def _check_table(self, table: str, columns: set[str]) -> None:
        """Refuse what is no plain table, or has a column that is computed."""
        kinds = [kind for (kind,) in self._rows("SELECT type FROM pragma_table_list WHERE name = ?", (table,))]
        plain = {name for (name,) in self._rows("SELECT name FROM pragma_table_xinfo(?) WHERE hidden = 0", (table,))}
        if kinds != ["table"] or not columns <= plain:
            raise ValueError(f"it has no plain table {table!r} with {', '.join(sorted(columns))}")

    def _rows(self, query: str, values: tuple[int | str, ...] = ()) -> Iterator[tuple[Any, ...]]:
        """Rows of a query, which take steps and bytes by the file's size."""
        rows_max = min(self._size_bytes // ROW_BYTES_MIN, MESSAGES_MAX)
        self._steps_left = max(self._steps_left, 0) + STEPS_MIN + rows_max * STEPS_PER_ROW_MAX
        left = self._size_bytes
        for row in self._connection.execute(query, values):
            left -= sum(len(value) for value in row if isinstance(value, (str, bytes)))
            if left < 0:
                raise ValueError("its rows have more bytes than the file")
            yield row

    def _is_too_long(self) -> bool:
        """True when the queries have taken more steps than they may; SQLite ends the one that runs."""
        self._steps_left -= STEPS_AT_ONCE
        return self._steps_left < 0


def _joined(known: Topic, other: Topic) -> Topic:
    """One topic that two publishers have, each with a row of its own."""
    kind = known.type if known.type == other.type else ""
    return Topic(known.name, kind, known.wire if known.wire == other.wire else None, known.count + other.count)


def _plain(data: bytes) -> bytes:
    """A message as it was published."""
    if not data.startswith(ZSTD_MAGIC):
        return data
    size = zstandard.get_frame_parameters(data).content_size
    if size > CHUNK_BYTES_MAX:
        raise ValueError(f"a message of {size} bytes, at most {CHUNK_BYTES_MAX} are read")
    return unpack(data, "zstd", size)
