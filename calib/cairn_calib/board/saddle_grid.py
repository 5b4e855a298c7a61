"""Chessboard lattice in a cloud of saddle points, with holes where something hides the board.

    saddles -> neighbours along edges (mutual, with bright and dark swapped) -> connected lattice -> holes and rims
    filled by prediction -> a lattice of just the board's size, or the reason why not

Neither the whole board nor a quiet border is needed, but each of the four outer rows of corners must be seen in part:
otherwise it is open which corners they are.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cairn_calib.board.board import Board
from cairn_calib.board.homography import fit_homography, map_points
from cairn_calib.board.saddle_points import SaddlePoints
from cairn_map.arrays import Floats

Lattice = dict[tuple[int, int], int]

EDGE_COS_MIN = np.cos(np.radians(22.0))
"""Cosine of the largest angle between an edge's direction and a neighbour's: a lens bends edges, noise turns them."""
SWAP_COS_MIN = 0.6
"""Cosine between a neighbour's bright quarters and the mirror image of the corner's own, at least."""
PREDICTION_STEPS_MAX = 0.3
"""Steps from corner to corner by which a corner may lie off the place that its neighbours predict."""
SEEN_SHARE_MIN = 0.6
"""Share of the board's corners that must be seen."""
OUTER_ROW_SHARE_MIN = 0.34
"""Share of an outer row's corners below which the row is no part of the board."""
STEP_CHANGE_MAX = 0.5
"""Largest change from a step to the one after it, or next to it, as a share of the latter."""
LATTICE_CORNERS_MIN = 9
"""Corners of the smallest lattice that is grown, and that a prediction by homography rests on: 3 x 3."""
STEP_RATIO_MAX = 2.1
"""Longest step over the shortest at one corner: a board tilted by 60 degrees has 2, a step past a corner 2.2."""
STRENGTH_RATIO_MAX = 3.0
"""Largest ratio between the strengths of neighbours; noise next to a board is much weaker."""
EXTRA_ROWS_MAX = 4
"""Rows or columns of strays that may surround a board; corner_gates.py refuses a pattern that goes on."""
CROWDED_SEEN_SHARE_MIN = 0.85
"""Share of the board's corners that must be seen where there are strays, which might fill a row that is hidden."""
NEIGHBOURS_SEARCHED = 32
"""Nearest saddles of each saddle among which its neighbours are searched."""
LATTICES_MAX = 6
"""Lattices of at least `LATTICE_CORNERS_MIN` corners that are compared with the board."""


@dataclass(frozen=True, slots=True)
class NoGrid:
    """Absence of a lattice, with the reason."""

    reason: str
    largest: int = 0
    """Corners of the largest lattice; 0 where there is none."""
    step_px: float = 0.0
    """Median distance between neighbours of that lattice, pixels of the image that was given."""


def saddle_grid(points: SaddlePoints, board: Board) -> Floats | NoGrid:
    """The board's corners among saddles.

    Returns:
        (rows, columns, 2) pixels x, y, NaN where a corner is not seen; rows and columns are the board's, but it is open
        which corner is the first; never mirrored. Or the reason why there is none.
    """
    if len(points.pixels) < SEEN_SHARE_MIN * board.count:
        return NoGrid(f"{len(points.pixels)} places look like a corner, the board has {board.count}")
    best: Lattice = {}
    neighbours = neighbours_of(points)
    unseen = set(range(len(points.pixels)))
    lattices = 0
    # Saddles are strongest first, so each round starts from the strongest that is in no lattice yet.
    while unseen and lattices < LATTICES_MAX:
        lattice = _connect(points, neighbours, start=min(unseen), unseen=unseen)
        unseen -= set(lattice.values())
        if len(lattice) < LATTICE_CORNERS_MIN:
            continue
        # A lattice much larger than the board is another pattern: growing it would only cost time.
        if _larger_side(lattice) <= max(board.columns, board.rows) + 2:
            lattice = _grow(lattice, points)
        lattice = _trim(lattice)
        grid = _board_part(lattice, points.pixels, board)
        if grid is not None:
            return grid
        best = max(best, lattice, key=len)
        lattices += 1
    if not best:
        return NoGrid(
            f"{len(points.pixels)} places look like a corner, but no {LATTICE_CORNERS_MIN} of them form a lattice"
        )
    across, down = (max(key[k] for key in best) - min(key[k] for key in best) + 1 for k in (0, 1))
    return NoGrid(
        f"the largest lattice has {across} x {down} corners, {len(best)} of them seen; the board has "
        f"{board.columns} x {board.rows}",
        largest=len(best),
        step_px=_step_px(best, points.pixels),
    )


