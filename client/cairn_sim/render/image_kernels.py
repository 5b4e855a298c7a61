"""From hits to what each spectrum receives, and where a pixel sees more than one thing.

An image is cast once through its pixels' centres. Where neighbours show different things, a pixel's area is cast again
on a grid of finer rays, and what these receive is added up: light in the visible and far infrared, waves in the near
infrared. The mixed ranges at edges, `flying pixels`, follow from the waves; no formula makes them.

`render` is the caller that checks; tests/naive/images.py holds the slow twins.
"""

import math

import numpy as np
import numpy.typing as npt
from numba import njit

from cairn_map.arrays import Floats, Int32s, Singles
from cairn_sim.render.raycast_kernels import Hits

Longs = npt.NDArray[np.int64]

LIGHT_STEP = 0.02
"""Change of the cosine of incidence from pixel to pixel that counts as an edge: of a box, not of a round wall."""
GLOSS_EXPONENT = 60.0
"""Exponent of the cosine of incidence: a glossy face fades to half at 9 degrees from head-on (Phong 1975)."""
BLOOM_PX = 2
"""As far along each axis as a full pixel spills; what a pixel gets falls by e for each pixel of distance."""
PASS_LEFT = 0.85
"""Share of visible and near infrared light that passes a pane or returns from a mirror."""


@njit(cache=True, nogil=True, error_model="numpy")
def edge_pixels(hits: Hits, width: int, height: int, order: Int32s) -> Longs:
    """(E,) numbers, in the given order of all pixels, of the pixels with a neighbour that shows another solid."""
    _, _, _, seen, second, _, _, incidence, way, passes, _ = hits
    mark = np.zeros(width * height, np.uint8)
    for y in range(height):
        for x in range(width):
            here = y * width + x
            # Each pair of neighbours once: to the right and below; at the rim a pixel is its own neighbour.
            for there in (here + 1 if x + 1 < width else here, here + width if y + 1 < height else here):
                if (
                    seen[here] != seen[there]
                    or second[here] != second[there]
                    or way[here] != way[there]
                    or passes[here] != passes[there]
                    or abs(incidence[here] - incidence[there]) > LIGHT_STEP
                ):
                    mark[here] = 1
                    mark[there] = 1
    # In the caller's order, so that bundles of rays stay together.
    edges = np.empty(len(order), np.int64)
    count = 0
    for pixel in order:
        if mark[pixel]:
            edges[count] = pixel
            count += 1
    return edges[:count]


@njit(cache=True, nogil=True, error_model="numpy")
def finer_rays(rays: Floats, pixels: Longs, n: int) -> Floats:
    """(E n n, 3) unit rays that divide each pixel's area evenly, from the (H, W, 3) rays of the centres.

    A ray is the centre's plus its share of the step to the neighbours: right to second order, 0.01 px at the corner
    of the widest lens here.
    """
    height, width = rays.shape[:2]
    finer = np.empty((len(pixels) * n * n, 3))
    for e in range(len(pixels)):
        y, x = pixels[e] // width, pixels[e] % width
        left, right, up, down = max(x - 1, 0), min(x + 1, width - 1), max(y - 1, 0), min(y + 1, height - 1)
        # Where a lens folds back, the next pixel has no ray: the step is then taken on the other side alone.
        left, right = x if np.isnan(rays[y, left, 0]) else left, x if np.isnan(rays[y, right, 0]) else right
        up, down = y if np.isnan(rays[up, x, 0]) else up, y if np.isnan(rays[down, x, 0]) else down
        for j in range(n):
            for i in range(n):
                # Staggered: no two in a row or column of the grid, so that an edge along it moves smoothly over them.
                a, b = (i + (j + 0.5) / n) / n - 0.5, (j + 1 - (i + 0.5) / n) / n - 0.5
                # The ray at offsets (a, b) of a pixel from its centre, normalised.
                length = 0.0
                at = (e * n + j) * n + i
                for c in range(3):
                    across = (rays[y, right, c] - rays[y, left, c]) / max(right - left, 1)
                    along = (rays[down, x, c] - rays[up, x, c]) / max(down - up, 1)
                    finer[at, c] = rays[y, x, c] + a * across + b * along
                    length += finer[at, c] * finer[at, c]
                length = math.sqrt(length)
                for c in range(3):
                    finer[at, c] /= length
    return finer


