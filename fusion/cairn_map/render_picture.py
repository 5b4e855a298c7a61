"""Values as colours with a fixed scale, and the legend that says what they mean.

What has no value is grey, never the cold end of a palette; where nothing is seen it is dark.
"""

from dataclasses import dataclass
from enum import StrEnum
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from cairn_map.errors import BadInputError
from cairn_map.paint_kernels import paint_into
from cairn_map.small_text import GLYPH_PX, text_width_px, write_text_into

Rgb = npt.NDArray[np.uint8]
Values = npt.NDArray[np.floating]

ZERO_CELSIUS_K = 273.15
NOTHING = (24, 26, 30)
"""Where nothing is seen."""
NO_VALUE = (112, 112, 112)
"""Of what is seen, but has no value of the layer."""
TEXT = (230, 230, 230)
LEGEND_PX = 32
BAR_PX = (160, 12)
"""Width at most, and height."""
INFERNO = "000004160b39420a686a176e932667bc3754dd513af37819fca50af6d746fcffa4"
VIRIDIS = "440154482475414487355f8d2a788e21918c22a88444bf707ad151bddf26fde725"
"""Eleven colours each, evenly spaced, of the palettes of these names (van der Walt and Smith)."""
DARKEST = 0.12
"""Where painting begins on the inferno: its first colours are those of nothing."""


class Layer(StrEnum):
    """What of a map is drawn."""

    TEMPERATURE = "temperature"
    COLOUR = "colour"
    PROBABILITY = "probability"
    DEPTH = "depth"
    AGE = "age"


@dataclass(frozen=True, slots=True)
class Scale:
    """How values become colours: between two ends, the same in every picture."""

    layer: Layer
    low: float
    high: float

    def __post_init__(self) -> None:
        if not -1e9 < self.low < self.high < 1e9:
            raise BadInputError(
                "bad_scale", f"a scale goes from a lower to a higher value, got {self.low}, {self.high}"
            )


SCALES = {
    Layer.TEMPERATURE: Scale(Layer.TEMPERATURE, 10.0, 50.0),
    Layer.PROBABILITY: Scale(Layer.PROBABILITY, 0.5, 1.0),
    Layer.DEPTH: Scale(Layer.DEPTH, 0.0, 10.0),
    Layer.AGE: Scale(Layer.AGE, 0.0, 3600.0),
    Layer.COLOUR: Scale(Layer.COLOUR, 0.0, 255.0),
}
"""Of each layer where nobody says another: degrees Celsius, 1, metres, seconds."""
TITLES = {
    Layer.TEMPERATURE: "temperature, C, apparent",
    Layer.PROBABILITY: "probability",
    Layer.DEPTH: "depth, m",
    Layer.AGE: "since the last change, s",
    Layer.COLOUR: "colour",
}


@lru_cache(maxsize=8)
def palette(layer: Layer) -> Rgb:
    """(256, 3) from the low to the high end; of age, the newest is the brightest."""
    anchors = INFERNO if layer is Layer.TEMPERATURE else VIRIDIS
    known = np.frombuffer(bytes.fromhex(anchors), np.uint8).reshape(-1, 3)
    first = DARKEST if layer is Layer.TEMPERATURE else 0.0
    at = np.linspace(first, 1, 256) * (len(known) - 1)
    colours = np.stack([np.interp(at, np.arange(len(known)), known[:, c]) for c in range(3)], axis=1)
    painted: Rgb = np.rint(colours[::-1] if layer in (Layer.AGE, Layer.DEPTH) else colours).astype(np.uint8)
    return painted


def painted(values: Values, scale: Scale) -> Rgb:
    """(H, W, 3) colours of (H, W) values in the scale's unit, or of (H, W, 3) colours; grey where they are NaN."""
    if values.ndim == 3:
        rgb = np.rint(np.clip(np.nan_to_num(values), 0, 255)).astype(np.uint8)
        rgb[np.isnan(values[..., 0])] = NO_VALUE
        return rgb
    flat = np.ascontiguousarray(values, np.float32).reshape(-1)
    rgb = np.empty((flat.size, 3), np.uint8)
    paint_into(flat, palette(scale.layer), scale.low, scale.high, np.array(NO_VALUE, np.uint8), rgb)
    return rgb.reshape(*values.shape, 3)


def with_legend(image: Rgb, scale: Scale) -> Rgb:
    """The image with a strip below: the palette with its two ends, and how what has no value looks."""
    W = image.shape[1]
    strip = np.full((LEGEND_PX, W, 3), NOTHING, np.uint8)
    middle = (LEGEND_PX - GLYPH_PX[1]) // 2 + 1
    x = 8
    if scale.layer is not Layer.COLOUR:
        x = _word(strip, f"{scale.low:g}", x, middle)
        width, height = min(BAR_PX[0], max(W // 4, 8)), BAR_PX[1]
        top, levels = (LEGEND_PX - height) // 2, np.linspace(0, 255, width).astype(np.uint8)
        bar = strip[top : top + height, x : x + width]
        bar[:] = palette(scale.layer)[levels][: bar.shape[1]]
        x = _word(strip, f"{scale.high:g}", x + width + 6, middle)
    x = _word(strip, TITLES[scale.layer], x + 6, middle)
    top = (LEGEND_PX - BAR_PX[1]) // 2
    strip[top : top + BAR_PX[1], x + 10 : x + 10 + 2 * BAR_PX[1]] = NO_VALUE
    _word(strip, f"no {scale.layer}", x + 16 + 2 * BAR_PX[1], middle)
    return np.concatenate([image, strip])


def _word(strip: Rgb, text: str, x: int, y: int) -> int:
    write_text_into(strip, text, (x, y), TEXT)
    return x + text_width_px(text) + 6
