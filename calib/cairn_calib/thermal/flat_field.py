"""Flat field of a thermal camera: gain, offset and shading of its pixels, from images of an even surface.

    levelled = gain * counts + offset + shading          as if every pixel were the mean one

An even surface of one temperature, filling the view, gives offsets; of two or more, gains too. The lens and the
housing shine on the sensor as well, more on its corners than on its middle: that is the smooth part, `shading`. It is
kept apart because a shutter behind the lens, with which such cameras level themselves every few minutes, cannot see it:
after that the offsets are new and the shading is unchanged (`after_shutter`).

Each map has its standard deviation, from the images' noise: a pixel's level is surest between the temperatures that it
was shown, and less sure the further its counts are from them (`level_sigma`).
"""

import hashlib
import io
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from cairn_calib.rig.radiometry import MapsFile
from cairn_map.arrays import Floats, Singles
from cairn_map.errors import BadInputError, DamagedDataError

Mask = npt.NDArray[np.bool_]

SHADING_ORDER = 4
"""Order of the smooth part, a polynomial in x and y: a bowl, a ring and a tilt, and nothing of a pixel's size."""
GAIN_ERROR_MAX = 0.3
"""Distance of a pixel's gain from 1 beyond which the pixel is bad."""
STRAY_SIGMAS = 8.0
"""Robust standard deviations of the offsets, or of the residuals, beyond which a pixel is bad."""
GAIN_SIGMA = 0.02
"""Standard deviation of a pixel's gain from 1 where only one temperature was shown: as uncooled sensors scatter."""
FILE_BYTES_MAX = 64 << 20
SIGMAS = ("gain_sigma", "offset_sigma", "shading_sigma")
UNITS = "gain, gain_sigma: 1 (levelled counts per count); bad: true or false; all else: counts of the camera"


@dataclass(frozen=True, slots=True, eq=False)
class FlatField:
    """Maps of one camera, in counts; they change nothing of the mean pixel."""

    gain: Singles
    """(H, W), mean 1."""
    offset: Singles
    """(H, W) counts: the pixels' own, mean 0."""
    shading: Singles
    """(H, W) counts: lens and housing, smooth, mean 0."""
    bad: Mask
    """(H, W) True for each pixel that sees nothing."""
    at_counts: float = 0.0
    """Level, in counts, at which pixels are surest: the mean of those that were shown."""
    gain_sigma: Singles | None = None
    """(H, W) standard deviation of `gain`; None where unknown, as in older files."""
    offset_sigma: Singles | None = None
    """(H, W) counts: standard deviation of `offset + shading`, at `at_counts`."""
    shading_sigma: Singles | None = None
    """(H, W) counts: standard deviation of `shading` alone, which stays after a shutter's new offsets."""

    def level_counts(self, counts: npt.NDArray[np.generic]) -> Floats:
        """(H, W) counts as the mean pixel would have given them; NaN at bad pixels.

        Raises:
            BadInputError: of another size.
        """
        if counts.shape != self.gain.shape:
            raise BadInputError("image_size", f"the maps are of {self.gain.shape} pixels, the image {counts.shape}")
        level = self.gain * np.asarray(counts, np.float64) + self.offset + self.shading
        return np.where(self.bad, np.nan, level)

    def level_sigma(self, level: Floats) -> Floats:
        """(H, W) standard deviation that the maps leave in (H, W) levelled counts; 0 where unknown."""
        if self.gain_sigma is None or self.offset_sigma is None:
            return np.zeros(self.gain.shape)
        return np.asarray(np.hypot(self.offset_sigma, self.gain_sigma * (level - self.at_counts) / self.gain))

    def after_shutter(self, shutter: npt.NDArray[np.generic], *, sigma_counts: float = 0.0) -> "FlatField":
        """The same camera after it levelled itself: new offsets by an image of its shutter, the shading kept.

        Args:
            shutter: (H, W) counts, the mean of some images.
            sigma_counts: standard deviation of the noise that is left in a pixel of it.
        """
        seen = self.gain * np.asarray(shutter, np.float64)
        # Behind the lens the shutter shows no shading: its offsets are the pixels' own.
        middle = float(seen[~self.bad].mean())
        sigma = None if self.shading_sigma is None else np.hypot(self.shading_sigma, sigma_counts).astype(np.float32)
        return replace(self, offset=(middle - seen).astype(np.float32), offset_sigma=sigma, at_counts=middle)


