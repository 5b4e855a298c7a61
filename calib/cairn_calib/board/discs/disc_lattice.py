"""Lattices of discs among blobs: a walk from disc to disc, which no lens can lead astray, and the board's names for it.

    a disc's own ellipse says how the board is tilted there: in its units neighbours lie at right angles, equally far

      (-1, 1)  (0, 1)  (1, 1)         from a disc with two such neighbours the walk goes on step by step, each predicted
         o        o       o           by the steps before it, so that the lattice may bend as it likes
         o        @       o           @ start, (0, 0)
      (-1, 0)          (1, 0)

Asymmetric circles make a square lattice, too, turned by 45 degrees: its steps are (1, 1) and (-1, 1) pitches. The
walked lattice is then laid over the board's points in all turns and places; the one that names most discs, with the
least missing in the image and the least beyond the board's rim, is taken.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cairn_calib.board.board import Board
from cairn_calib.board.discs.blobs import Blobs
from cairn_map.arrays import Flags, Floats

Indices = npt.NDArray[np.intp]
Place = tuple[int, int]

PITCH_RADII = (1.9, 6.5)
"""Distance of neighbours in units of a disc's own ellipse: 2.2 for discs of 0.9 of the pitch, 5 for 0.4."""
LENGTHS_RATIO = 1.45
"""Ratio of the two steps in these units, at most: 1 without perspective and with exact ellipses."""
COSINE_MAX = 0.42
"""Cosine of the angle between the two steps in these units, at most."""
AREA_RATIO, HEIGHT_RATIO = 2.5, 3.0
"""Ratios of the areas and heights of neighbouring discs, at most."""
REACH = 0.5
"""Distance from the predicted to the found disc, at most, steps."""
PITCH_RATIO = 1.3
"""Ratio between the distance of two neighbours, in the mean of both one's units, and the lattice's own, at most: what
perspective and a lens make larger for one of them is smaller for the other."""
NEIGHBOURS = 9
"""Nearest blobs among which a start looks for its two neighbours."""
STARTS_MAX = 60
"""Blobs from which a walk is tried."""
SEEN_MIN = 0.5
"""Share of the board's discs that a walk must have met, at least."""
ROOM_MIN = 0.25
"""Share of the board's discs in a walk, at least, from which the rest can grow."""
TURNS = tuple(np.array(turn) for turn in (((1, 0), (0, 1)), ((0, -1), (1, 0)), ((-1, 0), (0, -1)), ((0, 1), (-1, 0))))


@dataclass(frozen=True, slots=True)
class NamedDiscs:
    """The blob of each of the board's points."""

    blobs: Indices
    """(N,) index of each point's blob; -1 where the walk met none."""
    beyond: int
    """Discs of the same lattice next to the board's rim, which belong to a larger pattern."""
    is_leaning: bool = False
    """True if the board's rows run more than 45 degrees from the image's rows."""

    @property
    def met(self) -> Flags:
        """(N,) True for each point with a blob."""
        return np.asarray(self.blobs >= 0)


def walks(blobs: Blobs, count: int) -> Iterator[dict[Place, int]]:
    """Lattices of at least half of `count` blobs, each as the blob at each place; every lattice once."""
    if len(blobs) < SEEN_MIN * count:
        return
    # From the best cross on; blobs of a walk start no other.
    near = _Neighbours(blobs)
    walked: set[int] = set()
    for start in near.starts()[:STARTS_MAX].tolist():
        if start in walked:
            continue
        best: dict[Place, int] = {}
        for right, down in near.steps_from(start):
            lattice = _walk(blobs, near, {(0, 0): start, (1, 0): right, (0, 1): down})
            if len(lattice) > len(best):
                best = lattice
            if len(best) >= count:
                break
        if len(best) >= SEEN_MIN * count:
            walked |= set(best.values())
            yield best


def walk_from(blobs: Blobs, known: dict[Place, int]) -> dict[Place, int]:
    """The lattice that goes on from known places."""
    return _walk(blobs, _Neighbours(blobs), known)


