"""Replies: frames of every kind, whole, in pieces, cut and flipped."""

import struct
import zlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.fixtures.map.made import KEY, made_cursor, made_frames
from tests.naive import wire as naive_wire

from cairn_map.errors import BadInputError, CairnError, DamagedDataError
from cairn_map.wire.frames import (
    BLOCK_LIMIT,
    FRAME_BYTES_MAX,
    JSON_BYTES_MAX,
    CellFrame,
    Frame,
    FrameKind,
    FrameReader,
    encode_frame,
    frames_of,
    start_of_reply,
)
from cairn_map.wire.messages import ReplyHeader

FRAMES = made_frames()
REPLY = start_of_reply() + b"".join(encode_frame(frame) for frame in FRAMES)


def same(a: Frame, b: Frame) -> bool:
    """Equal, where arrays of blocks are compared as lists."""
    if not isinstance(a, CellFrame) or not isinstance(b, CellFrame):
        return a == b
    fields = [[getattr(frame, name) for name in CellFrame.__dataclass_fields__ if name != "blocks"] for frame in (a, b)]
    blocks = [None if frame.blocks is None else frame.blocks.tolist() for frame in (a, b)]
    return fields[0] == fields[1] and blocks[0] == blocks[1]


def wrapped(kind: int, body: bytes) -> bytes:
    """A reply of one frame with a sound checksum, whatever is in it."""
    framed = struct.pack("<IB", len(body), kind) + body
    return start_of_reply() + framed + struct.pack("<I", zlib.crc32(framed))


def body_of(frame: Frame) -> bytes:
    return encode_frame(frame)[5:-4]


@pytest.mark.parametrize("frame", FRAMES, ids=[kind.name for kind in FrameKind])
def test_a_frame_of_every_kind_comes_back(frame: Frame) -> None:
    (back,) = frames_of(start_of_reply() + encode_frame(frame))
    assert same(back, frame)


def test_the_second_reader_agrees() -> None:
    assert naive_wire.frame_bodies(REPLY) == [(n + 1, body_of(frame)) for n, frame in enumerate(FRAMES)]


@given(st.lists(st.integers(0, len(REPLY)), max_size=30))
def test_pieces_of_any_size_give_the_same_frames(cuts: list[int]) -> None:
    ends = [*sorted(cuts), len(REPLY)]
    reader = FrameReader()
    pieces = [REPLY[start:end] for start, end in zip([0, *ends], ends, strict=False)]
    found = [frame for piece in pieces for frame in reader.feed(piece)]
    assert len(found) == len(FRAMES)
    assert all(map(same, found, FRAMES))
    assert reader.is_empty


def test_a_cut_reply_gives_the_frames_that_came_whole() -> None:
    ends = [5]
    for frame in FRAMES:
        ends.append(ends[-1] + len(encode_frame(frame)))
    for size in range(5, len(REPLY)):
        reader = FrameReader()
        assert len(list(reader.feed(REPLY[:size]))) == sum(end <= size for end in ends[1:])
        assert reader.is_empty == (size in ends)


def test_every_flipped_bit_is_noticed() -> None:
    for at in range(len(REPLY)):
        for bit in (0, 7):
            flipped = bytearray(REPLY)
            flipped[at] ^= 1 << bit
            with pytest.raises(CairnError):
                frames_of(bytes(flipped))


def test_the_first_bytes_are_checked_before_more_is_read() -> None:
    for start, error in ((b"HTTP/", DamagedDataError), (b"CRNS\x02", BadInputError)):
        with pytest.raises(error):
            list(FrameReader().feed(start))


@pytest.mark.parametrize(
    ("kind", "size"), [(4, FRAME_BYTES_MAX + 1), (1, JSON_BYTES_MAX + 1), (9, JSON_BYTES_MAX + 1), (6, (1 << 32) - 1)]
)
def test_a_frame_that_claims_too_much_is_refused_by_its_prefix(kind: int, size: int) -> None:
    with pytest.raises(BadInputError) as refused:
        list(FrameReader().feed(start_of_reply() + struct.pack("<IB", size, kind)))
    assert refused.value.kind == "too_large"


@pytest.mark.parametrize("kind", [0, 8, 255])
def test_unknown_types_are_refused_as_unknown(kind: int) -> None:
    with pytest.raises(BadInputError) as refused:
        frames_of(wrapped(kind, b""))
    assert refused.value.kind == "unknown_version"


STATE = FRAMES[2]
HEAD_BYTES = 105


