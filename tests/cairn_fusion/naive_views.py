"""Slow twins of the kernels that fuse images for the eye."""

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Singles = npt.NDArray[np.float32]
Flags = npt.NDArray[np.bool_]
Labels = npt.NDArray[np.uint8]


def joined(range_m: Singles, labels: Labels, noise_m: Singles, dx: int, dy: int) -> Flags:
    def at(y: int, x: int) -> float:
        inside = 0 <= y < range_m.shape[0] and 0 <= x < range_m.shape[1]
        return float(range_m[y, x]) if inside and labels[y, x] == 0 else np.nan

    out = np.zeros(range_m.shape, bool)
    for y, x in np.ndindex(range_m.shape):
        step = at(y + dy, x + dx) - at(y, x)
        sides = np.array([at(y, x) - at(y - dy, x - dx), at(y + 2 * dy, x + 2 * dx) - at(y + dy, x + dx)])
        slant = max(0.0, float(np.nan_to_num(np.sign(step) * sides).max()))
        out[y, x] = abs(step) <= noise_m[y, x] + 2 * slant
    return out


def triangles(across: Flags, down: Flags) -> list[tuple[tuple[int, int], ...]]:
    """Corners (y, x) of all that are drawn."""
    found: list[tuple[tuple[int, int], ...]] = []
    for y, x in np.ndindex(across.shape[0] - 1, across.shape[1] - 1):
        a, b, c, d = (y, x), (y, x + 1), (y + 1, x), (y + 1, x + 1)
        edges = {(a, b): across[a], (c, d): across[c], (a, c): down[a], (b, d): down[b]}
        whole = all(edges.values())
        for corner, one, other in ((a, b, c), (d, b, c), (b, a, d), (c, a, d)):
            sides = [edges[min(corner, end), max(corner, end)] for end in (one, other)]
            # A whole square is cut once only.
            if all(sides) and (not whole or corner in (a, d)):
                found.append((corner, one, other))
    return found


def drawn(
    shape: tuple[int, int], corners: list[tuple[tuple[int, int], ...]], u: Floats, v: Floats, q: Floats
) -> Floats:
    out = np.zeros(shape)
    for triangle in corners:
        places = np.array([[u[c], v[c], 1.0] for c in triangle])
        if not np.isfinite(places).all() or abs(np.linalg.det(places)) < 1e-9:
            continue
        for row, column in np.ndindex(shape):
            share = np.linalg.solve(places.T, [column, row, 1.0])
            if (share >= -1e-12).all():
                out[row, column] = max(out[row, column], share @ [q[c] for c in triangle])
    return out


def squares(nearness: Floats, chosen: Flags, u: Floats, v: Floats, q: Floats, half_px: float) -> Floats:
    out = nearness.copy()
    rows, columns = np.indices(out.shape)
    for at in np.argwhere(chosen & np.isfinite(u)):
        y, x = at
        inside = (abs(columns - u[y, x]) <= half_px) & (abs(rows - v[y, x]) <= half_px)
        out[inside] = np.maximum(out[inside], q[y, x])
    return out


def bilinear(image: Singles, u: float, v: float) -> Floats:
    """(C,) of (H, W, C) at a place, the border going on outside."""
    u, v = np.clip(u, 0, image.shape[1] - 1), np.clip(v, 0, image.shape[0] - 1)
    x, y = int(min(u, image.shape[1] - 1)), int(min(v, image.shape[0] - 1))
    x1, y1 = min(x + 1, image.shape[1] - 1), min(y + 1, image.shape[0] - 1)
    a, b = u - x, v - y
    upper, lower = image[y, x] * (1 - a) + image[y, x1] * a, image[y1, x] * (1 - a) + image[y1, x1] * a
    return np.asarray(upper * (1 - b) + lower * b, dtype=np.float64)


def dense(
    picture: npt.NDArray[np.uint8],
    nearness: Singles,
    full: Flags,
    trust: Singles,
    coarse: npt.NDArray[np.uint8],
    alike: Singles,
    close: Singles,
    near_px: float,
    step_px: int,
    reach: int,
) -> tuple[Floats, Labels]:
    """Ranges and origins of `densify_into`, a pixel at a time."""
    height, width = picture.shape[:2]
    rows, columns = nearness.shape
    range_m, origins = np.full((height, width), np.nan), np.zeros((height, width), np.uint8)
    for y, x in np.ndindex(height, width):
        v, u = (y - (step_px - 1) / 2) / step_px, (x - (step_px - 1) / 2) / step_px
        i, j = int(np.floor(v)), int(np.floor(u))
        near_rows, near_columns = np.clip([i, i + 1], 0, rows - 1), np.clip([j, j + 1], 0, columns - 1)
        four = nearness[np.ix_(near_rows, near_columns)].astype(float)
        if four.min() > 0 and four.max() <= four.min() * 1.05:
            shares = np.outer([1 - (v - i), v - i], [1 - (u - j), u - j])
            range_m[y, x], origins[y, x] = 1 / (four * shares).sum(), 1
            continue
        if full[np.ix_(near_rows, near_columns)].any():
            continue
        votes = []
        for k in range(max(i - reach, 0), min(i + 1 + reach, rows - 1) + 1):
            for m in range(max(j - reach, 0), min(j + 1 + reach, columns - 1) + 1):
                if nearness[k, m] > 0:
                    other = int(np.abs(coarse[k, m].astype(int) - picture[y, x].astype(int)).sum())
                    weight = float(trust[k, m]) * float(close[k - i + reach, m - j + reach])
                    hand = float(np.hypot(k - v, m - u) <= near_px)
                    votes.append((float(nearness[k, m]), weight, float(alike[other]), hand))
        if not votes:
            continue
        q, weight, like, hand = np.array(votes).T
        weight, is_one = weight * like, q.max() <= q.min() * np.float32(1.05)
        near = np.ones(len(q), bool) if is_one else q > (q.min() + q.max()) / 2
        weight[near] *= hand[near]
        chosen = near if weight[near].sum() >= weight[~near].sum() else ~near
        if weight[chosen].any():
            range_m[y, x], origins[y, x] = 1 / np.average(q[chosen], weights=weight[chosen]), 2
    return range_m, origins
