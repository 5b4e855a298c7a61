"""Pictures of values: colours with a fixed scale, and PNG files of 8-bit images without an imaging library.

A node without a value is grey, never the cold end of a palette; a pixel that sees nothing is dark. `legend` explains
the colours.
"""

import struct
import zlib
from dataclasses import dataclass
from enum import StrEnum
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from cairn_map.arrays import Rgb
from cairn_map.errors import BadInputError
from cairn_map.render.render_kernels import paint_into

SIGNATURE = b"\x89PNG\r\n\x1a\n"
LEVEL = 3
"""Level of zlib: a higher one takes several times as long for a tenth fewer bytes."""
RGB, UP = 2, 2
"""PNG's colour type, and its filter: each row's difference to the row above."""

Values = npt.NDArray[np.floating]

ZERO_CELSIUS_K = 273.15
NOTHING = (24, 26, 30)
"""Colour of pixels that see nothing."""
NO_VALUE = (112, 112, 112)
"""Colour of nodes without a value of the layer."""
TEXT = (230, 230, 230)
WARNING = (255, 210, 60)
EASY, MIDDLE, LIMIT, BLOCKED = (46, 125, 50), (235, 200, 60), (214, 69, 48), (96, 16, 24)
"""sRGB of difficulties 0, 0.5, 1, and more."""
INFERNO = "000004160b39420a686a176e932667bc3754dd513af37819fca50af6d746fcffa4"
VIRIDIS = "440154482475414487355f8d2a788e21918c22a88444bf707ad151bddf26fde725"
"""Eleven colours each, evenly spaced, of the palettes of these names (van der Walt and Smith)."""
DARKEST = 0.12
"""Fraction of the inferno palette at which painting begins: its first colours look like NOTHING."""


class Layer(StrEnum):
    """Quantity of a map that is drawn."""

    TEMPERATURE = "temperature"
    COLOUR = "colour"
    PROBABILITY = "probability"
    DEPTH = "depth"
    AGE = "age"
    HEIGHT = "height"
    SLOPE = "slope"
    STEP = "step"
    DIFFICULTY = "difficulty"


GROUND_LAYERS = frozenset({Layer.HEIGHT, Layer.SLOPE, Layer.STEP, Layer.DIFFICULTY})
"""Quantities of the ground, which level layers alone have."""


@dataclass(frozen=True, slots=True)
class Scale:
    """Colour scale: the values at the two ends of a layer's palette, the same in every picture."""

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
    Layer.HEIGHT: Scale(Layer.HEIGHT, 0.0, 10.0),
    Layer.SLOPE: Scale(Layer.SLOPE, 0.0, 45.0),
    Layer.STEP: Scale(Layer.STEP, 0.0, 0.5),
    Layer.DIFFICULTY: Scale(Layer.DIFFICULTY, 0.0, 1.0),
}
"""Default scale of each layer: degrees Celsius, 1, metres, seconds; of the ground metres, degrees, metres, 1."""


@lru_cache(maxsize=8)
def palette(layer: Layer) -> Rgb:
    """(256, 3) colours from the low to the high end; of ages, the newest is the brightest; of difficulties, the last
    one stands for all from the limit on.
    """
    if layer is Layer.DIFFICULTY:
        at = np.linspace(0, 1, 256)
        tones = zip(EASY, MIDDLE, LIMIT, strict=True)
        hues = np.stack([np.interp(at, (0.0, 0.5, 1.0), tone) for tone in tones], axis=1)
        hues[-1] = BLOCKED
        return np.asarray(np.rint(hues), np.uint8)
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


def png_of(rgb: npt.NDArray[np.uint8]) -> bytes:
    """An (H, W, 3) sRGB image as a PNG (ISO/IEC 15948); the same image always gives the same bytes."""
    H, W = rgb.shape[:2]
    rows = np.empty((H, 1 + 3 * W), np.uint8)
    rows[:, 0] = UP
    flat = rgb.reshape(H, 3 * W)
    rows[:1, 1:] = flat[:1]
    np.subtract(flat[1:], flat[:-1], out=rows[1:, 1:])
    head = struct.pack(">IIBBBBB", W, H, 8, RGB, 0, 0, 0)
    data = zlib.compress(rows.tobytes(), LEVEL)
    return SIGNATURE + b"".join(_chunk(name, body) for name, body in ((b"IHDR", head), (b"IDAT", data), (b"IEND", b"")))


def _chunk(name: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))
