import struct
import sys
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cairn_calib.rig.image_files import write_grey16
from cairn_fusion.recording.images import image_header, read_colour, read_grey16, write_colour
from cairn_map.errors import BadInputError, CairnError, DamagedDataError

SEED = 7


def noise(*shape: int, dtype: type = np.uint8) -> np.ndarray:
    return np.random.default_rng(SEED).integers(0, np.iinfo(dtype).max, shape, dtype=dtype, endpoint=True)


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png(width: int, height: int, *, pixels: bytes = b"", bits: int = 16, colour_type: int = 0) -> bytes:
    head = struct.pack(">IIBBBBB", width, height, bits, colour_type, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(pixels)) + chunk(b"IEND", b"")


def written(path: Path, data: bytes) -> Path:
    path.write_bytes(data)
    return path


def jpeg(image: np.ndarray) -> bytes:
    return cv2.imencode(".jpg", image)[1].tobytes()


def test_colour_reads_back_exactly(tmp_path: Path) -> None:
    image = noise(5, 7, 3)
    write_colour(tmp_path / "a.png", image)
    assert np.array_equal(read_colour(tmp_path / "a.png"), image)


def test_grey_of_16_bits_reads_back_exactly(tmp_path: Path) -> None:
    image = noise(5, 7, dtype=np.uint16)
    write_grey16(tmp_path / "a.png", image)
    assert np.array_equal(read_grey16(tmp_path / "a.png"), image)


def test_the_first_colour_channel_is_red_on_disk_too(tmp_path: Path) -> None:
    raw = b"".join(b"\0" + bytes([200, 100, 50]) for _ in range(2))
    path = written(tmp_path / "a.png", png(1, 2, pixels=raw, bits=8, colour_type=2))
    assert read_colour(path).tolist() == [[[200, 100, 50]], [[200, 100, 50]]]


def test_a_jpeg_reads_in_red_green_blue_order(tmp_path: Path) -> None:
    red = np.zeros((16, 16, 3), np.uint8)
    red[..., 2] = 255  # OpenCV's order, when encoding here
    image = read_colour(written(tmp_path / "a.jpg", jpeg(red)), (16, 16))
    assert image[8, 8, 0] > 240 and image[8, 8, 2] < 15


def test_a_grey_picture_becomes_three_equal_channels(tmp_path: Path) -> None:
    path = written(tmp_path / "a.png", png(1, 1, pixels=b"\0\x42", bits=8))
    assert read_colour(path).tolist() == [[[0x42] * 3]]


def test_the_header_tells_size_and_kind_without_opencv(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = written(tmp_path / "a.png", png(11, 13))
    monkeypatch.setitem(sys.modules, "cv2", None)
    header = image_header(path)
    assert (header.width, header.height, header.grey16) == (11, 13, True)


def test_a_jpeg_header_tells_the_size(tmp_path: Path) -> None:
    header = image_header(written(tmp_path / "a.jpg", jpeg(noise(9, 17, 3))))
    assert (header.width, header.height, header.grey16) == (17, 9, False)


def test_without_opencv_the_error_names_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = written(tmp_path / "a.png", png(1, 1, pixels=b"\0\0\0"))
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(BadInputError, match=r'pip install "cairn-robotics\[robot\]"') as caught:
        read_grey16(path)
    assert caught.value.kind == "missing_extra"


def test_a_picture_of_8_bits_is_no_depth_image(tmp_path: Path) -> None:
    path = written(tmp_path / "a.png", png(1, 1, pixels=b"\0\x42", bits=8))
    with pytest.raises(BadInputError) as caught:
        read_grey16(path)
    assert caught.value.kind == "image_type"


def test_another_size_than_expected_is_refused_by_name(tmp_path: Path) -> None:
    write_grey16(tmp_path / "a.png", noise(5, 7, dtype=np.uint16))
    with pytest.raises(BadInputError, match=r"a\.png must be 8 x 5 pixels, got 7 x 5") as caught:
        read_grey16(tmp_path / "a.png", (8, 5))
    assert caught.value.kind == "image_size"


def test_a_side_beyond_the_bound_is_refused_from_the_header_alone(tmp_path: Path) -> None:
    with pytest.raises(BadInputError) as caught:
        read_grey16(written(tmp_path / "a.png", png(16385, 1)))
    assert caught.value.kind == "image_too_large"


def test_a_file_beyond_the_bound_is_refused(tmp_path: Path) -> None:
    with (tmp_path / "a.png").open("wb") as file:
        file.truncate((256 << 20) + 1)
    with pytest.raises(BadInputError) as caught:
        read_colour(tmp_path / "a.png")
    assert caught.value.kind == "image_too_large"


@pytest.mark.parametrize("make", [lambda path: None, Path.mkdir])
def test_a_missing_file_and_a_folder_are_missing_images(tmp_path: Path, make) -> None:
    make(tmp_path / "a.png")
    with pytest.raises(BadInputError) as caught:
        read_colour(tmp_path / "a.png")
    assert caught.value.kind == "missing_image"


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"GIF89a",
        png(0, 4),
        b"\x89PNG\r\n\x1a\n",
        b"\xff\xd8\xff",
        b"\xff\xd8\xff\xda\x00\x02",
        png(4, 4, pixels=b"\0"),
    ],
)
def test_a_broken_image_is_damaged_data_that_names_the_file(tmp_path: Path, data: bytes) -> None:
    path = written(tmp_path / "a.png", data)
    with pytest.raises(DamagedDataError, match=r"a\.png") as caught:
        read_grey16(path) if data[:1] == b"\x89" else read_colour(path)
    assert caught.value.kind == "bad_image"


@settings(max_examples=60, deadline=None)
@given(bit=st.integers(min_value=0))
def test_any_flipped_bit_of_a_png_is_noticed(tmp_path_factory: pytest.TempPathFactory, bit: int) -> None:
    path = tmp_path_factory.mktemp("flip") / "a.png"
    write_grey16(path, noise(6, 6, dtype=np.uint16))
    data = bytearray(path.read_bytes())
    data[bit // 8 % len(data)] ^= 1 << bit % 8
    with pytest.raises(CairnError):
        read_grey16(written(path, bytes(data)))


@settings(max_examples=60, deadline=None)
@given(cut=st.floats(min_value=0, max_value=1, exclude_max=True), jpg=st.booleans())
def test_a_truncated_image_is_noticed(tmp_path_factory: pytest.TempPathFactory, cut: float, jpg: bool) -> None:
    path = tmp_path_factory.mktemp("cut") / "a"
    image = noise(16, 16, 3)
    write_colour(path, image)
    data = jpeg(image) if jpg else path.read_bytes()
    with pytest.raises(DamagedDataError):
        read_colour(written(path, data[: int(cut * len(data))]))


@settings(max_examples=100, deadline=None)
@given(data=st.binary(max_size=200))
def test_any_bytes_after_a_jpeg_signature_raise_and_never_crash(
    tmp_path_factory: pytest.TempPathFactory, data: bytes
) -> None:
    with pytest.raises(CairnError):
        read_colour(written(tmp_path_factory.mktemp("any") / "a.jpg", b"\xff\xd8\xff" + data))


def test_an_array_of_another_type_is_not_written(tmp_path: Path) -> None:
    with pytest.raises(BadInputError):
        write_grey16(tmp_path / "a.png", noise(4, 4))  # type: ignore[arg-type]
    with pytest.raises(BadInputError):
        write_colour(tmp_path / "a.png", noise(4, 4))
    assert not (tmp_path / "a.png").exists()
