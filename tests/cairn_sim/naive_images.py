"""The slow, obvious twins of `cairn_sim.render.image_kernels`: whole arrays where they can be.

`bloomed` has its twin in test_targets.py, beside what it is for.
"""

import numpy as np
import numpy.typing as npt

from cairn_sim.render.image_kernels import GLOSS_EXPONENT, LIGHT_STEP, PASS_LEFT
from cairn_sim.render.raycast_kernels import Hits

Floats = npt.NDArray[np.float64]
Singles = npt.NDArray[np.float32]
Ints = npt.NDArray[np.integer]


def naive_edge_pixels(hits: Hits, width: int, height: int, order: Ints) -> list[int]:
    """Of the order's pixels those that differ from a neighbour in what they see, in its way or in its slant."""
    same = [a.reshape(height, width) for a in (hits.seen, hits.second, hits.way, hits.passes)]
    slant = hits.incidence.reshape(height, width)
    mark = np.zeros((height, width), dtype=bool)
    for axis in (0, 1):
        step = np.abs(np.diff(slant, axis=axis)).astype(np.float64) > LIGHT_STEP
        for shown in same:
            step |= np.diff(shown.astype(np.int64), axis=axis) != 0
        pad = [(0, 0), (0, 0)]
        for before in ((1, 0), (0, 1)):
            pad[axis] = before
            mark |= np.pad(step, pad)
    return [int(p) for p in order if mark.flat[p]]


def naive_finer_rays(rays: Floats, pixels: Ints, n: int) -> Floats:
    """Each pixel's centre plus its share of the mean step to those neighbours that have a ray, as a unit vector."""
    finer = []
    for pixel in pixels:
        y, x = divmod(int(pixel), rays.shape[1])
        across, along = _step(rays[y], x), _step(rays[:, x], y)
        for j in range(n):
            for i in range(n):
                # Of n^2 columns and n^2 rows each is taken once.
                u, v = (i * n + j + 0.5) / n**2 - 0.5, (j * n + n - 1 - i + 0.5) / n**2 - 0.5
                ray = rays[y, x] + u * across + v * along
                finer.append(ray / np.linalg.norm(ray))
    return np.array(finer).reshape(-1, 3)


def _step(line: Floats, at: int) -> Floats:
    """The mean of the steps from and to the neighbours in a line of rays, of those that there are."""
    steps = [line[k + 1] - line[k] for k in (at - 1, at) if 0 <= k < len(line) - 1]
    known = [step for step in steps if not np.isnan(step).any()]
    return np.mean(known, axis=0) if known else np.zeros(3)


def naive_colours(
    hits: Hits, colours_srgb: Singles, grain: Floats, sky_srgb: Singles, light: Floats, ambient: float
) -> Floats:
    """What is seen, times its grain and the light on it, or the sky; times what panes and mirrors leave."""
    bright = ambient + (1 - ambient) * hits.normal.astype(np.float64) @ light
    own = colours_srgb.astype(np.float64)[hits.seen, hits.second]
    own *= (bright * (1 + grain[hits.seen] * hits.grain))[:, None]
    left = PASS_LEFT ** hits.passes.astype(np.float64)
    return np.where((hits.seen < 0)[:, None], sky_srgb, own) * left[:, None]


def naive_surface_values(hits: Hits, values: Singles, nothing: float) -> list[float]:
    """One by one."""
    return [float(values[k, m]) if k >= 0 else nothing for k, m in zip(hits.seen, hits.second, strict=True)]


def naive_returns(hits: Hits, diffuse: Singles, gloss: Singles, retroreflection: Singles) -> list[float]:
    """Lambert's law with a retroreflector's gain, plus Phong's highlight; over the way squared."""
    light = []
    for n, (k, m) in enumerate(zip(hits.seen, hits.second, strict=True)):
        cosine = max(float(hits.incidence[n]), 0.0)
        lambert = float(diffuse[k, m]) * float(retroreflection[k, m]) * cosine
        phong = float(gloss[k, m]) * cosine**GLOSS_EXPONENT
        passed = PASS_LEFT ** int(hits.passes[n])
        light.append(passed**2 * (lambert + phong) / float(hits.path_m[n]) ** 2 if k >= 0 else 0.0)
    return light


def naive_wave(path_m: Floats, strength: Singles, n: int, wrap_m: float) -> npt.NDArray[np.complex128]:
    """The mean wave of each n: its length is the strength, its angle the range."""
    light = strength > 0
    waves = np.where(light, strength * np.exp(2j * np.pi * np.where(light, path_m, 0) / wrap_m), 0)
    return np.asarray(waves.reshape(-1, n).mean(axis=1))
