"""Stamps: which log entry last changed each block, and the `state` frames made from them (SYNC.md rules 2, 4, 10)."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.fixtures.map.made import SMALL, random_evidence
from tests.fixtures.server.fetching import fetch
from tests.fixtures.server.live import Live
from tests.fixtures.server.pushes import KEYS, MOLE, WREN, pushed, read, sum_of
from tests.naive.asker import NaiveAsker, cell_frames

from cairn_map.codec.cell_code import decode_cell
from cairn_map.commits.commit import Commit
from cairn_map.errors import DamagedDataError
from cairn_map.evidence.blocks import blocks_of, of_blocks, without_blocks
from cairn_map.evidence.evidence import packed_evidence
from cairn_map.evidence.grid import CellKey
from cairn_map.wire.frames import CellFrame, FrameKind
from cairn_server.store.stamps import (
    CellStamps,
    blocks_after,
    decode_cell_stamps,
    decode_stamps,
    encode_stamps,
    raised_stamps,
)
from cairn_server.store.store_rows import MapRow

SEQS = st.integers(1, (1 << 62) - 1) | st.integers(1, 40)


@given(st.lists(st.just(0) | SEQS, min_size=8, max_size=8))
def test_decode_undoes_encode(numbers: list[int]) -> None:
    stamps = np.array(numbers, np.int64)
    found = decode_stamps(encode_stamps(stamps), depth=3, lm=max(numbers))
    assert found.tolist() == numbers
    assert blocks_after(found, 20).tolist() == [n for n, seq in enumerate(numbers) if seq > 20]


@given(st.binary(max_size=60), st.integers(0, 1 << 40))
def test_bytes_that_are_no_stamps_are_refused(data: bytes, lm: int) -> None:
    good = encode_stamps(np.arange(8))
    for damaged in (data, good[: len(data) % len(good)], good + data):
        try:
            found = decode_stamps(damaged, depth=3, lm=lm)
        except DamagedDataError as exc:
            assert exc.kind == "damaged_store"
        else:
            assert found.shape == (8,) and (found <= lm).all() and (found >= 0).all()


@given(st.lists(st.tuples(st.sets(st.integers(0, 8**5 - 1), max_size=9), st.integers(1, 300)), max_size=9))
def test_stamps_under_change_are_encoded_as_dense_ones_are(changes: list[tuple[set[int], int]]) -> None:
    dense, paged = np.zeros(8**5, np.int64), CellStamps(7)
    for chosen, seq in changes:
        blocks = np.array(sorted(chosen), np.uint32)
        dense[blocks] = seq
        paged.put(blocks, seq)
    again = decode_cell_stamps(paged.encoded(), depth=7, lm=300)
    assert paged.encoded() == again.encoded() == encode_stamps(dense)
    assert paged.newest() == dense.max()
    for after in (0, 100):
        raised = raised_stamps(again.encoded(), after, 7, depth=7, lm=300)
        expected = np.where(dense > after, dense + 7, dense)
        assert decode_stamps(raised, depth=7, lm=307).tolist() == expected.tolist()


def test_a_store_without_stamps_takes_all_blocks_for_changed_with_their_cell() -> None:
    assert decode_stamps(b"", depth=3, lm=7).tolist() == [7] * 8


def test_stamps_newer_than_their_cell_are_refused() -> None:
    with pytest.raises(DamagedDataError, match="newer"):
        decode_stamps(encode_stamps(np.arange(8)), depth=3, lm=6)


@given(st.integers(0, 9), st.sets(st.integers(0, 7)))
def test_what_lies_in_blocks_and_what_lies_outside_are_all_of_it(seed: int, blocks: set[int]) -> None:
    evidence = random_evidence(seed, SMALL)
    chosen = np.array(sorted(blocks), np.uint32)
    inside, outside = of_blocks(evidence, chosen), without_blocks(evidence, chosen)
    places = [(*part.voxels.tolist(),) for part in (inside, outside)]
    assert sorted(places[0] + places[1]) == evidence.voxels.tolist()
    assert {place // 64 for place in places[0]} <= blocks and not {place // 64 for place in places[1]} & blocks
    assert sorted(blocks_of(evidence).tolist()) == sorted({place // 64 for place in evidence.voxels.tolist()})
    rows = [voxel for part in (inside, outside) for voxel in part.voxels[part.sampled].tolist()]
    assert sorted(rows) == evidence.voxels[evidence.sampled].tolist()


def touching(n: int, *blocks: int, author: object = WREN) -> Commit:
    """A commit that changes one voxel of some blocks of one cell."""
    places = np.array([64 * block + n for block in blocks], np.uint32)
    counts = np.tile(np.array([[0, 1]]), (len(places), 1))
    diff = packed_evidence(places, counts, np.zeros((len(places), SMALL.plane_count), np.int64), SMALL)
    return pushed(n, n, author, cells={KEYS[0]: diff})  # type: ignore[arg-type]


def one_frame(live: Live, row: MapRow, asker: NaiveAsker) -> CellFrame:
    found: dict[CellKey, CellFrame] = cell_frames(fetch(live, row, asker))
    assert found.keys() == {KEYS[0]}
    return found[KEYS[0]]


def settled(live: Live) -> tuple[MapRow, NaiveAsker]:
    """A map with evidence in all blocks of one cell, and an asker that has it."""
    row, asker = live.new_map(), NaiveAsker(MOLE, asks_for=("state", "full"))
    diff = random_evidence(3, SMALL, voxels=300)
    live.push(row, pushed(0, 0, WREN, cells={KEYS[0]: diff}))
    assert one_frame(live, row, asker).kind is FrameKind.FULL
    return row, asker


def test_a_state_frame_names_the_changed_blocks_and_no_others(live: Live) -> None:
    row, asker = settled(live)
    for n, blocks in ((1, (2,)), (2, (2, 5)), (3, (0,))):
        live.push(row, touching(n, *blocks))
        frame = one_frame(live, row, asker)
        assert frame.kind is FrameKind.STATE and frame.blocks is not None
        assert frame.blocks.tolist() == list(blocks)
    assert asker.map() == read(live.cells(row))


def test_a_branch_of_any_age_gets_what_changed_since_once(live: Live) -> None:
    row, asker = settled(live)
    for n in range(1, 40):
        live.push(row, touching(n, 1 + n % 2))
    frame = one_frame(live, row, asker)
    assert frame.kind is FrameKind.STATE and frame.blocks is not None
    assert frame.blocks.tolist() == [1, 2]
    assert asker.map() == read(live.cells(row))


def test_voxels_that_were_taken_out_again_leave_the_asker_too(live: Live) -> None:
    row, asker = settled(live)
    empty = [block for block in range(8) if not any(v // 64 == block for v in asker.base[KEYS[0]])]
    commit = touching(1, *(empty or [7]))
    live.push(row, commit)
    fetch(live, row, asker)
    live.retract(row, commit)
    frame = one_frame(live, row, asker)
    assert frame.kind is FrameKind.STATE
    assert asker.map() == read(live.cells(row))


def test_own_evidence_is_in_a_state_frame_and_not_added_twice(live: Live) -> None:
    row, asker = settled(live)
    asker.own[1] = touching(1, 4, author=MOLE)
    live.push(row, asker.own[1])
    frame = one_frame(live, row, asker)
    assert (frame.kind, frame.own_excluded) == (FrameKind.STATE, False)
    assert asker.map() == read(live.cells(row))


def test_of_delta_state_and_whole_the_smallest_is_sent(live: Live) -> None:
    row, asker = settled(live)
    asker.asks_for = ("delta", "state", "full")
    live.push(row, touching(1, 3))
    delta = one_frame(live, row, asker)
    assert delta.kind is FrameKind.DELTA
    assert len(decode_cell(delta.payload).evidence) == 1
    for n in range(2, 50):  # more entries than a delta may have
        live.push(row, touching(n, 3))
    assert one_frame(live, row, asker).kind is FrameKind.STATE
    for n in range(50, 60):
        live.push(row, touching(n, *range(8)))
    assert one_frame(live, row, asker).kind in (FrameKind.DELTA, FrameKind.FULL)
    assert asker.map() == read(live.cells(row)) and sum_of([]) == {}
