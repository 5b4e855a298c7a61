"""A chessboard's lattice in a cloud of saddle points, with holes where something hides the board.

    saddles -> neighbours along edges (mutual, with bright and dark swapped) -> connected lattice -> holes and rims
    filled by prediction -> a lattice of just the board's size, or the reason why not

Neither the whole board nor a quiet border is needed, but each of the four outer rows of corners must be seen in part:
else nobody can say which corners they are.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cairn_calib.board.board import Board
from cairn_calib.board.homography import fit_homography, mapped
from cairn_calib.board.saddle_points import SaddlePoints
from cairn_map.arrays import Floats

Lattice = dict[tuple[int, int], int]

ANGLE_COS = np.cos(np.radians(22.0))
"""How far a neighbour may lie off an edge's direction: a lens bends it, noise turns it."""
SWAP_COS = 0.6
"""How well a neighbour's bright quarters are the mirror image of the corner's own."""
NEAR = 0.3
"""Of a step: how far a corner may lie from where its neighbours predict it."""
SEEN_MIN = 0.6
"""Share of the board's corners that must be seen."""
STRAY = 0.34
"""Of an outer row: with fewer corners than this share it is no part of the board."""
BENDS = 0.5
"""Between a step and the one before it, or beside it: share of that."""
GROW_MIN = 9
LONGER = 2.1
"""Longest step over the shortest at one corner: a board tilted by 60 degrees has 2, a step past a corner 2.2."""
ALIKE = 3.0
"""Ratio of strengths that neighbours may have; noise beside a board is much weaker."""
MORE = 4
"""Rows or columns of strays that may surround a board; whether the pattern goes on, grid_ends.py finds out."""
CROWDED_SEEN_MIN = 0.85
"""Share that must be seen where there are strays, which might fill a row that is hidden."""
NEAREST = 32
"""Saddles about one among which its neighbours are."""
TRIED = 6
"""Lattices of more than a few corners that are looked at."""


@dataclass(frozen=True, slots=True)
class NoGrid:
    """Why there is no lattice."""

    reason: str
    largest: int = 0
    """Corners of the largest lattice; 0 where there is none."""
    step_px: float = 0.0
    """From one of them to the next, in the image that was given."""


def saddle_grid(points: SaddlePoints, board: Board) -> Floats | NoGrid:
    """The board's corners among saddles.

    Returns:
        (rows, columns, 2) pixels x, y, NaN where a corner is not seen; rows and columns are the board's, but it is open
        which corner is the first; never mirrored. Or why there is none.
    """
    if len(points.pixels) < SEEN_MIN * board.count:
        return NoGrid(f"{len(points.pixels)} places look like a corner, the board has {board.count}")
    best: Lattice = {}
    neighbours = _neighbours(points)
    unseen = set(range(len(points.pixels)))
    tried = 0
    while unseen and tried < TRIED:
        lattice = _lattice(points, neighbours, start=min(unseen), unseen=unseen)
        unseen -= set(lattice.values())
        if len(lattice) < GROW_MIN:
            continue
        if _larger_side(lattice) <= max(board.columns, board.rows) + 2:
            lattice = _grown(lattice, points)
        lattice = _trimmed(lattice)
        grid = _as_board(lattice, points.pixels, board)
        if grid is not None:
            return grid
        best = max(best, lattice, key=len)
        tried += 1
    if not best:
        return NoGrid(f"{len(points.pixels)} places look like a corner, but no {GROW_MIN} of them form a lattice")
    across, down = (max(key[k] for key in best) - min(key[k] for key in best) + 1 for k in (0, 1))
    return NoGrid(
        f"the largest lattice has {across} x {down} corners, {len(best)} of them seen; the board has "
        f"{board.columns} x {board.rows}",
        largest=len(best),
        step_px=_step_px(best, points.pixels),
    )


