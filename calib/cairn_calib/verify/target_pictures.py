"""Pictures of every target as each camera saw it, with the found and the predicted centroid."""

import cv2
import numpy as np
import numpy.typing as npt

from cairn_calib.board.corner_pictures import Picture
from cairn_calib.verify.verification import TargetSighting

TILE_PX = 160
REACH = 1.6
"""Radii of the target from the tile's middle to its edge."""
COLUMNS = 8
TILES_MAX = 96
"""The first of a camera; all are in the JSON."""
FOUND, PREDICTED, TEXT, EDGE = (80, 255, 80), (0, 150, 255), (255, 255, 255), (0, 0, 0)


def target_tile(image: npt.NDArray[np.generic], sight: TargetSighting) -> Picture:
    """(160, 160, 3) uint8, B, G, R: the target enlarged; green cross: found there, orange: predicted.

    Args:
        image: (H, W) or (H, W, 3) of the sight's camera; R, G, B.
        sight: the sighting.
    """
    scale = TILE_PX / (2 * REACH * sight.disc_px)
    middle = sight.found_px
    # The centre of the top-left pixel is (0, 0), in the picture as in the tile.
    shift = (TILE_PX - 1) / 2 - scale * middle
    matrix = np.array([[scale, 0, shift[0]], [0, scale, shift[1]]])
    part = cv2.warpAffine(
        np.asarray(image, np.float32),
        matrix,
        (TILE_PX, TILE_PX),
        flags=cv2.INTER_NEAREST,
        borderMode=cv2.BORDER_REPLICATE,
    )
    grey = part if part.ndim == 2 else part.mean(axis=2)
    low, high = np.nanpercentile(grey, (1, 99))
    even = np.clip((np.nan_to_num(part, nan=low) - low) / max(float(high - low), 1e-9) * 255, 0, 255).astype(np.uint8)
    tile = np.asarray(cv2.cvtColor(even, cv2.COLOR_GRAY2BGR if even.ndim == 2 else cv2.COLOR_RGB2BGR), np.uint8)
    for at, colour in ((sight.predicted_px, PREDICTED), (sight.found_px, FOUND)):
        x, y = (round(float(v)) for v in scale * at + shift)
        cv2.drawMarker(tile, (x, y), colour, cv2.MARKER_CROSS, 16, 1)
    label, corner, font = f"{sight.range_m:.1f} m", (4, TILE_PX - 6), cv2.FONT_HERSHEY_SIMPLEX
    cv2.putText(tile, label, corner, font, 0.4, EDGE, 3, cv2.LINE_AA)
    cv2.putText(tile, label, corner, font, 0.4, TEXT, 1, cv2.LINE_AA)
    return tile


def tile_sheet(tiles: list[Picture]) -> Picture:
    """(H, W, 3) uint8, B, G, R: tiles side by side."""
    rows = -(-len(tiles) // COLUMNS)
    sheet = np.zeros((rows * TILE_PX, COLUMNS * TILE_PX, 3), np.uint8)
    for n, tile in enumerate(tiles):
        y, x = (TILE_PX * v for v in divmod(n, COLUMNS))
        sheet[y : y + TILE_PX, x : x + TILE_PX] = tile
    return sheet
