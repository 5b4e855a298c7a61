"""Image files of any camera: bounded reading, grey counts, and PNG files of 8 and 16 bits.

OpenCV decodes and encodes. It is imported at the first image, since programs without images run without it.
"""

from pathlib import Path
from types import ModuleType

import numpy as np
import numpy.typing as npt

from cairn_map.errors import BadInputError, DamagedDataError

Grey = npt.NDArray[np.float32]
Grey16 = npt.NDArray[np.uint16]

FILE_BYTES_MAX = 256 << 20
"""Largest image file that is read, bytes: 256 MiB."""
LUMA_BGR = (0.114, 0.587, 0.299)
"""Weights of blue, green and red in luma: ITU-R BT.601."""


def opencv() -> ModuleType:
    """The module `cv2`.

    Raises:
        BadInputError: OpenCV is not installed; the message names the extra to install.
    """
    try:
        import cv2
    except ImportError as exc:
        raise BadInputError(
            "missing_extra", f'images need OpenCV: pip install "cairn-robotics[robot]" ({exc})'
        ) from exc
    return cv2


def read_bounded(path: Path, bytes_max: int) -> bytes:
    """The bytes of an image file.

    Raises:
        BadInputError: it cannot be read, or is larger than `bytes_max`.
    """
    try:
        with path.open("rb") as file:
            # One byte more than allowed tells a file that is too large, however much follows.
            data = file.read(bytes_max + 1)
    except OSError as exc:
        raise BadInputError("missing_image", f"cannot read {path}: {exc.strerror}") from exc
    if len(data) > bytes_max:
        raise BadInputError("image_too_large", f"{path} must be at most {bytes_max} bytes, and is larger")
    return data


def read_grey(path: Path) -> tuple[Grey, bytes]:
    """The counts of an image file, and its bytes.

    Args:
        path: PNG, JPEG or TIFF; 8 or 16 bits, grey or colour (then its luma). An EXIF orientation is not applied.

    Returns:
        (H, W) float32 counts, and the bytes of the file.

    Raises:
        BadInputError: missing, or larger than 256 MiB.
        DamagedDataError: it cannot be decoded.
    """
    data = read_bounded(path, FILE_BYTES_MAX)
    cv2 = opencv()
    flags = cv2.IMREAD_ANYDEPTH | cv2.IMREAD_ANYCOLOR | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags) if data else None
    except cv2.error as exc:
        raise DamagedDataError("bad_image", f"{path} cannot be decoded: {exc}") from exc
    if image is None:
        raise DamagedDataError("bad_image", f"{path} cannot be decoded: it is no PNG, JPEG or TIFF, or is damaged")
    counts = np.asarray(image, np.float32)
    return np.asarray(counts @ np.array(LUMA_BGR, np.float32) if counts.ndim == 3 else counts, np.float32), data


def write_grey16(path: Path, image: Grey16) -> None:
    """Write a 16-bit grey PNG file of an (H, W) uint16 array.

    Raises:
        BadInputError: the array is of another type or shape.
    """
    if image.dtype != np.uint16 or image.ndim != 2:
        raise BadInputError("image_type", f"counts must be uint16 (H, W), got {image.dtype} {image.shape}")
    path.write_bytes(encode_png(np.ascontiguousarray(image), path))


def encode_png(image: npt.NDArray[np.generic], path: Path) -> bytes:
    """The PNG file of an image whose channels are in OpenCV's order: blue, green, red; `path` is named in errors.

    Raises:
        BadInputError: PNG cannot hold an image of this type or shape.
    """
    done, data = opencv().imencode(".png", image)
    if not done:
        raise BadInputError("image_type", f"{path}: an image of shape {image.shape} cannot be written as PNG")
    return bytes(data)
