"""Bytes from strangers: cut, flipped, random, made by hand. Only a `CairnError` may come out, or something sound.

Kernels check no bounds, so what gets past a decoder is also put through the kernels and the slow second decoder.
With `NUMBA_BOUNDSCHECK=1` and an empty `NUMBA_CACHE_DIR` they run with bounds checked.
"""

import os
import subprocess
import sys
import tracemalloc
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.fixtures.map.bombs import BOMBS, DEEP, cell_of_air, commit_of, largest_commit, reply
from tests.fixtures.map.made import (
    KEY,
    SMALL,
    as_dict,
    made_commit,
    made_frames,
    random_evidence,
    surface_evidence,
    voxels_below,
)
from tests.fixtures.map.stored import GROUPS, bodies_of, recoded, with_streams
from tests.naive import cell_code as naive_cell_code
from tests.naive import wire as naive_wire

from cairn_map.codec.cell_code import Profile, decode_cell, encode_cell
from cairn_map.commits.commit_reading import open_commit
from cairn_map.errors import CairnError
from cairn_map.evidence.brick_cell import brick_cell
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.fingerprint import fingerprint
from cairn_map.evidence.grid import Geometry
from cairn_map.wire.frames import FrameKind, encode_frame, frames_of, start_of_reply

EVIDENCE = random_evidence(8, SMALL, voxels=12, air=1)
CELL = encode_cell(KEY, EVIDENCE, SMALL).data
PLAIN_CELL = recoded(CELL, level=None)
MODELLED_CELL = encode_cell(KEY, voxels_below(surface_evidence(1, SMALL), 128), SMALL, profile=Profile.SMALL).data
COMMIT = made_commit().data
PLAIN_COMMIT = commit_of([PLAIN_CELL], SMALL)
FRAMES = made_frames()
REPLY = start_of_reply() + b"".join(encode_frame(frame) for frame in FRAMES)
MB = 1 << 20


def check_evidence(evidence: Evidence, geometry: Geometry) -> None:
    """Run all that programs do with evidence."""
    fingerprint(evidence, KEY)
    assert brick_cell(geometry, [evidence]).packed() == evidence
    assert decode_cell(encode_cell(KEY, evidence, geometry).data).evidence == evidence


def read_cell(data: bytes) -> None:
    """Decode; what comes out must be sound, and what the second decoder says."""
    decoded = decode_cell(data, evidence_bytes_max=MB)
    check_evidence(decoded.evidence, decoded.geometry)
    header, voxels = naive_cell_code.decode_cell(data)
    assert voxels == as_dict(decoded.evidence)
    assert header["digest"] == decoded.digest


def read_commit(data: bytes) -> None:
    commit, cells = open_commit(data, evidence_bytes_max=MB)
    assert naive_wire.commit_parts(data)[2] == commit.sha
    for cell in cells.values():
        check_evidence(cell.evidence, cell.geometry)


def read_reply(data: bytes) -> None:
    frames = frames_of(data)
    assert len(naive_wire.frame_bodies(data)) == len(frames)


Reader = Callable[[bytes], None]
READERS: list[tuple[Reader, bytes]] = [
    (read_cell, CELL),
    (read_cell, PLAIN_CELL),
    (read_cell, MODELLED_CELL),
    (read_commit, COMMIT),
    (read_commit, PLAIN_COMMIT),
    (read_reply, REPLY),
]
IDS = ["cell", "plain cell", "modelled cell", "commit", "plain commit", "reply"]
every_reader = pytest.mark.parametrize(("read", "sound"), READERS, ids=IDS)


def survives(read: Reader, data: bytes) -> bool:
    """True if the bytes were taken; any error but ours goes through."""
    try:
        read(data)
    except CairnError as exc:
        assert len(exc.message) < 1000
        return False
    return True


@every_reader
def test_sound_bytes_are_read(read: Reader, sound: bytes) -> None:
    assert survives(read, sound)


@every_reader
def test_bytes_cut_anywhere_are_refused(read: Reader, sound: bytes) -> None:
    ends = {5 + sum(len(encode_frame(frame)) for frame in FRAMES[:n]) for n in range(8)} if read is read_reply else {}
    for size in range(len(sound)):
        assert not survives(read, sound[:size]) or size in ends


@every_reader
def test_bytes_left_over_are_refused(read: Reader, sound: bytes) -> None:
    for more in (b"\0", b"\xff", sound):
        assert not survives(read, sound + more)


