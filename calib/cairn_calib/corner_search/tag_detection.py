"""Tags in an image, and those of them that lie as the board's do; or the reason why they do not, and the next step.

    image -> OpenCV's detector of tags, dark on bright and bright on dark -> tags that predict each other's places

A single tag may be a chance of noise or stand on a wall. Two whose places agree with the board's layout are not, and
say where all of its points are searched.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from cairn_calib.board.board import Board
from cairn_calib.board.homography import fit_homography, map_points
from cairn_calib.corner_search.tag_codes import (
    DICTIONARIES,
    codes_of,
    dictionary_of,
    match_codes,
    quad_homographies,
    read_cells,
)
from cairn_calib.corner_search.tag_layout import SQUARES_MAX, TagLayout, layouts_of
from cairn_map.arrays import Flags, Floats

Bytes = npt.NDArray[np.uint8]

AGREE_TAGS, AGREE_SPREAD = 0.3, 0.15
"""Largest miss of a tag's corner where another tag predicts it, in edges of the tag, and what each pitch between both
adds: a tag's own corners are right to about a pixel, and a lens bends."""
AGREE_PITCHES = 3.5
"""Pitches up to which one tag predicts another."""
PERIMETER_MIN = 0.01
"""Smallest perimeter of a tag, share of the image's longest side."""
QUADS_MAX = 150
"""Dark squares that are read, the largest ones, where the board's own tags are not there."""
CERTAIN = 0.9
"""Correlation of a tag's bits with a code, at least, for a tag of a set that was not asked for."""
TAGS_MIN = 2
"""Tags that must agree."""
OTHERS_MIN = 4
"""Tags of another set, or that lie as on another board, that are worth a word."""
OTHERS_RATIO = 1.3
"""Ratio to the tags that agree with the stated board at which another number of columns is believed."""


@dataclass(frozen=True, slots=True)
class SeenTags:
    """M tags in an image."""

    ids: npt.NDArray[np.intp]
    corners: Floats
    """(M, 4, 2) pixels: upper left, upper right, lower right, lower left of each tag as its board is printed."""

    def only(self, kept: Flags) -> "SeenTags":
        """Some of the tags."""
        return SeenTags(self.ids[kept], self.corners[kept])


@dataclass(frozen=True, slots=True)
class BoardTags:
    """Tags that lie as those of the board, and its layout."""

    layout: TagLayout
    tags: SeenTags


def detect_tags(image: Bytes, name: str, border_bits: int) -> SeenTags:
    """Tags of one set, dark on bright paper."""
    detector = cv2.aruco.ArucoDetector(dictionary_of(name), _parameters(border_bits))
    corners, ids, _ = detector.detectMarkers(image)
    if ids is None or not len(ids):
        return SeenTags(np.zeros(0, np.intp), np.zeros((0, 4, 2)))
    places = np.asarray(corners, np.float64).reshape(-1, 4, 2)
    # AprilTag's own tables, and so Kalibr's sheets, have OpenCV's tags turned by half a turn.
    return SeenTags(np.asarray(ids).ravel().astype(np.intp), np.roll(places, 2, axis=1) if border_bits == 2 else places)


def _parameters(border_bits: int) -> cv2.aruco.DetectorParameters:
    parameters = cv2.aruco.DetectorParameters()
    parameters.markerBorderBits = border_bits
    parameters.minMarkerPerimeterRate = PERIMETER_MIN
    return parameters


def board_tags(seen: SeenTags, board: Board) -> BoardTags | str:
    """The tags that lie as the board's do, or the reason why there are too few."""
    best = max((BoardTags(each, seen.only(_agreeing(seen, each))) for each in layouts_of(board)), key=_count)
    other = _other_columns(seen, board, _count(best))
    if other is not None:
        return other
    if _count(best) < TAGS_MIN:
        return f"{len(seen.ids)} of its tags are seen, of which no {TAGS_MIN} lie as on the board"
    beyond = sorted(best.tags.ids[best.tags.ids >= best.layout.count].tolist())
    if beyond:
        return (
            f"tags up to {beyond[-1]} lie as on this board, which has {best.layout.count}, 0 to "
            f"{best.layout.count - 1}: is it larger? --board counts {_unit(board)}"
        )
    return best


def _count(found: BoardTags) -> int:
    return len(found.tags.ids)


def _unit(board: Board) -> str:
    return "tags" if board.pattern == "aprilgrid" else "squares, dark and bright"


def _other_columns(seen: SeenTags, board: Board, agreeing: int) -> str | None:
    """A reason if the tags lie as on a board with another number of columns."""
    if len(seen.ids) < max(OTHERS_MIN, OTHERS_RATIO * agreeing):
        return None
    own = layouts_of(board)[0].columns
    counts = {
        columns: max(int(_agreeing(seen, each).sum()) for each in layouts_of(board, columns))
        for columns in range(2, SQUARES_MAX)
        if columns != own
    }
    columns = max(counts, key=lambda each: counts[each])
    if counts[columns] < max(OTHERS_MIN, OTHERS_RATIO * agreeing):
        return None
    return (
        f"{counts[columns]} of {len(seen.ids)} tags lie as on a board of {columns} columns of {_unit(board)}, and "
        f"{agreeing} as on the stated one of {own}: give --board as COLUMNSxROWS of the sheet seen upright"
    )