@dataclass(frozen=True, slots=True)
class FlatFieldFit:
    """Maps, with the noise and the pattern that images keep with them."""

    flat_field: FlatField
    noise_counts: float
    """Standard deviation of a pixel's counts from image to image."""
    pattern_counts: float
    """Standard deviation of the differences that the maps leave in the images' mean; with one temperature, noise."""


def fit_flat_field(stacks: Sequence[npt.NDArray[np.generic]]) -> FlatFieldFit:
    """The maps from images of an even surface that fills the view.

    Args:
        stacks: for each temperature (K, H, W) counts, K images of it, two or more.

    Raises:
        BadInputError: none, of different sizes, or with fewer than two images.
    """
    if not stacks or any(s.ndim != 3 or len(s) < 2 or s.shape[1:] != stacks[0].shape[1:] for s in stacks):
        raise BadInputError("bad_flat_field", "a flat field needs two images or more of each temperature, of one size")
    # The mean image of each temperature, and a pixel's noise about it.
    means = np.array([np.asarray(s, np.float64).mean(axis=0) for s in stacks])
    variance = np.mean([np.asarray(s, np.float64).var(axis=0, ddof=1) for s in stacks], axis=0)
    noise = float(np.sqrt(np.median(variance)))
    # Gain: the slope that stretches a pixel's counts to the level, by least squares over the temperatures.
    level = np.median(means, axis=(1, 2))
    bad = np.zeros(means.shape[1:], np.bool_)
    gain = np.ones_like(means[0])
    about = means - means.mean(axis=0)
    spread = (about**2).sum(axis=0)
    if len(means) > 1:
        covariance = np.tensordot(level - level.mean(), about, axes=1)
        gain = covariance / np.where(spread > 0, spread, np.inf)
        # A dead pixel's counts do not rise, so its gain is arbitrary.
        bad |= np.abs(gain - 1) > GAIN_ERROR_MAX
    # Offset and shading together, then the smooth part, without strays: they would bend it.
    total = level.mean() - gain * means.mean(axis=0)
    shading = _fit_polynomial(np.where(bad, np.nan, total))[0]
    bad |= _mark_strays(total - shading)
    # What a pixel keeps after levelling; with two temperatures a line meets both, so it tells nothing.
    left = gain * means + total - level[:, None, None]
    bad |= _mark_strays(np.abs(left).max(axis=0)) if len(means) > 2 else False
    shading, leverage = _fit_polynomial(np.where(bad, np.nan, total))
    shading -= shading[~bad].mean()
    # Bad pixels have neutral maps.
    gain = np.where(bad, 1.0, gain)
    offset = np.where(bad, 0.0, total - shading)
    # Residuals with two numbers a pixel; with fewer than three temperatures only the noise is known.
    freedom = max(len(means) - 2, 1)
    pattern = float(np.sqrt((left[:, ~bad] ** 2).sum() / (freedom * (~bad).sum()))) if len(means) > 2 else 0.0
    pattern = max(pattern, noise / np.sqrt(min(len(s) for s in stacks)))
    gain_sigma = gain * pattern / np.sqrt(np.where(bad, np.inf, spread)) if len(means) > 1 else GAIN_SIGMA
    field = FlatField(
        gain.astype(np.float32),
        offset.astype(np.float32),
        shading.astype(np.float32),
        bad,
        at_counts=float(level.mean()),
        gain_sigma=np.broadcast_to(gain_sigma, bad.shape).astype(np.float32),
        offset_sigma=np.full(bad.shape, pattern / np.sqrt(len(means)), np.float32),
        shading_sigma=(leverage * (total - shading)[~bad].std()).astype(np.float32),
    )
    return FlatFieldFit(field, noise, pattern)