def neighbours_of(points: SaddlePoints, *, step_ratio_max: float = STEP_RATIO_MAX) -> npt.NDArray[np.intp]:
    """(N, 2, 2) index of the next saddle along each edge, forwards and backwards; -1 for none."""
    count = len(points.pixels)
    # Distances to the nearest saddles: (N, K).
    far = np.linalg.norm(points.pixels[None] - points.pixels[:, None], axis=2)
    far[np.diag_indices(count)] = np.inf
    near = np.tile(np.arange(count), (count, 1))
    if count > NEIGHBOURS_SEARCHED:
        near = np.argpartition(far, NEIGHBOURS_SEARCHED, axis=1)[:, :NEIGHBOURS_SEARCHED]
    far = np.take_along_axis(far, near, axis=1)
    to = points.pixels[near] - points.pixels[:, None]
    unit = to / np.where(np.isfinite(far), far, 1.0)[..., None]
    # Candidates lie along an edge of both saddles; cos is (N, K, 2), one for each edge.
    cos = unit @ np.swapaxes(points.edges, 1, 2)
    their = np.abs((points.edges[near] * unit[:, :, None]).sum(axis=-1)) > EDGE_COS_MIN
    along = np.abs(cos) > EDGE_COS_MIN
    # Past the edge between them, bright and dark are mirrored: reflect the saddle's bright axis along the step.
    across = (unit @ points.bright[..., None])[..., 0]
    mirrored = 2 * across[..., None] * unit - points.bright[:, None]
    swapped = np.abs((mirrored * points.bright[near]).sum(axis=-1)) > SWAP_COS_MIN
    ratio = np.abs(np.log(points.strength[:, None] / points.strength[near]))
    fits = along.any(axis=2) & their.any(axis=2) & swapped & (ratio < np.log(STRENGTH_RATIO_MAX))
    # The nearest candidate along each edge, each way.
    found, own = np.full((count, 2, 2), -1, np.intp), np.full((count, 2, 2), np.inf)
    every = np.arange(count)
    for edge in (0, 1):
        for way, sign in ((0, 1), (1, -1)):
            distance = np.where(fits & along[..., edge] & (sign * cos[..., edge] > 0), far, np.inf)
            nearest = distance.argmin(axis=1)
            own[:, edge, way] = distance[every, nearest]
            found[:, edge, way] = np.where(np.isfinite(own[:, edge, way]), near[every, nearest], -1)
    found = _drop_long_steps(found, own, step_ratio_max)
    # Keep what is mutual: each is a neighbour of its neighbour.
    back = (found[found] == every[:, None, None, None, None]).any(axis=(3, 4))
    return np.where((found >= 0) & back, found, -1)


def _drop_long_steps(found: npt.NDArray[np.intp], own: Floats, step_ratio_max: float) -> npt.NDArray[np.intp]:
    """Neighbours, except those whose distance (`own`, pixels) is much larger than either end's shortest."""
    # Of both ends the shorter one: a step past a corner is long at either end.
    nearest = own.min(axis=(1, 2))
    limit = step_ratio_max * np.minimum(nearest[:, None, None], nearest[np.maximum(found, 0)])
    return np.where(own <= limit, found, -1)


def _connect(points: SaddlePoints, neighbours: npt.NDArray[np.intp], *, start: int, unseen: set[int]) -> Lattice:
    """Lattice of all saddles connected to one, by their column and row relative to it, breadth first."""
    # A right-handed frame at the start, x to y clockwise in the image, so that the lattice is never mirrored.
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
            # The step's column or row is the edge of the frame, carried from saddle to saddle, that it follows.
            step = points.pixels[there] - points.pixels[here]
            cos = frames[here] @ step
            axis = int(np.abs(cos).argmax())
            column, row = placed[here]
            way = 1 if cos[axis] > 0 else -1
            key = (column + way, row) if axis == 0 else (column, row + way)
            if key in lattice or not _continues(lattice, points.pixels, placed[here], key, there):
                continue
            lattice[key] = there
            placed[there] = key
            frames[there] = _align_edges(points.edges[there], frames[here])
            waiting.append(there)
    return lattice


def _continues(lattice: Lattice, pixels: Floats, here: tuple[int, int], key: tuple[int, int], there: int) -> bool:
    """True if a saddle lies where the lattice continues: like the step before it, and the steps of both next rows.

    In a board that is seen very aslant the nearest saddle along an edge may be the one across a cell.
    """
    column, row = key[0] - here[0], key[1] - here[1]
    at = pixels[lattice[here]]
    step = pixels[there] - at
    # The step before this one, and the steps next to it on both sides, as far as they are known.
    steps = []
    behind = (here[0] - column, here[1] - row)
    if behind in lattice:
        steps.append(at - pixels[lattice[behind]])
    for side in (1, -1):
        abreast = (here[0] + side * row, here[1] + side * column)
        ahead = (key[0] + side * row, key[1] + side * column)
        if abreast in lattice and ahead in lattice:
            steps.append(pixels[lattice[ahead]] - pixels[lattice[abreast]])
    return all(float(np.linalg.norm(step - other)) < STEP_CHANGE_MAX * float(np.linalg.norm(other)) for other in steps)


def _step_px(lattice: Lattice, pixels: Floats) -> float:
    """Median distance from column to column, pixels; 0 where no two columns meet."""
    steps = [
        float(np.linalg.norm(pixels[here] - pixels[lattice[column + 1, row]]))
        for (column, row), here in lattice.items()
        if (column + 1, row) in lattice
    ]
    return float(np.median(steps)) if steps else 0.0