def _agreeing(seen: SeenTags, layout: TagLayout) -> Flags:
    """(M,) True for the tags of the largest group in which each predicts others, as the layout has them."""
    count = len(seen.ids)
    if count < TAGS_MIN:
        return np.zeros(count, bool)
    places = np.stack([layout.corners(int(tag)) for tag in seen.ids])
    edges = np.linalg.norm(np.roll(seen.corners, -1, axis=1) - seen.corners, axis=2).max(axis=1)
    apart = np.linalg.norm(places.mean(axis=1)[:, None] - places.mean(axis=1)[None], axis=2)
    agrees = np.zeros((count, count), bool)
    for at in range(count):
        homography = fit_homography(places[at], seen.corners[at])
        if homography is None:
            continue
        # Where this tag predicts the corners of all others.
        misses = np.linalg.norm(map_points(homography, places) - seen.corners, axis=2).max(axis=1)
        limit = (AGREE_TAGS + AGREE_SPREAD * apart[at]) * edges
        agrees[at] = (np.nan_to_num(misses, nan=np.inf) < limit) & (apart[at] < AGREE_PITCHES) & (apart[at] > 0)
    agrees &= agrees.T
    return _largest_group(agrees)


def _largest_group(agrees: Flags) -> Flags:
    """(M,) True for the members of the largest connected group; none where it is a single one."""
    best = np.zeros(len(agrees), bool)
    left = np.ones(len(agrees), bool)
    while left.any():
        group = np.zeros(len(agrees), bool)
        group[int(np.argmax(left))] = True
        while (wider := group | agrees[group].any(axis=0)).sum() > group.sum():
            group = wider
        left &= ~group
        best = group if group.sum() > best.sum() else best
    return best if best.sum() >= TAGS_MIN else np.zeros(len(agrees), bool)


def other_tags(images: Sequence[Bytes], board: Board) -> str | None:
    """A reason that names tags of another set, or with another border, if there are some.

    Args:
        images: the image, and its negative.
        board: whose tags were not found.
    """
    squares = [(image, quad_homographies(_quads(image, board))) for image in images]
    squares = [(image, each) for image, each in squares if len(each) >= OTHERS_MIN]
    own = layouts_of(board)[0].border_bits
    best, reason = OTHERS_MIN - 1, None
    read: dict[int, list[Floats]] = {}
    for name in DICTIONARIES:
        codes = codes_of(name)
        for bits in (1, 2):
            if (name, bits) == (board.dictionary, own):
                continue
            size = codes.shape[1] + 2 * bits
            if size not in read:
                read[size] = [read_cells(image.astype(np.float32), each, size) for image, each in squares]
            count = max((_count_read(cells, codes, bits) for cells in read[size]), default=0)
            if count > best:
                best = count
                if bits == own:
                    reason = f"{count} tags of {name} are seen, and none of {board.dictionary}: say --tags {name}"
                else:
                    reason = (
                        f"{count} tags of {name} with a black border of {bits} bit{'s' * (bits > 1)} are seen, as "
                        f"{_sheet(bits)} has them: say --pattern {_pattern(bits)} --tags {name}"
                    )
    return reason


def _quads(image: Bytes, board: Board) -> Floats:
    """(Q, 4, 2) dark squares seen aslant, the largest first."""
    detector = cv2.aruco.ArucoDetector(dictionary_of(board.dictionary or ""), _parameters(1))
    read, _, unread = detector.detectMarkers(image)
    quads = np.concatenate(
        [np.zeros((0, 4, 2)), *(np.asarray(each, np.float64).reshape(-1, 4, 2) for each in (*read, *unread))]
    )
    sides = np.linalg.norm(quads[:, 0] - quads[:, 2], axis=1)
    return np.asarray(quads[np.argsort(-sides, kind="stable")][:QUADS_MAX])


def _count_read(cells: Floats, codes: Floats, border_bits: int) -> int:
    """Number of different tags that squares with (Q, m, m) cells are, for certain."""
    inner = cells[:, border_bits:-border_bits, border_bits:-border_bits]
    tags, _, scores = match_codes(inner, codes)
    # Its border is darker than the middle between its darkest and brightest bits.
    is_border = np.ones(cells.shape[1:], bool)
    is_border[border_bits:-border_bits, border_bits:-border_bits] = False
    middle = (inner.min(axis=(1, 2)) + inner.max(axis=(1, 2))) / 2
    framed = (cells[:, is_border] < middle[:, None]).all(axis=1)
    return len(set(tags[framed & (scores > CERTAIN)].tolist()))


def _pattern(border_bits: int) -> str:
    return "aprilgrid" if border_bits == 2 else "charuco"


def _sheet(border_bits: int) -> str:
    return "Kalibr's AprilGrid" if border_bits == 2 else "a ChArUco board"