@pytest.mark.slow
@every_reader
def test_any_flipped_byte_is_refused_or_gives_something_sound(read: Reader, sound: bytes) -> None:
    for at in range(len(sound)):
        for flip in (0x01, 0x80, 0xFF):
            flipped = bytearray(sound)
            flipped[at] ^= flip
            survives(read, bytes(flipped))


@every_reader
@given(st.data())
def test_random_damage_is_refused_or_gives_something_sound(read: Reader, sound: bytes, data: st.DataObject) -> None:
    damaged = bytearray(sound)
    for at in data.draw(st.lists(st.integers(0, len(sound) - 1), min_size=1, max_size=6)):
        damaged[at] = data.draw(st.sampled_from([0, 1, 2, 7, 8, 9, 127, 128, 254, 255]))
    survives(read, bytes(damaged))


@pytest.mark.slow
@every_reader
@given(st.data())
def test_bytes_taken_out_or_put_in_are_refused_or_give_something_sound(
    read: Reader, sound: bytes, data: st.DataObject
) -> None:
    start, stop, at = (data.draw(st.integers(0, len(sound))) for _ in range(3))
    survives(read, sound[:at] + sound[min(start, stop) : max(start, stop)] + sound[at:])
    survives(read, sound[: min(start, stop)] + sound[max(start, stop) :])


@given(st.binary(max_size=300), st.sampled_from([b"", b"CRNC\x01\x01\x03\x00", b"CRCM\x01", b"CRNS\x01"]))
def test_random_bytes_are_refused(noise: bytes, start: bytes) -> None:
    for read in (read_cell, read_commit, read_reply):
        assert not survives(read, start + noise) or start + noise == start_of_reply()


@given(st.sampled_from([*FrameKind, 0, 8, 255]), st.integers(0, len(FRAMES) - 1), st.data())
def test_damage_under_a_sound_checksum_is_refused_or_gives_something_sound(
    kind: int, which: int, data: st.DataObject
) -> None:
    body = bytearray(encode_frame(FRAMES[which])[5:-4])
    for at in data.draw(st.lists(st.integers(0, len(body) - 1), max_size=4)):
        body[at] = data.draw(st.integers(0, 255))
    survives(read_reply, reply(kind, bytes(body)))


@pytest.mark.parametrize("first", list(GROUPS))
def test_modelled_bytes_that_are_cut_or_followed_by_more_are_refused_or_give_something_sound(first: int) -> None:
    """Under lengths that fit, so that the models read them."""
    stream = bodies_of(MODELLED_CELL)[first]
    body = stream.body
    others = [body[:size] for size in range(len(body))] + [
        body + bytes([more]) * count for more in (0, 255) for count in (1, 4)
    ]
    for other in others:
        survives(read_cell, with_streams(MODELLED_CELL, stream._replace(body=other)))


@given(st.sampled_from(list(GROUPS)), st.binary(max_size=200), st.integers(0, 60))
def test_noise_in_place_of_modelled_bytes_is_refused_or_gives_something_sound(
    first: int, noise: bytes, kept: int
) -> None:
    stream = bodies_of(MODELLED_CELL)[first]
    survives(read_cell, with_streams(MODELLED_CELL, stream._replace(body=stream.body[:kept] + noise)))


@pytest.mark.slow
@pytest.mark.parametrize("name", BOMBS)
def test_a_bomb_is_refused_within_bounds(name: str) -> None:
    decode, made = BOMBS[name]
    data = made()
    tracemalloc.start()
    try:
        with pytest.raises(CairnError):
            decode(data)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 300 * MB


@pytest.mark.processes
def test_all_bombs_together_stay_within_bounds_as_the_system_counts() -> None:
    """Bound of the whole process: tracemalloc does not see what zstd and the JSON parser allocate."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    command = [sys.executable, "-m", "tests.fixtures.map.bombs"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert int(done.stdout) < 600


def test_the_most_that_a_commit_can_unpack_to_stays_within_bounds() -> None:
    data = largest_commit()
    assert len(data) < 1000
    tracemalloc.start()
    try:
        _, cells = open_commit(data)
        held, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert sum(cell.evidence.size_bytes for cell in cells.values()) == 2 * 12 * 8**8
    assert held < 420 * MB
    assert peak < 900 * MB


def test_three_cells_of_air_are_too_much_for_a_commit() -> None:
    with pytest.raises(CairnError) as refused:
        open_commit(commit_of([cell_of_air((n, 0, 0)) for n in range(3)], DEEP))
    assert refused.value.kind == "too_large"
