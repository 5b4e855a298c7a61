"""Image files: PNG read and written, JPEG read; a file's header is checked before any pixel is allocated.

    header (here, pure Python)  ->  bounds, kind, expected size  ->  pixels (OpenCV)

Colour is R, G, B here and everywhere in cairn; OpenCV's B, G, R does not leave this file. Every PNG chunk carries a CRC
and all are checked, so a flipped bit is an error and not a spot on the map. JPEG has none: only its start and its end
are checked.
"""

import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import numpy as np
import numpy.typing as npt

from cairn_calib.rig.image_files import FILE_BYTES_MAX, Grey16, encode_png, opencv, read_bounded
from cairn_calib.rig.raster import MAX_SIDE_PX
from cairn_map.errors import BadInputError, DamagedDataError

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
JPEG_SIGNATURE = b"\xff\xd8\xff"
JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
"""Markers SOF0..SOF15 (ITU T.81, table B.1); C4, C8 and CC in between mean other things."""
JPEG_BARE = frozenset([0x01, *range(0xD0, 0xD8)])
"""Markers without a length: TEM and the restarts."""

Colour = npt.NDArray[np.uint8]
Size = tuple[int, int]


@dataclass(frozen=True, slots=True)
class ImageHeader:
    """Header of an image file."""

    width: int
    height: int
    grey16: bool
    """True for one channel of 16 bits: the only kind that can hold range, amplitude or counts."""
    grey8: bool = False
    """True for one channel of 8 bits, which label images may have, too."""


def image_header(path: Path) -> ImageHeader:
    """Size and kind of an image file, without decoding it.

    Raises:
        BadInputError: missing, larger than 256 MiB, or a side over 16384 pixels.
        DamagedDataError: neither a sound PNG nor a JPEG.
    """
    return _header(_read_regular(path), path)


def read_colour(path: Path, size: Size | None = None) -> Colour:
    """The picture in a PNG or JPEG file; grey becomes three equal channels, 16 bits become 8, alpha is dropped.

    The raster is taken as stored: an EXIF orientation is not applied, since the camera model belongs to the raster.

    Args:
        path: the file.
        size: (width, height) that the image must have, if known; checked before pixels are allocated.

    Returns:
        (H, W, 3) uint8, sRGB, R, G, B order.

    Raises:
        BadInputError: as `image_header`, another size than expected, or OpenCV is not installed.
        DamagedDataError: the file cannot be decoded.
    """
    return colour_of_bytes(_read_regular(path), path, size)


def colour_of_bytes(data: bytes, path: Path | str, size: Size | None = None) -> Colour:
    """The picture in the bytes of a PNG or JPEG file, as `read_colour`; `path` names them in errors."""
    _check_size(_header(data, path), size, path)
    cv2 = opencv()
    bgr = _decode(cv2, data, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION, path)
    if bgr.dtype != np.uint8 or bgr.ndim != 3 or bgr.shape[2] != 3:
        raise DamagedDataError("bad_image", f"{path}: a colour image decoded to {bgr.dtype} of shape {bgr.shape}")
    return np.ascontiguousarray(bgr[..., ::-1], dtype=np.uint8)


def read_grey16(path: Path, size: Size | None = None) -> Grey16:
    """The (H, W) uint16 counts in a 16-bit grey PNG; arguments and errors as `read_colour`.

    Raises:
        BadInputError: also when the file holds 8 bits or colour, which is a picture *of* depth and not depth.
    """
    return grey16_of_bytes(_read_regular(path), path, size)


def grey16_of_bytes(data: bytes, path: Path | str, size: Size | None = None) -> Grey16:
    """The counts in the bytes of a 16-bit grey PNG file, as `read_grey16`; `path` names them in errors."""
    header = _header(data, path)
    if not header.grey16:
        raise BadInputError("image_type", f"{path} must be a PNG with one channel of 16 bits, and is not")
    _check_size(header, size, path)
    cv2 = opencv()
    counts = _decode(cv2, data, cv2.IMREAD_UNCHANGED, path)
    if counts.dtype != np.uint16 or counts.ndim != 2:
        raise DamagedDataError("bad_image", f"{path}: a 16-bit image decoded to {counts.dtype} of {counts.shape}")
    return np.ascontiguousarray(counts, dtype=np.uint16)


def read_labels(path: Path, size: Size | None = None) -> npt.NDArray[np.uint8 | np.uint16]:
    """The (H, W) numbers in a grey PNG of 8 or 16 bits; arguments and errors as `read_colour`.

    Raises:
        BadInputError: also when the file holds colours or a palette, which is a picture *of* labels.
    """
    return labels_of_bytes(_read_regular(path), path, size)