@njit(cache=True, nogil=True, error_model="numpy")
def colours(
    hits: Hits, colours_srgb: Singles, grain: Floats, sky_srgb: Singles, light: Floats, ambient: float
) -> Singles:
    """(N, 3) sRGB, 0 to 255: the material's, its grain, and light: the even share, and one from afar that a face
    turned away from it lacks twice (so no place is black, and opposite walls differ). No shadows.
    """
    _, _, _, seen, second, pattern, normal, _, _, passes, _ = hits
    out = np.empty((len(seen), 3), np.float32)
    for i in range(len(seen)):
        k = seen[i]
        # Each pane or mirror on the way takes its share.
        left = PASS_LEFT ** passes[i] if passes[i] else 1.0
        if k < 0:
            for c in range(3):
                out[i, c] = left * sky_srgb[c]
            continue
        # Lambert's cosine to the light from afar.
        lambert = normal[i, 0] * light[0] + normal[i, 1] * light[1] + normal[i, 2] * light[2]
        factor = left * (ambient + (1.0 - ambient) * lambert) * (1.0 + grain[k] * pattern[i])
        for c in range(3):
            out[i, c] = factor * colours_srgb[k, second[i], c]
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def surface_values(hits: Hits, values: Singles, nothing: float) -> Singles:
    """(N,) of the (P, 2) values the one of the material that is seen; `nothing` where none is."""
    _, _, _, seen, second, _, _, _, _, _, _ = hits
    out = np.empty(len(seen), np.float32)
    for i in range(len(seen)):
        out[i] = values[seen[i], second[i]] if seen[i] >= 0 else nothing
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def returns(hits: Hits, diffuse: Singles, gloss: Singles, retroreflection: Singles) -> Singles:
    """(N,) light that returns to a lamp next to the lens, 1 from white 1 m ahead; through glass there and back."""
    _, _, path_m, seen, second, _, _, incidence, _, passes, _ = hits
    out = np.zeros(len(seen), np.float32)
    for i in range(len(seen)):
        k = seen[i]
        if k < 0:
            continue
        m = second[i]
        # Diffuse return by Lambert's law, retroreflectors multiply it; gloss after Phong on top.
        cosine = max(incidence[i], 0.0)
        reflected = diffuse[k, m] * cosine * retroreflection[k, m]
        if gloss[k, m] > 0.0:
            reflected += gloss[k, m] * cosine**GLOSS_EXPONENT
        # There and back; and the lamp's light thins with the square of the way.
        left = PASS_LEFT ** (2 * passes[i]) if passes[i] else 1.0
        out[i] = left * reflected / (path_m[i] * path_m[i])
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def mixed_waves(path_m: Floats, strength: Singles, n: int, wrap_m: float) -> tuple[Floats, Singles]:
    """Range and strength of pixels that receive n waves each: the phase and the length of the waves' sum.

    A wave that went d metres there and back has the phase 2 pi d / wrap. A pixel that receives none has range infinite.
    """
    pixels = len(path_m) // n
    range_m, total = np.full(pixels, np.inf), np.zeros(pixels, np.float32)
    for p in range(pixels):
        real, imaginary = 0.0, 0.0
        # The sum of n phasors: a range camera measures the phase of all light that a pixel receives.
        for i in range(p * n, p * n + n):
            if strength[i] > 0.0:
                phase = 2.0 * math.pi * path_m[i] / wrap_m
                real += strength[i] * math.cos(phase)
                imaginary += strength[i] * math.sin(phase)
        length = math.hypot(real, imaginary)
        if length > 0.0:
            # Its phase as a range within one wrap, its length as the amplitude.
            turn = math.atan2(imaginary, real) / (2.0 * math.pi)
            range_m[p] = wrap_m * (turn - math.floor(turn))
            total[p] = length / n
    return range_m, total


@njit(cache=True, nogil=True, error_model="numpy")
def bloomed(range_m: Floats, strength: Singles, spill: Singles, width: int, wrap_m: float) -> tuple[Floats, Singles]:
    """Range and strength of all pixels after each that spills gave its counts to those around it that do not.

    What is spilled is a wave of its own pixel's phase, and adds to the waves there as in `mixed_waves`.
    """
    height = len(range_m) // width
    real, imaginary = np.zeros(len(range_m)), np.zeros(len(range_m))
    # Weights by distance, which sum to one: no light is lost.
    weights = np.empty((2 * BLOOM_PX + 1, 2 * BLOOM_PX + 1))
    for j in range(-BLOOM_PX, BLOOM_PX + 1):
        for i in range(-BLOOM_PX, BLOOM_PX + 1):
            weights[j + BLOOM_PX, i + BLOOM_PX] = math.exp(-math.hypot(i, j)) if i or j else 0.0
    weights /= weights.sum()
    for p in range(len(spill)):
        if not spill[p] > 0.0:
            continue
        # Phasors that each full pixel gives to its neighbours.
        y, x = p // width, p % width
        phase = 2.0 * math.pi * range_m[p] / wrap_m
        cosine, sine = math.cos(phase), math.sin(phase)
        for v in range(max(y - BLOOM_PX, 0), min(y + BLOOM_PX + 1, height)):
            for u in range(max(x - BLOOM_PX, 0), min(x + BLOOM_PX + 1, width)):
                given = spill[p] * weights[v - y + BLOOM_PX, u - x + BLOOM_PX]
                real[v * width + u] += given * cosine
                imaginary[v * width + u] += given * sine
    # Neighbours: their own phasor and the spilled ones, as a range again.
    new_range_m, new_strength = range_m.copy(), strength.copy()
    for p in range(len(range_m)):
        if spill[p] > 0.0 or (real[p] == 0.0 and imaginary[p] == 0.0):
            continue
        if strength[p] > 0.0:
            phase = 2.0 * math.pi * range_m[p] / wrap_m
            real[p] += strength[p] * math.cos(phase)
            imaginary[p] += strength[p] * math.sin(phase)
        turn = math.atan2(imaginary[p], real[p]) / (2.0 * math.pi)
        new_range_m[p] = wrap_m * (turn - math.floor(turn))
        new_strength[p] = math.hypot(real[p], imaginary[p])
    return new_range_m, new_strength