def _align_edges(edges: Floats, frame: Floats) -> Floats:
    """(2, 2) edges of a saddle, in the order and sense of its neighbour's `frame`."""
    cos = frame @ edges.T
    pair = edges if abs(cos[0, 0]) + abs(cos[1, 1]) > abs(cos[0, 1]) + abs(cos[1, 0]) else edges[::-1]
    turned: Floats = pair * np.where((pair * frame).sum(axis=1) < 0, -1.0, 1.0)[:, None]
    return turned


def _larger_side(lattice: Lattice) -> int:
    return max(max(key[k] for key in lattice) - min(key[k] for key in lattice) + 1 for k in (0, 1))


def _grow(lattice: Lattice, points: SaddlePoints) -> Lattice:
    """Lattice whose holes and rims are filled by saddles that lie where a homography of near corners predicts them."""
    lattice = dict(lattice)
    used = set(lattice.values())
    pixels = points.pixels
    usual = float(np.median(points.strength[list(used)]))
    # A place that failed is tried again only when other corners are near it.
    failed: dict[tuple[int, int], bytes] = {}
    for _ in range(8):
        # Places without a corner in the lattice's box, one row and column wider on each side.
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
            # The 16 nearest corners must surround the place: at least five within two steps.
            near = np.argsort(np.abs(keys - key).max(axis=1) + 1e-3 * np.abs(keys - key).sum(axis=1))[:16]
            if np.abs(keys[near[4]] - key).max() > 2 or len(near) < LATTICE_CORNERS_MIN:
                continue
            seen_with = keys[near].tobytes()
            if failed.get(key) == seen_with:
                continue
            failed[key] = seen_with
            homography = fit_homography(keys[near], known[near])
            if homography is None:
                continue
            # Accept the saddle nearest to the prediction, if it is near for this step, as strong as usual and free.
            at = map_points(homography, np.array([key, (key[0] + 1, key[1]), (key[0], key[1] + 1)], np.float64))
            away = np.linalg.norm(pixels - at[0], axis=1)
            nearest = int(away.argmin())
            step = np.linalg.norm(at[1:] - at[0], axis=1).min()
            alike = usual / STRENGTH_RATIO_MAX < points.strength[nearest] < usual * STRENGTH_RATIO_MAX
            if away[nearest] < PREDICTION_STEPS_MAX * step and alike and nearest not in used:
                lattice[key] = nearest
                used.add(nearest)
                added = True
        if not added:
            break
    return lattice


def _trim(lattice: Lattice) -> Lattice:
    """Lattice without outer rows that hold a few strays only; repeated, as each row that goes bares the next."""
    # Until nothing goes; each axis looks at its first and its last line.
    while True:
        count = len(lattice)
        for axis in (0, 1):
            lines = [key[axis] for key in lattice]
            across = len({key[1 - axis] for key in lattice})
            for line in (min(lines), max(lines)):
                if lines.count(line) < OUTER_ROW_SHARE_MIN * across:
                    lattice = {key: value for key, value in lattice.items() if key[axis] != line}
        if len(lattice) == count or len(lattice) < LATTICE_CORNERS_MIN:
            return lattice


def _board_part(lattice: Lattice, pixels: Floats, board: Board) -> Floats | None:
    """(rows, columns, 2) pixels of the part of a lattice that is the board; None unless it has the board's size."""
    if len(lattice) < SEEN_SHARE_MIN * board.count:
        return None
    keys = np.array(list(lattice))
    # The lattice as an array, NaN in its holes.
    keys -= keys.min(axis=0)
    across, down = (keys.max(axis=0) + 1).tolist()
    grid = np.full((down, across, 2), np.nan)
    grid[keys[:, 1], keys[:, 0]] = pixels[list(lattice.values())]
    # A quarter turn does not mirror.
    turns = [grid, np.ascontiguousarray(np.rot90(grid))] if board.columns != board.rows else [grid]
    parts = [part for turned in turns for part in _board_sized_parts(turned, board)]
    if not parts:
        return None
    best = max(parts, key=_count_seen)
    whole = best.size == grid.size
    return best if _count_seen(best) >= (SEEN_SHARE_MIN if whole else CROWDED_SEEN_SHARE_MIN) * board.count else None


def _board_sized_parts(grid: Floats, board: Board) -> list[Floats]:
    """All parts with the board's size of a lattice that has at most `EXTRA_ROWS_MAX` rows and columns more."""
    more_rows, more_columns = grid.shape[0] - board.rows, grid.shape[1] - board.columns
    if not (0 <= more_rows <= EXTRA_ROWS_MAX and 0 <= more_columns <= EXTRA_ROWS_MAX):
        return []
    return [
        grid[row : row + board.rows, column : column + board.columns]
        for row in range(more_rows + 1)
        for column in range(more_columns + 1)
    ]


def _count_seen(grid: Floats) -> int:
    return int(np.isfinite(grid[..., 0]).sum())
