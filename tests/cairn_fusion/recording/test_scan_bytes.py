"""Scans as bytes: the same scan again, bit for bit, or an error."""

import dataclasses
import io

import numpy as np
import pytest

from cairn_calib.rig.poses import look_at
from cairn_fusion.recording.scan import Scan
from cairn_fusion.recording.scan_bytes import decode_scan, encode_scan, move_scan, place_scan, read_images
from cairn_map.errors import DamagedDataError


def random_scan(seed: int) -> Scan:
    """All that a scan can hold, with NaNs of any payload."""
    rng = np.random.default_rng(seed)
    range_m = rng.integers(0, 1 << 32, (6, 8), dtype=np.uint32).view(np.float32)
    range_m[0, :2] = np.array([0x7FC00001, 0xFFC12345], np.uint32).view(np.float32)
    return Scan(
        time_s=float(rng.uniform(0, 2e9)),
        T_map_rig=look_at(rng.normal(size=3), rng.normal(size=3)),
        range_camera="tof",
        range_m=range_m,
        amplitude=rng.integers(0, 1 << 16, (6, 8)).astype(np.uint16) if seed % 2 else None,
        colour={name: rng.integers(0, 256, (5, 4, 3)).astype(np.uint8) for name in ("left", "right")[: seed % 3]},
        thermal={"far": rng.uniform(250, 400, (3, 7)).astype(np.float32)} if seed % 2 else {},
        labels={"left": rng.integers(0, 9, (5, 4)).astype(np.uint16)} if seed % 3 else {},
        label_names={0: None, 7: "wall"} if seed % 3 else {},
        scalars={"dose": float(rng.normal())},
        T_map_body=look_at(rng.normal(size=3), rng.normal(size=3)) if seed % 4 else None,
    )


@pytest.mark.parametrize("name", [["wall"], {"wall": 1}, 7, True])
def test_the_name_of_a_label_is_text(name: object) -> None:
    scan = dataclasses.replace(random_scan(1), label_names={7: name})
    with pytest.raises(DamagedDataError, match="name of a label"):
        decode_scan(encode_scan(scan))


def bits(value: object) -> object:
    if isinstance(value, np.ndarray):
        return value.dtype, value.shape, value.tobytes()
    return {name: bits(part) for name, part in value.items()} if isinstance(value, dict) else value


def bits_of(scan: Scan) -> dict[str, object]:
    return {field.name: bits(getattr(scan, field.name)) for field in dataclasses.fields(scan)}


@pytest.mark.parametrize("seed", range(12))
def test_a_scan_comes_back_bit_for_bit(seed: int) -> None:
    with np.errstate(invalid="ignore"):
        scan = random_scan(seed)
        assert bits_of(decode_scan(encode_scan(scan))) == bits_of(scan)


@pytest.mark.parametrize("seed", range(4))
def test_a_scan_that_moves_nowhere_is_the_same(seed: int) -> None:
    scan = random_scan(seed)
    turned = look_at([1, 2, 3], [3, 1, 1])
    assert bits_of(move_scan(scan, turned)) == bits_of(move_scan(move_scan(scan, turned), turned)) or seed
    moved = move_scan(scan, turned)
    if scan.T_map_body is not None and moved.T_map_body is not None:  # the body moved with the rig
        before, after = (np.linalg.inv(s.T_map_rig) @ s.T_map_body for s in (scan, moved) if s.T_map_body is not None)
        assert np.allclose(before, after, atol=1e-12)
    assert bits(moved.range_m) == bits(scan.range_m)


@pytest.mark.parametrize("seed", range(4))
def test_a_scan_is_placed_where_it_was_moved_to_bit_for_bit(seed: int) -> None:
    scan = random_scan(seed)
    moved = move_scan(scan, look_at([1, 2, 3], [3, 1, 1]))
    assert bits_of(place_scan(scan, moved.T_map_rig)) == bits_of(moved)


def test_the_images_of_a_scan_are_read_without_their_pixels() -> None:
    scan = random_scan(2)
    found = read_images(io.BytesIO(encode_scan(scan)))
    assert found == read_images(io.BytesIO(encode_scan(move_scan(scan, look_at([1, 2, 3], [3, 1, 1])))))
    assert ("range", "", scan.range_m.dtype.str, scan.range_m.shape) in found
    for damaged in (b"", b"\1\0", b"\4\0\0\0{}[]", b"\2\0\0\0{}"):
        with pytest.raises(DamagedDataError):
            read_images(io.BytesIO(damaged))


def test_damaged_bytes_are_refused() -> None:
    data = encode_scan(random_scan(3))
    rng = np.random.default_rng(1)
    for length in (0, 3, 4, 40, len(data) - 1):
        with pytest.raises(DamagedDataError):
            decode_scan(data[:length])
    refused = 0
    for at in rng.integers(0, len(data), 60).tolist():
        flipped = bytearray(data)
        flipped[at] ^= 1 << int(rng.integers(8))
        try:
            decode_scan(bytes(flipped))
        except DamagedDataError:
            refused += 1
    assert refused > 40  # a digit of a time or a name may read as another one
