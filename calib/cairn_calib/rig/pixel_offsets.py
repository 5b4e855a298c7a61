"""Map of the offsets that single pixels of a range camera add to its ranges, with its certainty, in `rig.json`.

    "pixel_offsets": {"width": 176, "height": 144, "unit": "0.0001 m", "encoding": "base64, zlib, little endian, rows",
     "offset": "eJz...", "sigma": "eJz...", "count": "eJz...", "pattern_sigma_m": 0.006, "noise_sigma_m": 0.008}

The map is part of the document, not a file of its own: every copy of the rig then has true ranges, and the rig's digest
covers the map. `pixel_pattern.py` estimates it.
"""

import base64
import binascii
import zlib
from functools import lru_cache
from typing import Annotated, Literal, Self

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field, model_validator

from cairn_calib.rig.raster import Side
from cairn_map.arrays import Floats

Counts = npt.NDArray[np.uint8]

UNIT_M = 1e-4
"""Unit of stored offsets and sigmas, metres: a hundredth of the noise; 16 bits reach 3.2 m."""
TEXT_MAX = 3 << 20
COUNT_MAX = 255
Text = Annotated[str, Field(max_length=TEXT_MAX)]
Metres = Annotated[float, Field(ge=0, le=3, allow_inf_nan=False)]


class PixelOffsets(BaseModel):
    """Metres that each pixel adds, their standard deviations, and the number of board ranges behind each."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    width: Side
    height: Side
    unit: Literal["0.0001 m"] = "0.0001 m"
    encoding: Literal["base64, zlib, little endian, rows"] = "base64, zlib, little endian, rows"
    offset: Text
    """(H, W) int16 in `unit`s; 0 where no board was."""
    sigma: Text
    """(H, W) uint16 in `unit`s; at least `pattern_sigma_m` where no board was."""
    count: Text
    """(H, W) uint8, 255 for more."""
    pattern_sigma_m: Metres
    """Standard deviation of the pixels' offsets about their mean."""
    noise_sigma_m: Metres
    """Standard deviation of a single range about its pixel's offset."""

    @model_validator(mode="after")
    def _is_of_its_size(self) -> Self:
        _ = self.offset_m, self.sigma_m, self.counts
        return self

    def __hash__(self) -> int:
        return hash((self.width, self.height, self.offset, self.sigma))

    @property
    def offset_m(self) -> Floats:
        """(H, W) metres, read-only."""
        return _metres(self.offset, "<i2", self.height, self.width)

    @property
    def sigma_m(self) -> Floats:
        """(H, W) metres, read-only."""
        return _metres(self.sigma, "<u2", self.height, self.width)

    @property
    def counts(self) -> Counts:
        """(H, W) ranges of boards, at most 255."""
        return _unpack(self.count, "u1", self.height, self.width).astype(np.uint8)

    @property
    def unseen_sigma_m(self) -> float:
        """Standard deviation of a pixel on which no board was, root mean square, metres; 0 without such pixels."""
        unseen = self.sigma_m[self.counts == 0]
        return float(np.sqrt(np.mean(unseen**2))) if len(unseen) else 0.0

    @property
    def mean_variance_m2(self) -> float:
        """Mean over all pixels of the variance of a pixel's offset, m^2."""
        return _mean_square(self.sigma, self.height, self.width)


def pixel_offsets(
    offset_m: Floats, sigma_m: Floats, counts: npt.NDArray[np.integer], *, pattern_sigma_m: float, noise_sigma_m: float
) -> PixelOffsets:
    """The map of (H, W) metres, standard deviations in metres, and counts."""
    return PixelOffsets(
        width=offset_m.shape[1],
        height=offset_m.shape[0],
        offset=_pack(np.clip(np.rint(offset_m / UNIT_M), -32767, 32767), "<i2"),
        # Upwards: no uncertainty is rounded away.
        sigma=_pack(np.clip(np.ceil(sigma_m / UNIT_M - 1e-9), 0, 65535), "<u2"),
        count=_pack(np.minimum(counts, COUNT_MAX), "u1"),
        pattern_sigma_m=pattern_sigma_m,
        noise_sigma_m=noise_sigma_m,
    )


def _pack(values: npt.NDArray[np.generic], dtype: str) -> str:
    return base64.b64encode(zlib.compress(values.astype(dtype).tobytes(), 9)).decode()


def _unpack(text: str, dtype: str, height: int, width: int) -> npt.NDArray[np.generic]:
    size = height * width * np.dtype(dtype).itemsize
    try:
        unpacker = zlib.decompressobj()
        data = unpacker.decompress(base64.b64decode(text, validate=True), size + 1)
    except (binascii.Error, zlib.error) as exc:
        raise ValueError(f"pixel_offsets is damaged: {exc}") from exc
    if len(data) != size or not unpacker.eof:
        raise ValueError(f"pixel_offsets is damaged, or not of {width} x {height} pixels: expected {size} bytes")
    return np.frombuffer(data, dtype).reshape(height, width)


@lru_cache(maxsize=16)
def _metres(text: str, dtype: str, height: int, width: int) -> Floats:
    metres = UNIT_M * _unpack(text, dtype, height, width).astype(np.float64)
    metres.setflags(write=False)
    return metres


@lru_cache(maxsize=16)
def _mean_square(text: str, height: int, width: int) -> float:
    return float(np.mean(_metres(text, "<u2", height, width) ** 2))
