"""Pictures of the corners found in an image: overlays for inspection, and their thumbnails for the report."""

from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from cairn_calib.board.corners import Corners
from cairn_calib.rig.image_files import Grey
from cairn_map.arrays import Floats

Picture = npt.NDArray[np.uint8]

LONGEST_PX = 1000
"""Longest side of a picture, at least, pixels: small images are enlarged so that single corners can be seen."""
MARK_PX, FIRST_PX = 13, 30
"""Sides of a corner's cross, and of the square about the first one, pixels of the picture."""
STRETCH = (0.5, 99.8)
"""Percentiles of the counts that become black and white."""
BAND_PX = 28
"""Height of the band above the image that holds the title, pixels."""
THUMBNAIL_PX, JPEG_QUALITY = 320, 82
OUTSIDE = (217, 205, 201)
"""Colour of what a resampled picture does not show."""
FIRST, LAST, TEXT = (60, 60, 255), (255, 160, 40), (80, 255, 80)


def overlay(counts: Grey, corners: Corners | None, *, title: str) -> Picture:
    """(H, W, 3) uint8, OpenCV's B, G, R: the image with its corners, rows joined in order from red to blue.

    A cross marks each corner, a square the first one; gaps are hidden corners. No mark is round: a circle on a disc
    would look like its outline, badly fitted.
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
    """Write a PNG file of a picture."""
    path.write_bytes(encode_picture(picture))


def encode_picture(picture: Picture) -> bytes:
    """PNG of a picture."""
    return bytes(cv2.imencode(".png", picture)[1])


def thumbnail(path: Path) -> bytes | None:
    """A JPEG, 320 pixels wide, of a picture that `overlay` made and `write_picture` wrote; None if there is none."""
    image = _without_band(path)
    if image is None:
        return None
    height = max(1, round(image.shape[0] * THUMBNAIL_PX / image.shape[1]))
    small = cv2.resize(image, (THUMBNAIL_PX, height), interpolation=cv2.INTER_AREA)
    return bytes(cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1])


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
        cv2.drawMarker(picture, centre, colour, cv2.MARKER_CROSS, MARK_PX, 1, cv2.LINE_AA)
        if index == 0:
            cv2.drawMarker(picture, centre, FIRST, cv2.MARKER_SQUARE, FIRST_PX, 2, cv2.LINE_AA)


def resampled(path: Path, size_px: tuple[int, int], at: Floats) -> bytes | None:
    """A JPEG of a picture that `overlay` made of an image of `size_px`, sampled at (H, W, 2) pixels of that image.

    Grey where a pixel is NaN or outside; None if there is no picture.
    """
    picture = _without_band(path)
    if picture is None:
        return None
    # The picture may be an enlargement of the image; centres of pixels are at whole numbers in both.
    scale = picture.shape[1] / size_px[0]
    where = np.where(np.isfinite(at), (at + 0.5) * scale - 0.5, -1e6).astype(np.float32)
    x, y = np.ascontiguousarray(where[..., 0]), np.ascontiguousarray(where[..., 1])
    found = cv2.remap(picture, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=OUTSIDE)
    return bytes(cv2.imencode(".jpg", found, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1])


def _without_band(path: Path) -> Picture | None:
    """The picture in a file of `write_picture`, without its title; None if there is none."""
    try:
        data = np.frombuffer(path.read_bytes(), np.uint8)
    except OSError:
        return None
    picture = cv2.imdecode(data, cv2.IMREAD_COLOR) if data.size else None
    return None if picture is None or picture.shape[0] <= BAND_PX else np.asarray(picture[BAND_PX:], np.uint8)
