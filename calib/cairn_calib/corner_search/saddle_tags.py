"""Tags whose corners are crossings of edges, read where they are too small or too blurred for a detector of squares.

    saddles -> neighbours along edges -> rings of four -> brightness of their cells -> correlation with all codes

On a ChArUco board the ring is a square with the tag in its middle, on an AprilGrid the tag itself.
"""

import numpy as np
import numpy.typing as npt

from cairn_calib.board.board import Board
from cairn_calib.board.homography import map_points
from cairn_calib.board.saddle_grid import neighbours_of
from cairn_calib.board.saddle_points import saddle_points
from cairn_calib.corner_search.tag_codes import codes_of, match_codes, quad_homographies, read_cells
from cairn_calib.corner_search.tag_detection import SeenTags
from cairn_calib.corner_search.tag_layout import layouts_of
from cairn_map.arrays import Floats

Image = npt.NDArray[np.float32]

RING = 4
"""Corners of a tag."""
STEP_RATIO_MAX = 5.0
"""Longest step over the shortest at one corner: from tag to tag over from a tag's edge to the next, and a tilt."""
SQUARE_COS_MAX = 0.75
"""Cosine of the angle between two sides of a ring: of a square seen aslant."""
RESEMBLING = 0.75
"""Correlation of a tag's bits with its code, at least; the tags must agree on their places, too."""


def tags_of_saddles(even: Image, board: Board, *, is_reversed: bool) -> SeenTags:
    """The board's tags in an image whose contrast is about 1; reversed: what is printed dark is bright."""
    points = saddle_points(even)
    if len(points.pixels) < RING:
        return SeenTags(np.zeros(0, np.intp), np.zeros((0, RING, 2)))
    quads = _rings(points.pixels, neighbours_of(points, step_ratio_max=STEP_RATIO_MAX))
    homographies = quad_homographies(quads)
    layout, codes = layouts_of(board)[0], codes_of(board.dictionary or "")
    # The tag within the ring, as the unit square.
    edge = 1.0 if board.pattern == "aprilgrid" else (board.tag_m or 0.0) / board.pitch_m
    inner = np.array([[edge, 0, (1 - edge) / 2], [0, edge, (1 - edge) / 2], [0, 0, 1]])
    homographies = homographies @ inner
    b = layout.border_bits
    cells = read_cells(even, homographies, codes.shape[1] + 2 * b)[:, b:-b, b:-b]
    tags, turns, scores = match_codes(-cells if is_reversed else cells, codes[: layout.count])
    kept = np.flatnonzero(scores > RESEMBLING)
    unit = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    # AprilTag's own tables, and so Kalibr's sheets, have OpenCV's tags turned by half a turn.
    upside_down = 2 if board.pattern == "aprilgrid" else 0
    corners = [np.roll(map_points(homographies[k], unit), int(turns[k]) + upside_down, axis=0) for k in kept]
    return SeenTags(tags[kept], np.array(corners).reshape(-1, 4, 2))


def _rings(pixels: Floats, neighbours: npt.NDArray[np.intp]) -> Floats:
    """(Q, 4, 2) pixels of all rings of four neighbours, clockwise, each once."""
    near = [sorted({each for each in row.ravel().tolist() if each >= 0}) for row in neighbours]

    def turns(a: int, b: int) -> list[int]:
        """Neighbours of b to the right of the way from a."""
        step = pixels[b] - pixels[a]
        found = []
        for c in near[b]:
            after = pixels[c] - pixels[b]
            length = float(np.linalg.norm(step) * np.linalg.norm(after))
            is_right = step[0] * after[1] - step[1] * after[0] > 0
            if c != a and is_right and abs(float(step @ after)) < SQUARE_COS_MAX * length:
                found.append(c)
        return found

    rings = [
        (a, b, c, d)
        for a in range(len(pixels))
        for b in near[a]
        if b > a
        for c in turns(a, b)
        if c > a
        for d in turns(b, c)
        if d > a and a in turns(c, d)
    ]
    return np.array([pixels[list(ring)] for ring in rings], np.float64).reshape(-1, 4, 2)