def labels_of_bytes(data: bytes, path: Path | str, size: Size | None = None) -> npt.NDArray[np.uint8 | np.uint16]:
    """The numbers in the bytes of a grey PNG file, as `read_labels`; `path` names them in errors."""
    header = _header(data, path)
    if header.grey16:
        return grey16_of_bytes(data, path, size)
    if not header.grey8:
        raise BadInputError(
            "image_type", f"{path} must be a PNG with one channel of 8 or 16 bits: a picture of labels is none"
        )
    _check_size(header, size, path)
    cv2 = opencv()
    numbers = _decode(cv2, data, cv2.IMREAD_UNCHANGED, path)
    if numbers.dtype != np.uint8 or numbers.ndim != 2:
        raise DamagedDataError("bad_image", f"{path}: an 8-bit image decoded to {numbers.dtype} of {numbers.shape}")
    return np.ascontiguousarray(numbers, dtype=np.uint8)


def write_labels(path: Path, image: npt.NDArray[np.uint8 | np.uint16]) -> None:
    """A grey PNG file of an (H, W) uint8 or uint16 image; mirror of `read_labels`."""
    path.write_bytes(encode_png(np.ascontiguousarray(image), path))


def write_colour(path: Path, image: Colour) -> None:
    """A PNG file of an (H, W, 3) uint8 R, G, B image; lossless mirror of `read_colour`."""
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
        raise BadInputError("image_type", f"colour must be uint8 (H, W, 3), got {image.dtype} {image.shape}")
    path.write_bytes(encode_png(np.ascontiguousarray(image[..., ::-1]), path))


def _decode(cv2: ModuleType, data: bytes, flags: int, path: Path | str) -> npt.NDArray[np.generic]:
    try:
        image: npt.NDArray[np.generic] | None = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), flags)
    except cv2.error as exc:
        raise DamagedDataError("bad_image", f"{path} cannot be decoded: {exc}") from exc
    if image is None:
        raise DamagedDataError("bad_image", f"{path} cannot be decoded")
    return image


def _read_regular(path: Path) -> bytes:
    # A named pipe in an image's place would block the reader.
    try:
        if not path.is_file():
            raise BadInputError("missing_image", f"{path} is missing, or is no file")
    except OSError as exc:
        raise BadInputError("missing_image", f"cannot read {path}: {exc.strerror}") from exc
    return read_bounded(path, FILE_BYTES_MAX)


def _header(data: bytes, path: Path | str) -> ImageHeader:
    try:
        if data.startswith(PNG_SIGNATURE):
            header = _png_header(data)
        elif data.startswith(JPEG_SIGNATURE):
            header = _jpeg_header(data)
        else:
            raise ValueError("neither PNG nor JPEG")
    except (ValueError, struct.error) as exc:
        raise DamagedDataError("bad_image", f"{path} is damaged: {exc}") from exc
    if header.width == 0 or header.height == 0:
        raise DamagedDataError("bad_image", f"{path} is damaged: {header.width} x {header.height} pixels")
    if max(header.width, header.height) > MAX_SIDE_PX:
        raise BadInputError(
            "image_too_large", f"{path}: sides must be at most {MAX_SIDE_PX}, got {header.width} x {header.height}"
        )
    return header


def _png_header(data: bytes) -> ImageHeader:
    """IHDR (PNG specification, 11.2.1), after every chunk's CRC was found right and IEND was reached."""
    header: ImageHeader | None = None
    at, kind = len(PNG_SIGNATURE), b""
    while kind != b"IEND":
        length, kind = struct.unpack_from(">I4s", data, at)
        (crc,) = struct.unpack_from(">I", data, at + 8 + length)
        if zlib.crc32(memoryview(data)[at + 4 : at + 8 + length]) != crc:
            raise ValueError(f"the CRC of chunk {kind!r} at byte {at} does not match")
        if (header is None) != (kind == b"IHDR"):
            raise ValueError("IHDR must be the first chunk, and come once")
        if header is None:
            width, height, bits, colour_type = struct.unpack_from(">IIBB", data, at + 8)
            header = ImageHeader(
                width, height, grey16=bits == 16 and colour_type == 0, grey8=bits == 8 and colour_type == 0
            )
        at += 12 + length
    if header is None:
        raise ValueError("no IHDR")
    return header


def _jpeg_header(data: bytes) -> ImageHeader:
    """The frame header (ITU T.81, B.2.2), after the start of a scan and an end of image were seen."""
    header: ImageHeader | None = None
    at = 2
    while True:
        prefix, marker = struct.unpack_from(">BB", data, at)
        if prefix != 0xFF:
            raise ValueError(f"a JPEG marker was expected at byte {at}")
        if marker == 0xFF:  # a fill byte
            at += 1
            continue
        if marker in JPEG_BARE:
            at += 2
            continue
        (length,) = struct.unpack_from(">H", data, at + 2)
        if marker in JPEG_FRAMES:
            height, width = struct.unpack_from(">HH", data, at + 5)
            header = ImageHeader(width, height, grey16=False)
        at += 2 + length
        if marker == 0xDA:
            break
    if header is None or data.find(b"\xff\xd9", at) < 0:
        raise ValueError("the JPEG has no frame header, or ends early")
    return header


def _check_size(header: ImageHeader, size: Size | None, path: Path | str) -> None:
    if size is not None and (header.width, header.height) != size:
        raise BadInputError(
            "image_size", f"{path} must be {size[0]} x {size[1]} pixels, got {header.width} x {header.height}"
        )