class _Neighbours:
    """(N, N) distances of blobs that may be neighbours on one board, as each blob's own ellipse measures them."""

    def __init__(self, blobs: Blobs) -> None:
        self.blobs = blobs
        self.away = blobs.centres[None] - blobs.centres[:, None]
        # In each blob's own units: rows are seen from that blob.
        self.own = np.empty_like(self.away)
        for row, (by_x, by_y) in enumerate(np.moveaxis(np.linalg.inv(blobs.shapes), 0, -1)):
            self.own[..., row] = by_x[:, None] * self.away[..., 0] + by_y[:, None] * self.away[..., 1]
        # Neighbours are of about one size and height, and a pitch apart for both of them.
        # Component by component: NumPy sums over an axis of two twenty times as slowly.
        length = self.distance = np.sqrt(self.own[..., 0] ** 2 + self.own[..., 1] ** 2)
        area = np.linalg.det(blobs.shapes)
        areas, heights = area[:, None] / area, blobs.heights[:, None] / blobs.heights
        self.alike = np.asarray(
            (np.maximum(areas, areas.T) < AREA_RATIO) & (np.maximum(heights, heights.T) < HEIGHT_RATIO)
        )
        apart = (length > PITCH_RADII[0]) & (length < PITCH_RADII[1])
        self.length = np.where(self.alike & apart & apart.T, length, np.inf)

    def mean_length(self, one: int, other: int | slice = slice(None)) -> Floats:
        """Geometric mean of the distances from one blob to another, or to all, as both see it."""
        return np.asarray(np.sqrt(self.distance[one, other] * self.distance[other, one]))

    def starts(self) -> Indices:
        """Blobs by how well their four nearest neighbours make a cross, best first."""
        if len(self.length) < 5:
            return np.arange(len(self.length))
        rows = np.arange(len(self.length))[:, None]
        order = np.argpartition(self.length, 3, axis=1)[:, :4]
        order = order[rows, np.argsort(self.length[rows, order], axis=1)]
        length = self.length[rows, order]
        steps = self.own[rows, order]
        with np.errstate(invalid="ignore"):
            # A cross sums to nothing, and its arms are equally long.
            off = np.linalg.norm(steps.sum(axis=1), axis=1) / length[:, 0] + (length[:, 3] / length[:, 0] - 1)
        off = np.where(np.isfinite(length).sum(axis=1) == 4, off, 1e3 - np.isfinite(length).sum(axis=1))
        found = np.argsort(off, kind="stable")
        return np.asarray(found[np.isfinite(length[found]).sum(axis=1) >= 2])

    def steps_from(self, start: int) -> Iterator[tuple[int, int]]:
        """Two neighbours, equally far in the blob's own units; the second is a right angle clockwise of the first."""
        # The nearest come first: the diagonal is 1.4 times as far.
        nearest = np.argsort(self.length[start])[:NEIGHBOURS]
        nearest = nearest[np.isfinite(self.length[start, nearest])]
        tried = 0
        for right in nearest.tolist():
            for down in nearest.tolist():
                a, b = self.own[start, right], self.own[start, down]
                la, lb = self.length[start, right], self.length[start, down]
                if not 1 / LENGTHS_RATIO < la / lb < LENGTHS_RATIO or abs(a @ b) > COSINE_MAX * la * lb:
                    continue
                # Every lattice has four such pairs at each disc, one a turn: one is enough.
                if a[0] * b[1] - a[1] * b[0] > 0:
                    yield right, down
                    tried += 1
            if tried >= 3:
                return


