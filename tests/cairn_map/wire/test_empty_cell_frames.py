"""Frames of many cells without evidence that are made at once: the same bytes as one by one."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.fixtures.map.made import SMALL

from cairn_map.codec.cell_code import encode_empty_cell
from cairn_map.commits.cursor import Cursor
from cairn_map.epochs.layer import MapLayer
from cairn_map.evidence.fingerprint import ZERO
from cairn_map.evidence.grid import CellKey
from cairn_map.wire import empty_cell_frames
from cairn_map.wire.empty_cell_frames import EmptyCellFrames
from cairn_map.wire.frames import CellFrame, FrameKind, encode_frame, frames_of, start_of_reply

KEYS = st.lists(st.integers(0, (1 << 63) - 1), min_size=1, max_size=20)
SIXTEEN = st.binary(min_size=16, max_size=16)
STATES = st.none() | st.builds(Cursor, SIXTEEN, st.integers(0, 1 << 60), SIXTEEN)
HEAD = Cursor(bytes(16), 7, bytes(range(16)))


@given(keys=KEYS, start=STATES, kind=st.sampled_from([FrameKind.FULL, FrameKind.RESET]), rows_min=st.integers(1, 21))
def test_frames_made_at_once_have_the_bytes_of_each(
    keys: list[int], start: Cursor | None, kind: FrameKind, rows_min: int
) -> None:
    """All bytes of each row, checksum included, are those of its frame encoded alone, and their sizes are counted."""
    many = EmptyCellFrames(
        kind=kind, cells=np.array(keys, np.uint64), from_cursor=start, to_cursor=HEAD, layer=MapLayer(geometry=SMALL)
    )
    single = [
        CellFrame(
            kind=kind,
            cell=CellKey(key),
            from_cursor=start,
            to_cursor=HEAD,
            fingerprint=ZERO,
            payload=encode_empty_cell(CellKey(key), SMALL) if kind is FrameKind.FULL else b"",
        )
        for key in keys
    ]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(empty_cell_frames, "ROWS_MIN", rows_min)
        data = b"".join(many.encoded())
    assert data == b"".join(map(encode_frame, single))
    assert frames_of(start_of_reply() + data) == single
    assert (many.count, many.size_bytes) == (len(single), sum(frame.size_bytes for frame in single))


def test_many_frames_come_in_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    """However many rows are made in one go, the bytes are the same."""
    many = EmptyCellFrames(
        kind=FrameKind.RESET,
        cells=np.arange(10, dtype=np.uint64),
        from_cursor=None,
        to_cursor=HEAD,
        layer=MapLayer(geometry=SMALL),
    )
    whole = b"".join(many.encoded())
    monkeypatch.setattr(empty_cell_frames, "ROWS_MAX", 3)
    monkeypatch.setattr(empty_cell_frames, "ROWS_MIN", 2)
    pieces = list(many.encoded())
    assert len(pieces) == 4
    assert b"".join(pieces) == whole


def test_a_few_frames_are_made_without_tables(monkeypatch: pytest.MonkeyPatch) -> None:
    """A request may name a state for each of 100 000 cells: a table for each took a minute."""
    monkeypatch.setattr(empty_cell_frames, "_crc_changes", None)
    for kind in (FrameKind.FULL, FrameKind.RESET):
        one = EmptyCellFrames(
            kind=kind, cells=np.array([5], np.uint64), from_cursor=None, to_cursor=HEAD, layer=MapLayer(geometry=SMALL)
        )
        assert len(b"".join(one.encoded())) > one.size_bytes
