"""Pictures from fused images: temperatures blended over colour, hatching where there is none, the legend, the hottest.

Every picture is (H, W, 3) uint8, R, G, B.
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np

from cairn_fusion.image_fusion.row_bands import run_in_bands
from cairn_fusion.view.paint_kernels import hottest_square, paint_into
from cairn_fusion.view.temperature_scale import PALETTE, ZERO_CELSIUS_K, TemperatureScale
from cairn_map.arrays import Labels, Rgb, Singles
from cairn_map.errors import BadInputError

TEXT = (240, 240, 240)
SHADOW = (0, 0, 0)
BAR_PX = 14
BAR_SHARE = 0.4
"""Length of the palette's bar, over the picture's height."""
MARGIN_PX = 12
CROSS_PX = 9
LABEL_GAP_PX = 6
"""Gap between the legend and the label of the hottest place."""
READABLE_PX = 240
"""Height up to which pictures are enlarged: legend and marker would cover half of them."""


@dataclass(frozen=True, slots=True)
class Emphasis:
    """Temperatures that are painted, and the strength of the paint."""

    alpha: float = 0.5
    """Weight of the palette's colour: 0 the picture alone, 1 the palette alone."""
    from_k: float = -math.inf
    """Lowest temperature that is painted, kelvin: with `to_k` infinite, hot things only."""
    to_k: float = math.inf
    """Highest temperature that is painted, kelvin: with `from_k`, an isotherm band."""

    def __post_init__(self) -> None:
        if not 0 <= self.alpha <= 1:
            raise BadInputError("bad_emphasis", f"alpha must be 0 to 1, got {self.alpha:g}")
        if not self.from_k < self.to_k:
            low, high = self.from_k - ZERO_CELSIUS_K, self.to_k - ZERO_CELSIUS_K
            raise BadInputError(
                "bad_emphasis", f"a band goes from a lower to a higher temperature, got {low:g}:{high:g}"
            )


@dataclass(frozen=True, slots=True)
class Hottest:
    """Hottest place in a picture: pixel x, y, and its temperature."""

    x: int
    y: int
    kelvin: float


def paint_over(base: Rgb, kelvin: Singles, labels: Labels, scale: TemperatureScale, emphasis: Emphasis) -> Rgb:
    """Picture with temperatures blended over it; hatched where the label is not OK or no temperature is known.

    Args:
        base: (H, W, 3) the picture beneath.
        kelvin: (H, W)
        labels: (H, W) `Label`.
        scale: of the palette.
        emphasis: temperatures that are painted.
    """
    out = np.empty_like(base)
    limits = (scale.low_k, scale.high_k, emphasis.from_k, emphasis.to_k, emphasis.alpha)

    def paint(first: int, last: int) -> None:
        rows = slice(first, last)
        paint_into(out[rows], base[rows], kelvin[rows], labels[rows], PALETTE, *limits, first)

    run_in_bands(paint, len(base))
    return out


def paint_alone(kelvin: Singles, labels: Labels, scale: TemperatureScale) -> Rgb:
    """Temperatures by the palette alone; hatched on dark grey where there is none."""
    return paint_over(np.full((*kelvin.shape, 3), 40, np.uint8), kelvin, labels, scale, Emphasis(alpha=1.0))


def enlargement(picture: Rgb) -> int:
    """Whole factor by which a picture is enlarged, so that there is room for text on it."""
    return -(-READABLE_PX // len(picture))


def enlarge(picture: Rgb) -> Rgb:
    """A copy of a picture, `enlargement` times as large, each pixel a square."""
    times = enlargement(picture)
    return picture.repeat(times, axis=0).repeat(times, axis=1)


def hottest(kelvin: Singles, labels: Labels) -> Hottest | None:
    """Hottest square of 3 x 3 pixels, by its mean: one noisy pixel does not count; None if no square is known."""
    x, y, kelvin_there = hottest_square(kelvin, labels)
    return Hottest(x, y, kelvin_there) if x >= 0 else None


def mark_hottest_into(picture: Rgb, place: Hottest, *, legend_end: tuple[int, int] = (0, 0)) -> None:
    """Draw a cross at the hottest place, and its temperature next to it, right of the legend that ends at x, y."""
    at, size = (place.x, place.y), _text_size(picture)
    for ink, width in ((SHADOW, 3), (TEXT, 1)):
        cv2.drawMarker(picture, at, ink, cv2.MARKER_CROSS, 2 * CROSS_PX, width)
    text = f"{place.kelvin - ZERO_CELSIUS_K:.1f} deg C"
    (width_px, height_px), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, size, 1)
    # Right of and below the cross, or on the other side at the picture's edge; never on the legend.
    right, below = place.x + CROSS_PX + 2, place.y + CROSS_PX + height_px
    x = right if right + width_px < picture.shape[1] else place.x - CROSS_PX - width_px
    y = below if below < picture.shape[0] else place.y - CROSS_PX
    x, y = max(x, 0), max(y, height_px)
    if y - height_px < legend_end[1] + LABEL_GAP_PX:
        x = max(x, legend_end[0] + LABEL_GAP_PX)
    write_into(picture, text, (x, y))


def draw_legend_into(picture: Rgb, scale: TemperatureScale) -> tuple[int, int]:
    """Draw the palette's bar at the left edge, with its ends and their origin; returns x, y of its end."""
    height, size = picture.shape[0], _text_size(picture)
    top, length = 2 * MARGIN_PX + round(36 * size), max(8, round(BAR_SHARE * height))
    bar = PALETTE[np.linspace(255, 0, length).astype(np.uint8)]
    bottom = min(top + length, height)
    picture[top:bottom, MARGIN_PX : MARGIN_PX + BAR_PX] = bar[: bottom - top, None]
    cv2.rectangle(picture, (MARGIN_PX, top), (MARGIN_PX + BAR_PX, bottom - 1), SHADOW, 1)
    # Three values next to the bar, and above it the scale's origin.
    celsius = [limit - ZERO_CELSIUS_K for limit in (scale.high_k, (scale.low_k + scale.high_k) / 2, scale.low_k)]
    step = round(8 * size)
    rows = (top + step, (top + bottom) // 2 + step // 2, bottom - 2)
    ends = [
        write_into(picture, f"{value:g}", (MARGIN_PX + BAR_PX + 6, y)) for value, y in zip(celsius, rows, strict=True)
    ]
    return max(*ends, write_into(picture, f"deg C, {scale.note}", (MARGIN_PX, top - MARGIN_PX - step))), bottom


def write_into(picture: Rgb, text: str, at: tuple[int, int]) -> int:
    """Write light text on a darkened ground, readable on anything; returns x of its end."""
    size, (x, y) = _text_size(picture), at
    (width, height), below = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, size, 1)
    ground = picture[max(y - height - 2, 0) : y + below, max(x - 2, 0) : x + width + 2]
    ground >>= 1
    cv2.putText(picture, text, at, cv2.FONT_HERSHEY_SIMPLEX, size, TEXT, 1, cv2.LINE_AA)
    return int(x + width)


def _text_size(picture: Rgb) -> float:
    return float(min(max(picture.shape[0] / 1000, 0.4), 1.0))