def _walk(blobs: Blobs, near: _Neighbours, known: dict[Place, int]) -> dict[Place, int]:
    """The lattice that can be reached from known places, each step predicted by those before it."""
    lattice = dict(known)
    # The pitch in units of the discs is the same all over the board.
    lengths = [near.mean_length(known[one], known[other]) for one in known for other in sides(one) if other in known]
    pitch = float(np.median(lengths)) if lengths else np.inf
    taken = set(lattice.values())
    open_places = list(lattice)
    likely: dict[int, Indices] = {}
    # Invariant: each place has one blob, each blob one place.
    while open_places:
        found: list[tuple[float, Place, int, int]] = []
        for place in open_places:
            source = lattice[place]
            for step in ((1, 0), (-1, 0), (0, 1), (0, -1)):
                to = (place[0] + step[0], place[1] + step[1])
                if to in lattice:
                    continue
                guess = _predict(blobs, lattice, place, step)
                if guess is None:
                    continue
                at, reach = guess
                # Blobs that may be its neighbours at all.
                if source not in likely:
                    length = near.mean_length(source)
                    apart = (length <= PITCH_RATIO * pitch) & (length >= pitch / PITCH_RATIO)
                    likely[source] = np.flatnonzero(near.alike[source] & apart)
                if not len(likely[source]):
                    continue
                miss = np.linalg.norm(blobs.centres[likely[source]] - at, axis=1) / reach
                best = int(np.argmin(miss))
                nearest = int(likely[source][best])
                if miss[best] < REACH and nearest not in taken:
                    found.append((float(miss[best]), to, nearest, source))
        # The surest first: a blob and a place are given away once.
        open_places = []
        for _, to, blob, _ in sorted(found):
            if to not in lattice and blob not in taken:
                lattice[to] = blob
                taken.add(blob)
                open_places.append(to)
        if open_places:
            # Discs that had no step before may have one now.
            open_places = list({*open_places, *(p for n in open_places for p in around(n) if p in lattice)})
    return lattice


def around(place: Place) -> list[Place]:
    """The eight places around one."""
    return [(place[0] + i, place[1] + j) for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j]


def sides(place: Place) -> list[Place]:
    """The four places next to one."""
    return [(place[0] + i, place[1] + j) for i, j in ((1, 0), (-1, 0), (0, 1), (0, -1))]


def _predict(blobs: Blobs, lattice: dict[Place, int], place: Place, step: Place) -> tuple[Floats, float] | None:
    """Pixel at which the next disc is expected, and the length of the step; None where no step is known nearby."""

    def at(i: int, j: int) -> Floats | None:
        blob = lattice.get((i, j))
        return None if blob is None else np.asarray(blobs.centres[blob])

    x, y = place
    # All known steps in the same direction next to it.
    here = blobs.centres[lattice[place]]
    # The same step backwards, and of the lines to both sides: where lines bend, so do their neighbours.
    guesses = []
    across = (step[1], step[0])
    for side in (1, -1):
        start = at(x + side * across[0], y + side * across[1])
        end = at(x + side * across[0] + step[0], y + side * across[1] + step[1])
        if start is not None and end is not None:
            guesses.append(end - start)
    back = at(x - step[0], y - step[1])
    if back is not None:
        guesses.append(here - back)
    if not guesses:
        return None
    mean = np.mean(guesses, axis=0)
    return here + mean, float(np.linalg.norm(mean))