@pytest.mark.parametrize(
    "blocks",
    [[3, 3], [3, 2], [BLOCK_LIMIT], [(1 << 32) - 1]],
)
def test_blocks_must_rise_and_lie_in_the_cell(blocks: list[int]) -> None:
    body = body_of(STATE)[:HEAD_BYTES] + struct.pack("<I", len(blocks)) + np.array(blocks, "<u4").tobytes()
    with pytest.raises(DamagedDataError, match="blocks must rise"):
        frames_of(wrapped(FrameKind.STATE, body))


@pytest.mark.parametrize("count", [1, 2, 1 << 20, (1 << 32) - 1])
def test_blocks_that_are_not_there_are_not_read(count: int) -> None:
    body = body_of(STATE)[:HEAD_BYTES] + struct.pack("<I", count)
    with pytest.raises(DamagedDataError, match="blocks are cut off"):
        frames_of(wrapped(FrameKind.STATE, body))


def test_a_state_may_list_no_block() -> None:
    (frame,) = frames_of(wrapped(FrameKind.STATE, body_of(STATE)[:HEAD_BYTES] + bytes(4)))
    assert isinstance(frame, CellFrame)
    assert frame.blocks is not None
    assert len(frame.blocks) == 0


@pytest.mark.parametrize("kind", [2, 3, 4, 5])
def test_cell_frames_cut_inside_a_sound_checksum_are_refused_or_shorter(kind: int) -> None:
    body = body_of(FRAMES[kind - 1])
    for size in range(HEAD_BYTES + (4 if kind == 3 else 0)):
        with pytest.raises(DamagedDataError):
            frames_of(wrapped(kind, body[:size]))


@pytest.mark.parametrize(
    ("at", "data"),
    [(0, struct.pack("<Q", 1 << 63)), (8, b"\x04"), (25, struct.pack("<q", -2)), (65, struct.pack("<q", -1))],
    ids=["cell number", "flag", "from", "to"],
)
def test_impossible_cell_heads_are_refused(at: int, data: bytes) -> None:
    body = bytearray(body_of(FRAMES[3]))
    body[at : at + len(data)] = data
    with pytest.raises(DamagedDataError):
        frames_of(wrapped(FrameKind.FULL, bytes(body)))


def test_a_reset_has_no_payload() -> None:
    with pytest.raises(DamagedDataError):
        frames_of(wrapped(FrameKind.RESET, body_of(FRAMES[4]) + b"x"))


TO = str(made_cursor())


@pytest.mark.parametrize(
    ("kind", "text"),
    [
        (1, "{}"),
        (1, '{"to":"' + TO + '","vector":{"a":[[0,"1"]]},"stable":{}}'),
        (1, '{"to":"' + TO + '","vector":{"a":[[0]]},"stable":{}}'),
        (1, '{"to":"' + TO + '","vector":{"a":[[0,1.5]]},"stable":{}}'),
        (1, '{"to":"' + TO + '","vector":{"a":[[0,true]]},"stable":{}}'),
        (1, '{"to":"' + TO + '","vector":{},"stable":{},"tip":[-1,"' + "0" * 64 + '"]}'),
        (1, '{"to":"' + TO + '","vector":{},"stable":{},"tip":[1e400,"' + "0" * 64 + '"]}'),
        (6, '{"to":"' + TO + '","rest":"' + "0" * 31 + '"}'),
        (6, '{"to":"' + TO + '","rest":"' + "0" * 32 + '\\n"}'),
        (7, '{"to":"' + "x" * 129 + '"}'),
        (7, "[" * 100_000),
        (7, "\ud800"),
    ],
)
def test_json_that_is_not_what_the_format_says_is_refused(kind: int, text: str) -> None:
    with pytest.raises(DamagedDataError) as refused:
        frames_of(wrapped(kind, text.encode(errors="surrogatepass")))
    assert refused.value.kind == "bad_message"


def test_cursors_and_vectors_of_a_header_are_checked_when_they_are_read() -> None:
    body = b'{"to":"x","vector":{"mole":[[0,999999999999999]]},"stable":{"mole.0123456789abcdef":[[5,4]]}}'
    (header,) = frames_of(wrapped(1, body))
    assert isinstance(header, ReplyHeader)
    for read in (lambda: header.to_cursor, lambda: header.coverage, lambda: header.stable_vector):
        with pytest.raises(BadInputError):
            read()


def test_the_cell_number_is_read_as_written() -> None:
    assert all(frame.cell == KEY for frame in frames_of(REPLY) if isinstance(frame, CellFrame))