def _neighbours(points: SaddlePoints) -> npt.NDArray[np.intp]:
    """(N, 2, 2) index of the next saddle along each edge, forwards and backwards; -1 for none."""
    count = len(points.pixels)
    far = np.linalg.norm(points.pixels[None] - points.pixels[:, None], axis=2)
    far[np.diag_indices(count)] = np.inf
    near = (
        np.argpartition(far, NEAREST, axis=1)[:, :NEAREST] if count > NEAREST else np.tile(np.arange(count), (count, 1))
    )
    far = np.take_along_axis(far, near, axis=1)
    to = points.pixels[near] - points.pixels[:, None]
    unit = to / np.where(np.isfinite(far), far, 1.0)[..., None]
    # (N, K, 2) along each of both edges, of the saddle itself and of the other one.
    cos = unit @ np.swapaxes(points.edges, 1, 2)
    their = np.abs((points.edges[near] * unit[:, :, None]).sum(axis=-1)) > ANGLE_COS
    along = np.abs(cos) > ANGLE_COS
    # Past the edge between them, bright and dark are mirrored.
    across = (unit @ points.bright[..., None])[..., 0]
    mirrored = 2 * across[..., None] * unit - points.bright[:, None]
    swapped = np.abs((mirrored * points.bright[near]).sum(axis=-1)) > SWAP_COS
    ratio = np.abs(np.log(points.strength[:, None] / points.strength[near]))
    fits = along.any(axis=2) & their.any(axis=2) & swapped & (ratio < np.log(ALIKE))
    found, own = np.full((count, 2, 2), -1, np.intp), np.full((count, 2, 2), np.inf)
    every = np.arange(count)
    for edge in (0, 1):
        for way, sign in ((0, 1), (1, -1)):
            distance = np.where(fits & along[..., edge] & (sign * cos[..., edge] > 0), far, np.inf)
            nearest = distance.argmin(axis=1)
            own[:, edge, way] = distance[every, nearest]
            found[:, edge, way] = np.where(np.isfinite(own[:, edge, way]), near[every, nearest], -1)
    found = _of_one_size(found, own)
    back = (found[found] == every[:, None, None, None, None]).any(axis=(3, 4))
    return np.where((found >= 0) & back, found, -1)


def _of_one_size(found: npt.NDArray[np.intp], own: Floats) -> npt.NDArray[np.intp]:
    """Neighbours without those much further away (`own`) than the nearest one of either end."""
    nearest = own.min(axis=(1, 2))
    limit = LONGER * np.minimum(nearest[:, None, None], nearest[np.maximum(found, 0)])
    return np.where(own <= limit, found, -1)


def _lattice(points: SaddlePoints, neighbours: npt.NDArray[np.intp], *, start: int, unseen: set[int]) -> Lattice:
    """All saddles connected to one, by their column and row relative to it."""
    first = points.edges[start].copy()
    if first[0, 0] * first[1, 1] - first[0, 1] * first[1, 0] < 0:
        first[1] = -first[1]
    placed = {start: (0, 0)}
    frames = {start: first}
    lattice = {(0, 0): start}
    waiting = [start]
    while waiting:
        here = waiting.pop(0)
        for there in neighbours[here].ravel().tolist():
            if there < 0 or there in placed or there not in unseen:
                continue
            step = points.pixels[there] - points.pixels[here]
            cos = frames[here] @ step
            axis = int(np.abs(cos).argmax())
            column, row = placed[here]
            way = 1 if cos[axis] > 0 else -1
            key = (column + way, row) if axis == 0 else (column, row + way)
            if key in lattice or not _goes_on(lattice, points.pixels, placed[here], key, there):
                continue
            lattice[key] = there
            placed[there] = key
            frames[there] = _turned(points.edges[there], frames[here])
            waiting.append(there)
    return lattice


def _goes_on(lattice: Lattice, pixels: Floats, here: tuple[int, int], key: tuple[int, int], there: int) -> bool:
    """Whether a saddle lies where the lattice goes on to: straight on from the step before, and beside the next row's.

    In a board that is seen very aslant the nearest saddle along an edge may be the one across a cell.
    """
    column, row = key[0] - here[0], key[1] - here[1]
    at = pixels[lattice[here]]
    step = pixels[there] - at
    steps = []
    behind = (here[0] - column, here[1] - row)
    if behind in lattice:
        steps.append(at - pixels[lattice[behind]])
    for side in (1, -1):
        beside, ahead = ((here[0] + side * row, here[1] + side * column), (key[0] + side * row, key[1] + side * column))
        if beside in lattice and ahead in lattice:
            steps.append(pixels[lattice[ahead]] - pixels[lattice[beside]])
    return all(float(np.linalg.norm(step - other)) < BENDS * float(np.linalg.norm(other)) for other in steps)


def _step_px(lattice: Lattice, pixels: Floats) -> float:
    steps = [
        float(np.linalg.norm(pixels[here] - pixels[lattice[column + 1, row]]))
        for (column, row), here in lattice.items()
        if (column + 1, row) in lattice
    ]
    return float(np.median(steps)) if steps else 0.0


