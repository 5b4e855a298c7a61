"""Memory for cells that requests decode: bounded together, in order, and taken wherever a request decodes."""

import ast
import threading
from pathlib import Path

import pytest

import cairn_server
from cairn_map.errors import UnreachableError
from cairn_map.evidence.grid import Geometry
from cairn_server.cell_room import DecodingRoom

SERVER = Path(cairn_server.__file__).parent
STORED = {"stored_history", "stored_surfaces", "decode_stored", "sum_of_contributions"}
READINGS = {
    *("stored_reading", "stored_surface_reading", "past_reading", "past_rows", "reading_at", "body_and_reading"),
    *("rows_around", "reading_of_body", "decode_rows"),
}
INSIDE = SERVER / "views" / "readings.py"
"""Module of decoders whose callers take the room."""
DECODERS = STORED | READINGS | {"decode_cell", "decode_canonical_cell", "check_canonical_history", "read_cell"}
LARGE = Geometry(depth=8)
ROOM_BYTES = 300_000_000
"""Memory for one grid of 256^3 voxels, not for two."""


def test_large_cells_are_decoded_one_at_a_time() -> None:
    room = DecodingRoom(ROOM_BYTES)
    most: list[int] = []

    def decode() -> None:
        with room.of_cell(LARGE, 1):
            most.append(room.taken_bytes)

    threads = [threading.Thread(target=decode) for _ in range(24)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(most) == 24
    assert set(most) == {12 << 24}
    assert room.taken_bytes == 0


def test_a_thread_that_is_inside_enters_again() -> None:
    room = DecodingRoom(ROOM_BYTES, wait_s=0)
    with room.of_cell(LARGE, 1), room.of_cell(LARGE, 1):
        assert room.taken_bytes == 12 << 24
    assert room.taken_bytes == 0


def test_a_cell_that_finds_no_room_in_time_is_busy_and_leaves_nothing_behind() -> None:
    room = DecodingRoom(ROOM_BYTES, wait_s=0)
    found: list[str] = []

    def decode() -> None:
        try:
            with room.of_cell(LARGE, 1):
                found.append("decoded")
        except UnreachableError as exc:
            found.append(exc.kind)

    with room.of_cell(LARGE, 1):
        thread = threading.Thread(target=decode)
        thread.start()
        thread.join()
    assert found == ["busy"]
    decode()
    assert found == ["busy", "decoded"]
    assert room.waiting == 0


@pytest.mark.parametrize("name", ["views", "sync", "http", "live", "folding/damaged_cells.py", "folding/cells.py"])
def test_requests_decode_cells_only_where_they_have_room(name: str) -> None:
    room = SERVER / name
    for path in [room] if room.is_file() else sorted(set(room.rglob("*.py")) - {INSIDE}):
        tree = ast.parse(path.read_text())
        with_room = {
            id(inner)
            for block in ast.walk(tree)
            if isinstance(block, ast.With) and any("DECODING" in ast.unparse(item) for item in block.items)
            for inner in ast.walk(block)
        }
        for node in ast.walk(tree):
            if isinstance(node, ast.Call):
                called = ast.unparse(node.func)
                is_decoder = called in DECODERS or called.endswith("cache.evidence")
                assert not is_decoder or id(node) in with_room, f"{path.name}:{node.lineno} decodes without room"


def test_folding_decodes_and_encodes_cells_only_where_it_has_room() -> None:
    tree = ast.parse((SERVER / "folding" / "cell_cache.py").read_text())
    with_room = {
        id(inner)
        for block in ast.walk(tree)
        if isinstance(block, ast.With) and any("_memory.room" in ast.unparse(item) for item in block.items)
        for inner in ast.walk(block)
    }
    calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call)]
    found = {ast.unparse(call.func): id(call) in with_room for call in calls}
    assert found["read"]
    assert found["stored.opened"]
    assert found["write_cell"]
    # And nowhere else is a cell decoded for a fold than in what the cache calls.
    assert "decode" not in "".join(found)