def write_flat_field(path: Path, flat_field: FlatField) -> MapsFile:
    """Write an .npz file of the maps; returns its entry in rig.json."""
    # Written in memory first, for the digest that rig.json states.
    buffer = io.BytesIO()
    maps = {name: getattr(flat_field, name) for name in ("gain", "offset", "shading", "bad", *SIGMAS)}
    maps = {name: each for name, each in maps.items() if each is not None}
    np.savez_compressed(buffer, at_counts=np.float64(flat_field.at_counts), units=np.array(UNITS), **maps)
    data = buffer.getvalue()
    path.write_bytes(data)
    return MapsFile(name=path.name, sha256=hashlib.sha256(data).hexdigest())


def read_flat_field(path: Path, expected: MapsFile) -> FlatField:
    """The maps in a file, the mirror of `write_flat_field`.

    Raises:
        BadInputError: missing, too large, or not the file that is meant.
        DamagedDataError: no such maps in it.
    """
    try:
        with path.open("rb") as file:
            data = file.read(FILE_BYTES_MAX + 1)
    except OSError as exc:
        raise BadInputError("missing_file", f"cannot read {path}: {exc.strerror}") from exc
    if len(data) > FILE_BYTES_MAX or hashlib.sha256(data).hexdigest() != expected.sha256:
        raise BadInputError(
            "wrong_maps", f"{path} is not the file that the radiometry was made with: its SHA-256 differs"
        )
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as maps:
            gain, offset, shading = (np.asarray(maps[name], np.float32) for name in ("gain", "offset", "shading"))
            bad = np.asarray(maps["bad"], np.bool_)
            # Files from before the standard deviations have the four maps alone.
            sigmas = {name: np.asarray(maps[name], np.float32) for name in SIGMAS if name in maps}
            at_counts = float(maps["at_counts"]) if "at_counts" in maps else 0.0
    except (ValueError, TypeError, KeyError, OSError, zipfile.BadZipFile) as exc:
        raise DamagedDataError("bad_maps", f"{path} holds no maps of a thermal camera: {exc}") from exc
    if gain.ndim != 2 or any(each.shape != gain.shape for each in (offset, shading, bad, *sigmas.values())):
        raise DamagedDataError("bad_maps", f"{path}: the maps are of different sizes")
    return FlatField(gain, offset, shading, bad, at_counts=at_counts, **sigmas)


def _fit_polynomial(values: Floats) -> tuple[Floats, Floats]:
    """(H, W) the polynomial in x and y nearest to values that are not NaN; (H, W) its sigma if theirs is 1."""
    y, x = np.meshgrid(*(np.linspace(-1, 1, n) for n in values.shape), indexing="ij")
    powers = [(i, j) for i in range(SHADING_ORDER + 1) for j in range(SHADING_ORDER + 1 - i)]
    terms = np.stack([x**i * y**j for i, j in powers], axis=-1)
    sound = np.isfinite(values)
    # Least squares over sound pixels; the sigma of the fit is sqrt(t^T (T^T T)^-1 t).
    found, *_ = np.linalg.lstsq(terms[sound], values[sound], rcond=None)
    inverse = np.linalg.inv(terms[sound].T @ terms[sound])
    return np.asarray(terms @ found), np.sqrt(np.einsum("yxi,ij,yxj->yx", terms, inverse, terms))


def _mark_strays(values: Floats) -> Mask:
    """(H, W) True for each value far from the median, by the median absolute deviation."""
    middle = np.median(values)
    spread = 1.4826 * float(np.median(np.abs(values - middle)))
    return np.asarray(np.abs(values - middle) > STRAY_SIGMAS * max(spread, 1e-9))
