"""Image files that corners are looked for in, and pictures of what was found, to look at."""

from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from cairn_calib.board.corners import Corners
from cairn_map.errors import BadInputError, DamagedDataError

Grey = npt.NDArray[np.float32]
Picture = npt.NDArray[np.uint8]

FILE_BYTES_MAX = 256 << 20
LUMA_BGR = (0.114, 0.587, 0.299)
"""ITU-R BT.601."""
LONGEST_PX = 1000
"""At least this long is a picture, so that the corners of a small image can be told apart."""
SIGMAS = 150.0
"""Ellipses are drawn this many standard deviations large: corners are good to hundredths of a pixel."""
STRETCH = (0.5, 99.8)
BAND_PX = 28
"""Above the image, for the title."""
THUMBNAIL_PX, JPEG_QUALITY = 320, 82
FIRST, LAST, TEXT = (60, 60, 255), (255, 160, 40), (80, 255, 80)


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
    try:
        with path.open("rb") as file:
            data = file.read(FILE_BYTES_MAX + 1)
    except OSError as exc:
        raise BadInputError("missing_image", f"cannot read {path}: {exc.strerror}") from exc
    if len(data) > FILE_BYTES_MAX:
        raise BadInputError("image_too_large", f"{path} must be at most {FILE_BYTES_MAX} bytes, and is larger")
    flags = cv2.IMREAD_ANYDEPTH | cv2.IMREAD_ANYCOLOR | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags) if data else None
    except cv2.error as exc:
        raise DamagedDataError("bad_image", f"{path} cannot be decoded: {exc}") from exc
    if image is None:
        raise DamagedDataError("bad_image", f"{path} cannot be decoded: it is no PNG, JPEG or TIFF, or is damaged")
    counts = np.asarray(image, np.float32)
    return np.asarray(counts @ np.array(LUMA_BGR, np.float32) if counts.ndim == 3 else counts, np.float32), data


def overlay(counts: Grey, corners: Corners | None, *, title: str) -> Picture:
    """(H, W, 3) uint8, OpenCV's B, G, R: the image with its corners, rows joined in order from red to blue.

    The first corner is ringed twice. Ellipses are 150 standard deviations large; gaps are hidden corners.
    """
    low, high = np.percentile(counts, STRETCH)
    grey = np.clip((counts - low) / max(float(high - low), 1e-9) * 255, 0, 255).astype(np.uint8)
    scale = max(1, round(LONGEST_PX / max(grey.shape)))
    large = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_NEAREST)
    picture = np.asarray(cv2.cvtColor(large, cv2.COLOR_GRAY2BGR), np.uint8)
    if corners is not None:
        _draw(picture, corners, scale)
    band = np.full((BAND_PX, picture.shape[1], 3), 24, np.uint8)
    cv2.putText(band, title, (8, 19), cv2.FONT_HERSHEY_SIMPLEX, 0.5, TEXT, 1, cv2.LINE_AA)
    return np.concatenate([band, picture])


def write_picture(path: Path, picture: Picture) -> None:
    """A PNG file of a picture."""
    path.write_bytes(bytes(cv2.imencode(".png", picture)[1]))


def thumbnail(path: Path) -> bytes | None:
    """A JPEG, 320 pixels wide, of a picture that `overlay` made and `write_picture` wrote; None if there is none."""
    try:
        data = np.frombuffer(path.read_bytes(), np.uint8)
    except OSError:
        return None
    picture = cv2.imdecode(data, cv2.IMREAD_COLOR) if data.size else None
    if picture is None or picture.shape[0] <= BAND_PX:
        return None
    image = picture[BAND_PX:]
    height = max(1, round(image.shape[0] * THUMBNAIL_PX / image.shape[1]))
    small = cv2.resize(image, (THUMBNAIL_PX, height), interpolation=cv2.INTER_AREA)
    return bytes(cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1])


def write_grey16(path: Path, counts: npt.NDArray[np.uint16]) -> None:
    """A 16-bit PNG file of (H, W) counts."""
    path.write_bytes(bytes(cv2.imencode(".png", counts)[1]))


def _draw(picture: Picture, corners: Corners, scale: int) -> None:
    seen = corners.seen
    at = (corners.pixels + 0.5) * scale - 0.5
    previous: tuple[int, int] | None = None
    for index in np.flatnonzero(seen).tolist():
        share = index / max(len(seen) - 1, 1)
        colour = tuple(round(a + share * (b - a)) for a, b in zip(FIRST, LAST, strict=True))
        centre = (round(float(at[index, 0])), round(float(at[index, 1])))
        if previous is not None:
            cv2.line(picture, previous, centre, colour, 1, cv2.LINE_AA)
        previous = centre
        values, vectors = np.linalg.eigh(corners.covariance_px2[index])
        axes = tuple(max(3, round(SIGMAS * scale * float(np.sqrt(max(value, 0.0))))) for value in values)
        turn = float(np.degrees(np.arctan2(vectors[1, 0], vectors[0, 0])))
        cv2.ellipse(picture, centre, (min(axes[0], 60), min(axes[1], 60)), turn, 0, 360, colour, 1, cv2.LINE_AA)
        if index == 0:
            cv2.circle(picture, centre, 12, FIRST, 2, cv2.LINE_AA)
            cv2.circle(picture, centre, 16, FIRST, 1, cv2.LINE_AA)