def lattice_of(board: Board) -> npt.NDArray[np.intp]:
    """(N, 2) place of each of the board's points on the square lattice that its discs make."""
    places = board.lattice().round().astype(np.intp)
    if board.pattern == "asymmetric-circles":
        # Steps (1, 1) and (-1, 1) pitches: the columns of the inverse of this.
        x, y = places.T
        return np.stack([(x + y) // 2, (y - x) // 2], axis=1)
    return places


def name_discs(lattice: dict[Place, int], board: Board, centres: Floats, *, upright: bool) -> list[NamedDiscs]:
    """The board's names for a walked lattice, in all turns and places that meet the most discs of it.

    None where no turn and place meets half of the board. With `upright`, the board's rows run within 90 degrees of the
    image's rows, to the right; of a square board within 45.
    """
    is_square = board.pattern == "circles" and board.columns == board.rows
    best: list[NamedDiscs] = []
    most = int(np.ceil(SEEN_MIN * board.count))
    for laid in _laid_boards(lattice, board):
        # Places at which the board gains at least as much as at the best so far.
        for i, j in np.argwhere(laid.met - laid.beyond >= most):
            met, beyond = int(laid.met[i, j]), int(laid.beyond[i, j])
            if met - beyond < most:
                continue
            named = laid.blobs[laid.places[:, 0] + i, laid.places[:, 1] + j]
            right, down = _rows_direction(named, board, centres)
            is_leaning = right <= abs(down)
            if upright and (right <= 0 or (is_leaning and is_square)):
                continue
            best = [each for each in best if int(each.met.sum()) - each.beyond >= met - beyond]
            most = met - beyond
            best.append(NamedDiscs(named, beyond, is_leaning))
    return best


def has_room(lattice: dict[Place, int], board: Board, *, beyond_max: float) -> bool:
    """True if the board can be laid on some of a lattice with at most `beyond_max` discs next to its rim.

    A lattice that grows only gains discs: where it has no room for the board, it will have none.
    """
    least = np.ceil(ROOM_MIN * board.count)
    return any(bool(((laid.met >= least) & (laid.beyond <= beyond_max)).any()) for laid in _laid_boards(lattice, board))


@dataclass(frozen=True, slots=True)
class _LaidBoard:
    """A board in one turn on the grid of a walked lattice, which leaves room for it on all sides."""

    blobs: Indices
    """(A, B) blob at each place of the grid, or -1."""
    places: Indices
    """(N, 2) of the board's points on the grid where it is laid at (0, 0)."""
    met: Indices
    """Number of discs under the board where it is laid at (i, j)."""
    beyond: Indices
    """Number of discs next to its rim there."""


def _laid_boards(lattice: dict[Place, int], board: Board) -> Iterator[_LaidBoard]:
    """The board on a lattice, in all turns."""
    # Both as whole numbers on the square lattice.
    walked = np.array(list(lattice), np.intp)
    mine = lattice_of(board)
    for turn in TURNS:
        turned = mine @ turn
        # Room for the board on all sides.
        span = np.ptp(turned, axis=0) + 1
        low = walked.min(axis=0) - span
        size = walked.max(axis=0) - low + span + 2
        there = np.full(size, -1, np.intp)
        # Blobs at their places; elsewhere none.
        there[tuple((walked - low).T)] = list(lattice.values())
        zero = turned - turned.min(axis=0)
        ends = size - span
        yield _LaidBoard(there, zero, _count_at(there, zero, ends), _count_at(there, _rim(zero), ends))


def _count_at(there: Indices, places: Indices, ends: Indices) -> Indices:
    """Number of discs at places moved by (i, j) < `ends`; places may be one row or column outside of the grid."""
    # One shifted copy of the grid for each place: a loop over the places, not over the moves.
    grid = np.pad(there >= 0, 1).astype(np.int32)
    found = np.zeros(ends, np.intp)
    for x, y in places + 1:
        found += grid[x : x + ends[0], y : y + ends[1]]
    return found


def _rim(places: npt.NDArray[np.intp]) -> npt.NDArray[np.intp]:
    """(M, 2) places next to a board's, along rows or columns, that are none of them."""
    own = {(int(i), int(j)) for i, j in places}
    around = {(i + a, j + b) for i, j in own for a, b in ((1, 0), (-1, 0), (0, 1), (0, -1))} - own
    return np.array(sorted(around), np.intp)


def _rows_direction(named: Indices, board: Board, centres: Floats) -> tuple[float, float]:
    """Direction in which the board's rows run in the image: to the right, and down."""
    there = named >= 0
    # Least squares of pixels over columns and rows.
    terms = np.column_stack([board.lattice()[there], np.ones(int(there.sum()))])
    right, down = np.linalg.lstsq(terms, centres[named[there]], rcond=None)[0][0]
    return float(right), float(down)
