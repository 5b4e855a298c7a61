"""Dense depth: a range for every pixel of a camera, for the operator's eye and never for the map.

    drawn surface (coarse)  +  the picture  ->  range of each pixel, measured or filled in

A time-of-flight pixel is ten colour pixels wide, and the place in it where a thing ends is not measured. The picture
shows it: depth is carried to pixels of the same colour (joint bilateral upsampling, Kopf et al. 2007), by votes
weighted with the certainty of the range; of two surfaces in a window only one has a say, so that no range between them
comes out.

The result is a guess at edges. `DenseDepth` is no array and becomes none, and `Scan` refuses it: it never gets
into a map.
"""

from dataclasses import dataclass
from enum import IntEnum
from typing import Never

import cv2
import numpy as np
import numpy.typing as npt

from cairn_calib.rig.rig import Rig
from cairn_fusion.image_fusion.dense_depth_kernels import REACH, densify_into
from cairn_fusion.image_fusion.row_bands import run_in_bands
from cairn_fusion.image_fusion.surface import Drawn
from cairn_map.arrays import Bytes, Singles
from cairn_map.errors import BadInputError

ALIKE_SIGMA = 24.0
"""Standard deviation of the sum of three differences of 8-bit colours by noise and shading; edges differ more."""
CLOSE_SIGMA = 1.5
"""Standard deviation of the weight by distance, drawn pixels."""


class Origin(IntEnum):
    """Origin of a pixel's range."""

    NOTHING = 0
    """No range is known near it."""
    MEASURED = 1
    """Interpolated between ranges of one surface."""
    FILLED = 2
    """Estimated from ranges near it and the picture."""


@dataclass(frozen=True, slots=True, eq=False)
class DenseDepth:
    """Ranges of all pixels of a camera, for viewing."""

    camera: str
    """Camera with the pixels."""
    shown_m: Singles
    """(H, W) metres along the beam; NaN where nothing is known."""
    origins: Bytes
    """(H, W) `Origin` of each range."""
    drawn: Drawn
    """The coarse surface that it was made from."""

    def __array__(self, *_: object, **__: object) -> Never:
        """Refused: as an array it could get into a map."""
        raise BadInputError(
            "filled_depth", "an DenseDepth is partly guessed, and no range image: give the map the scan's"
        )


def dense_depth(
    drawn: Drawn, rig: Rig, camera: str, picture: npt.NDArray[np.generic], *, range_camera: str
) -> DenseDepth:
    """The depth of a camera's pixels.

    Args:
        drawn: the surface as that camera sees it.
        rig: with the camera.
        camera: camera with the pixels.
        picture: its image: (H, W, 3) uint8, sRGB, or (H, W) kelvin.
        range_camera: camera that measured; the weight of a range is one over its variance.
    """
    # Stage 1: the picture at full size, and averaged over each drawn pixel.
    guide = _guide(picture)
    height, width = guide.shape[:2]
    rows, columns = drawn.nearness.shape
    # Padded to whole drawn pixels, so that each is the mean of its own pixels alone.
    down, right = rows * drawn.step_px - height, columns * drawn.step_px - width
    whole = guide if not down and not right else cv2.copyMakeBorder(guide, 0, down, 0, right, cv2.BORDER_REPLICATE)
    coarse = np.asarray(cv2.resize(whole, (columns, rows), interpolation=cv2.INTER_AREA), dtype=np.uint8)
    # Stage 2: a vote's trust by the range noise; an unknown range, 1 / 0, has none.
    with np.errstate(divide="ignore"):
        sigma_m = rig[range_camera].range_sigma_m(1 / drawn.nearness)
    trust = (1 / np.square(sigma_m)).astype(np.float32)
    shown_m, origins = np.empty((height, width), np.float32), np.empty((height, width), np.uint8)

    # Stage 3: rows in bands, which share only what they read.
    def densify(first: int, last: int) -> None:
        near_px, step_px = drawn.per_pixel, drawn.step_px
        densify_into(
            shown_m,
            origins,
            guide,
            drawn.nearness,
            drawn.marks,
            trust,
            coarse,
            ALIKE,
            CLOSE,
            near_px,
            step_px,
            first,
            last,
        )

    run_in_bands(densify, height)
    return DenseDepth(camera, shown_m, origins, drawn)


def _guide(picture: npt.NDArray[np.generic]) -> Bytes:
    """(H, W, 3) uint8 guide: a colour picture, or a thermal one in grey between its outer percentiles."""
    if picture.ndim == 3:
        return np.ascontiguousarray(picture, dtype=np.uint8)
    # Outer percentiles, of every fourth row and column: one hot spot must not flatten all other contrast.
    kelvin = picture.astype(np.float32)
    low, high = np.nanpercentile(kelvin[::4, ::4], (1, 99))
    grey = np.clip((np.nan_to_num(kelvin, nan=low) - low) * (255 / max(high - low, 1e-3)), 0, 255).astype(np.uint8)
    return np.asarray(cv2.cvtColor(grey, cv2.COLOR_GRAY2RGB), dtype=np.uint8)


ALIKE = np.exp(-0.5 * np.square(np.arange(3 * 256) / ALIKE_SIGMA)).astype(np.float32).clip(1e-6)
# Squared distances of the window's drawn pixels from the middle of the block.
_PLACES = np.square(np.arange(2 * REACH + 2) - REACH - 0.5)
CLOSE = np.exp(-0.5 * (_PLACES[:, None] + _PLACES[None, :]) / CLOSE_SIGMA**2).astype(np.float32)
