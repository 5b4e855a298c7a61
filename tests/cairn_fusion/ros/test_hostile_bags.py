"""Small bags that were made to take hours, or gigabytes: each is refused, and honest twins of them are read."""

import sqlite3
from contextlib import closing
from pathlib import Path

import lz4.frame
import pytest
from tests.fixtures.fusion.raw_bags import (
    NO_TRANSFORMS_2,
    TIME_NS,
    index1,
    message1,
    message2,
    record2,
    share_pages,
    write_mcap,
    write_ros1,
)

from cairn_fusion.ros import mcap_bag
from cairn_fusion.ros.bag_index import index_bag
from cairn_fusion.ros.open_bag import open_bag
from cairn_map.errors import DamagedDataError

ENDLESS = "WITH RECURSIVE c(n) AS (SELECT 1 UNION ALL SELECT n + 1 FROM c)"


def messages_of(path: Path) -> int:
    """Number of messages that a whole pass over a bag gives."""
    bag = open_bag(path)
    try:
        return len(index_bag(bag).topics["/tf"])
    finally:
        bag.close()


def refusal_of(path: Path) -> str:
    with pytest.raises(DamagedDataError) as caught:
        messages_of(path)
    assert path.name in caught.value.message
    return caught.value.message


def test_chunks_of_ros_1_that_name_one_index_are_refused(tmp_path: Path) -> None:
    message = message1(TIME_NS)
    chunk = (b"none", message, len(message), index1([(TIME_NS, 0)] * 2000))
    assert messages_of(write_ros1(tmp_path / "once.bag", [chunk])) == 2000
    assert "name the same index" in refusal_of(write_ros1(tmp_path / "often.bag", [chunk], infos_per_chunk=300))


def test_chunks_of_ros_1_that_take_turns_are_unpacked_no_more_than_the_file_allows(tmp_path: Path) -> None:
    size = len(message1(TIME_NS))
    records = b"".join(message1(TIME_NS + n) for n in range(2000)) + bytes(16 << 20)
    packed = lz4.frame.compress(records)

    def bag(name: str, turns: int) -> Path:
        parts = [index1((TIME_NS + n, n * size) for n in range(first, turns, 2)) for first in (0, 1)]
        return write_ros1(tmp_path / name, [(b"lz4", packed, len(records), part) for part in parts])

    assert messages_of(bag("few.bag", 4)) == 4
    assert "times the file's size" in refusal_of(bag("many.bag", 2000))


def test_records_of_connections_before_a_message_of_ros_1_are_few(tmp_path: Path) -> None:
    connections = message1(TIME_NS).replace(b"op=\2", b"op=\7") * 100
    records = connections + message1(TIME_NS)
    chunk = (b"none", records, len(records), index1([(TIME_NS, 0)] * 100))
    assert "not at its place" in refusal_of(write_ros1(tmp_path / "lab.bag", [chunk]))


def test_an_mcap_index_that_names_a_chunk_twice_is_refused(tmp_path: Path) -> None:
    assert messages_of(write_mcap(tmp_path / "once.mcap", [message2(TIME_NS)])) == 1
    refused = refusal_of(write_mcap(tmp_path / "twice.mcap", [message2(TIME_NS)], indexes_per_chunk=2))
    assert "names a chunk twice" in refused


def test_a_chunk_of_very_many_records_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mcap_bag, "RECORDS_MAX", 100)
    assert messages_of(write_mcap(tmp_path / "few.mcap", [message2(TIME_NS) * 100])) == 100
    refused = refusal_of(write_mcap(tmp_path / "many.mcap", [message2(TIME_NS) + record2(0x99, b"") * 100]))
    assert "more than 100 records" in refused


def test_a_message_of_a_time_that_no_clock_has_is_refused(tmp_path: Path) -> None:
    last_ns = 2**63 - 1
    assert messages_of(write_mcap(tmp_path / "last.mcap", [message2(last_ns)])) == 1
    late = write_mcap(tmp_path / "late.mcap", [message2(last_ns + 1)])
    assert f"{last_ns + 1} ns" in refusal_of(late)


def test_a_message_that_waits_counts_as_its_whole_chunk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A small message that waits for its turn keeps its whole unpacked chunk in memory."""
    monkeypatch.setattr(mcap_bag, "WAITING_BYTES_MAX", 1 << 20)
    chunk = message2(TIME_NS) + record2(0x99, bytes(300_000))
    assert messages_of(write_mcap(tmp_path / "few.mcap", [chunk] * 3)) == 3
    assert "out of order" in refusal_of(write_mcap(tmp_path / "many.mcap", [chunk] * 4))


def database(path: Path, *statements: str) -> Path:
    """A bag of ROS 2 with one message, and what else is done to it."""
    with closing(sqlite3.connect(path)) as connection, connection:
        connection.executescript(
            "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT,"
            " offered_qos_profiles TEXT);"
            "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB);"
            "INSERT INTO topics VALUES (1, '/tf', 'tf2_msgs/msg/TFMessage', 'cdr', '')"
        )
        connection.execute("INSERT INTO messages VALUES (1, 1, ?, ?)", (TIME_NS, NO_TRANSFORMS_2))
        for statement in statements:
            connection.execute(statement)
    return path


@pytest.mark.parametrize("table", ["schema", "message_definitions", "metadata"])
def test_a_view_that_never_ends_is_not_read(table: str, tmp_path: Path) -> None:
    assert messages_of(database(tmp_path / "lab.db3", f"CREATE VIEW {table} AS {ENDLESS} SELECT max(n) FROM c")) == 1


@pytest.mark.parametrize(
    "instead",
    [
        f"CREATE VIEW messages AS {ENDLESS} SELECT n AS id, 1 AS topic_id, n AS timestamp, x'00' AS data FROM c",
        "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data AS (zeroblob(90)))",
        "CREATE VIRTUAL TABLE messages USING fts5(topic_id, timestamp, data)",
    ],
)
def test_messages_are_a_plain_table(instead: str, tmp_path: Path) -> None:
    path = database(tmp_path / "lab.db3", "ALTER TABLE messages RENAME TO other", instead)
    assert "no plain table 'messages'" in refusal_of(path)


@pytest.mark.parametrize("change", ["timestamp = 'soon'", "timestamp = NULL", "timestamp = 1e300", "data = 'text'"])
def test_values_of_other_kinds_are_refused(change: str, tmp_path: Path) -> None:
    refusal_of(database(tmp_path / "lab.db3", f"UPDATE messages SET {change}"))


def test_pages_that_lead_to_each_other_are_not_read_for_ever(tmp_path: Path) -> None:
    path = database(tmp_path / "lab.db3")
    with closing(sqlite3.connect(path)) as connection:
        ((root,),) = connection.execute("SELECT rootpage FROM sqlite_master WHERE name = 'messages'")
        ((page_bytes,),) = connection.execute("PRAGMA page_size")
    share_pages(path, root, page_bytes, depth=5)
    refusal_of(path)