def _turned(edges: Floats, frame: Floats) -> Floats:
    """A saddle's edges, in the order and sense of its neighbour's."""
    cos = frame @ edges.T
    pair = edges if abs(cos[0, 0]) + abs(cos[1, 1]) > abs(cos[0, 1]) + abs(cos[1, 0]) else edges[::-1]
    turned: Floats = pair * np.where((pair * frame).sum(axis=1) < 0, -1.0, 1.0)[:, None]
    return turned


def _larger_side(lattice: Lattice) -> int:
    return max(max(key[k] for key in lattice) - min(key[k] for key in lattice) + 1 for k in (0, 1))


def _grown(lattice: Lattice, points: SaddlePoints) -> Lattice:
    """The lattice with holes and rims filled by saddles that lie where a homography of what is near predicts them."""
    lattice = dict(lattice)
    used = set(lattice.values())
    pixels = points.pixels
    usual = float(np.median(points.strength[list(used)]))
    failed: dict[tuple[int, int], bytes] = {}
    for _ in range(8):
        low = [min(key[k] for key in lattice) - 1 for k in (0, 1)]
        high = [max(key[k] for key in lattice) + 1 for k in (0, 1)]
        open_keys = [
            (column, row)
            for column in range(low[0], high[0] + 1)
            for row in range(low[1], high[1] + 1)
            if (column, row) not in lattice
        ]
        keys = np.array(list(lattice), np.float64)
        known = pixels[list(lattice.values())]
        added = False
        for key in open_keys:
            near = np.argsort(np.abs(keys - key).max(axis=1) + 1e-3 * np.abs(keys - key).sum(axis=1))[:16]
            if np.abs(keys[near[4]] - key).max() > 2 or len(near) < GROW_MIN:
                continue
            seen_with = keys[near].tobytes()
            if failed.get(key) == seen_with:
                continue
            failed[key] = seen_with
            homography = fit_homography(keys[near], known[near])
            if homography is None:
                continue
            at = mapped(homography, np.array([key, (key[0] + 1, key[1]), (key[0], key[1] + 1)], np.float64))
            away = np.linalg.norm(pixels - at[0], axis=1)
            nearest = int(away.argmin())
            step = np.linalg.norm(at[1:] - at[0], axis=1).min()
            alike = usual / ALIKE < points.strength[nearest] < usual * ALIKE
            if away[nearest] < NEAR * step and alike and nearest not in used:
                lattice[key] = nearest
                used.add(nearest)
                added = True
        if not added:
            break
    return lattice


def _trimmed(lattice: Lattice) -> Lattice:
    """The lattice without outer rows that hold a few strays only."""
    while True:
        count = len(lattice)
        for axis in (0, 1):
            lines = [key[axis] for key in lattice]
            across = len({key[1 - axis] for key in lattice})
            for line in (min(lines), max(lines)):
                if lines.count(line) < STRAY * across:
                    lattice = {key: value for key, value in lattice.items() if key[axis] != line}
        if len(lattice) == count or len(lattice) < GROW_MIN:
            return lattice


def _as_board(lattice: Lattice, pixels: Floats, board: Board) -> Floats | None:
    """(rows, columns, 2) of the part of a lattice that is the board, if it is just as large, but for strays."""
    if len(lattice) < SEEN_MIN * board.count:
        return None
    keys = np.array(list(lattice))
    keys -= keys.min(axis=0)
    across, down = (keys.max(axis=0) + 1).tolist()
    grid = np.full((down, across, 2), np.nan)
    grid[keys[:, 1], keys[:, 0]] = pixels[list(lattice.values())]
    # A quarter turn does not mirror.
    turns = [grid, np.ascontiguousarray(np.rot90(grid))] if board.columns != board.rows else [grid]
    parts = [part for turned in turns for part in _parts(turned, board)]
    if not parts:
        return None
    best = max(parts, key=_seen)
    whole = best.size == grid.size
    return best if _seen(best) >= (SEEN_MIN if whole else CROWDED_SEEN_MIN) * board.count else None


def _parts(grid: Floats, board: Board) -> list[Floats]:
    """All parts of a lattice that have the board's size, where there is a little more of it."""
    more_rows, more_columns = grid.shape[0] - board.rows, grid.shape[1] - board.columns
    if not (0 <= more_rows <= MORE and 0 <= more_columns <= MORE):
        return []
    return [
        grid[row : row + board.rows, column : column + board.columns]
        for row in range(more_rows + 1)
        for column in range(more_columns + 1)
    ]


def _seen(grid: Floats) -> int:
    return int(np.isfinite(grid[..., 0]).sum())
