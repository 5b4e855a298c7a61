"""Clouds that are cut off, spoilt or made up: each is read, or refused by name, and no head makes large arrays."""

import io
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from tests.fixtures.fusion import cloud_forms
from tests.fixtures.fusion.cloud_forms import FORMS, Write, on_grid

from cairn_fusion.clouds.cloud_file import read_cloud
from cairn_map.errors import BadInputError

POINTS = on_grid(np.random.default_rng(3).uniform(-9, 9, (40, 3)))


def one_file(folder: Path, write: Write) -> Path:
    write(folder / "cloud", POINTS)
    (path,) = (path for path in folder.iterdir() if path.name.startswith("cloud"))
    return path


@pytest.mark.parametrize("write", FORMS, ids=lambda form: form.__name__)
def test_a_file_that_is_cut_off_anywhere_is_refused_or_is_a_part(write: Write, tmp_path: Path) -> None:
    path = one_file(tmp_path, write)
    data = path.read_bytes()
    assert np.array_equal(read_cloud(path).points, POINTS)
    for size in sorted({*range(0, len(data), max(1, len(data) // 60)), len(data) - 1}):
        path.write_bytes(data[:size])
        try:
            found = read_cloud(path).points
        except BadInputError as exc:
            assert str(path) in exc.message
        else:
            # The points that are whole, and of a last line what is left of it.
            whole = max(0, len(found) - 1)
            assert np.array_equal(found[:whole], POINTS[:whole])


@pytest.mark.parametrize("write", FORMS, ids=lambda form: form.__name__)
@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_spoilt_bytes_are_refused_or_read_and_nothing_else(write: Write, tmp_path: Path, data: st.DataObject) -> None:
    for path in tmp_path.glob("cloud*"):
        path.unlink()
    path = one_file(tmp_path, write)
    raw = bytearray(path.read_bytes())
    for at in data.draw(st.lists(st.integers(0, min(len(raw), 600) - 1), min_size=1, max_size=6)):
        raw[at] = data.draw(st.integers(0, 255))
    path.write_bytes(raw)
    try:
        assert read_cloud(path).points.shape[1] == 3
    except BadInputError as exc:
        assert str(path) in exc.message


def test_a_file_at_which_the_decoder_of_laz_panics_is_refused(tmp_path: Path) -> None:
    path = one_file(tmp_path, cloud_forms.laz)
    raw = bytearray(path.read_bytes())
    raw[461] = 0  # number of items of a point
    path.write_bytes(raw)
    with pytest.raises(BadInputError, match="laspy cannot read it"):
        read_cloud(path)


def test_heads_that_announce_more_than_there_is_are_refused_before_any_array(tmp_path: Path) -> None:
    many = 1 << 23
    heads = {
        "a.pcd": f"FIELDS x y z\nSIZE 8 8 8\nTYPE F F F\nWIDTH {many}\nHEIGHT 1\nPOINTS {many}\nDATA binary\n".encode(),
        "b.pcd": f"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nPOINTS {1 << 60}\nDATA ascii\n".encode(),
        "c.pcd": b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nPOINTS 8000000\nDATA binary_compressed\n"
        + struct.pack("<II", 4, 96_000_000)
        + b"\0\0\0\0",
        "d.ply": f"ply\nformat ascii 1.0\nelement vertex {1 << 50}\nproperty float x\nend_header\n".encode(),
        "e.ply": b"ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty list int int n\nend_header\n\0",
        "f.npy": _npy_head("(4611686018427387904, 3)"),
        "g.npy": _npy_head("(5, 3)", "|O"),
        "h.npy": _archive(),
    }
    for name, data in heads.items():
        (tmp_path / name).write_bytes(data)
        with pytest.raises(BadInputError, match=name) as refused:
            read_cloud(tmp_path / name)
        assert refused.value.kind == "bad_cloud"


def _npy_head(shape: str, dtype: str = "<f8") -> bytes:
    text = f"{{'descr': '{dtype}', 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text.encode()


def _archive() -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("x.npy", _npy_head("(1, 3)") + b"\0" * 24)
    return buffer.getvalue()


def test_a_cloud_without_places_or_seen_from_elsewhere_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "cloud.pcd"
    cloud_forms.pcd_text(tmp_path / "cloud", POINTS)
    text = path.read_text()
    for change, match in (
        (("FIELDS x y z", "FIELDS a y z"), "no field x; it has a, y, z"),
        (("VIEWPOINT 0 0 0", "VIEWPOINT 0 0 1"), "points must be in the sensor's frame"),
        (("DATA ascii", "DATA zip"), "DATA 'zip': ascii, binary or binary_compressed is read"),
        (("SIZE 4 4 4", "SIZE 4 4 3"), "field 'z': no type F of size 3"),
    ):
        path.write_text(text.replace(*change))
        with pytest.raises(BadInputError, match=match):
            read_cloud(path)


def test_rows_of_no_place_are_no_points(tmp_path: Path) -> None:
    points = POINTS.copy()
    points[3], points[4, 1], points[5, 2] = 0, np.nan, np.inf
    cloud_forms.kitti_bin(tmp_path / "cloud", points)
    found = read_cloud(tmp_path / "cloud.bin").points
    assert np.flatnonzero(np.isnan(found).all(axis=1)).tolist() == [3, 4, 5]
