"""Sets of tags, and the reading of tags whose four corners are known: bits compared with all codes at once.

Whole bits are never cut to black or white: the brightnesses of a tag's cells are correlated with each code, which holds
where a blur mixes neighbouring bits.
"""

from collections.abc import Mapping
from functools import cache

import cv2
import numpy as np
import numpy.typing as npt

from cairn_calib.board.homography import fit_homography, map_points
from cairn_map.arrays import Floats
from cairn_map.errors import BadInputError

Image = npt.NDArray[np.float32]
Indices = npt.NDArray[np.intp]

DICTIONARIES: Mapping[str, int] = {
    **{
        f"{n}x{n}_{count}": int(getattr(cv2.aruco, f"DICT_{n}X{n}_{count}"))
        for n in (4, 5, 6, 7)
        for count in (50, 100, 250, 1000)
    },
    "original": cv2.aruco.DICT_ARUCO_ORIGINAL,
    "mip_36h12": cv2.aruco.DICT_ARUCO_MIP_36H12,
    "16h5": cv2.aruco.DICT_APRILTAG_16H5,
    "25h9": cv2.aruco.DICT_APRILTAG_25H9,
    "36h10": cv2.aruco.DICT_APRILTAG_36H10,
    "36h11": cv2.aruco.DICT_APRILTAG_36H11,
}
"""OpenCV's numbers of the sets, by the names that `--tags` takes; of two that share tags the smaller one first."""
SAMPLES = 3
"""Samples of a bit along each side."""
REMAP_ROWS = 16384
"""Rows of places that are looked up at a time."""


def dictionary_of(name: str) -> cv2.aruco.Dictionary:
    """A set of tags by its name.

    Raises:
        BadInputError: there is none of that name.
    """
    if name not in DICTIONARIES:
        raise BadInputError("bad_board", f"there is no set of tags {name!r}; there are {', '.join(DICTIONARIES)}")
    return cv2.aruco.getPredefinedDictionary(DICTIONARIES[name])


@cache
def codes_of(name: str) -> Floats:
    """(K, n, n) codes of a set, in OpenCV's sense of upright: 1 for white, -1 for black."""
    dictionary = dictionary_of(name)
    count, n = len(dictionary.bytesList), dictionary.markerSize
    bits = [cv2.aruco.Dictionary.getBitsFromByteList(dictionary.bytesList[k : k + 1], n) for k in range(count)]
    return 2.0 * np.asarray(bits, np.float64) - 1


def quad_homographies(quads: Floats) -> Floats:
    """(Q, 3, 3) homographies from the unit square to (Q, 4, 2) pixels, clockwise from the upper left.

    Quads without a homography, such as those whose corners lie on a line, are left out.
    """
    unit = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    found = [each for quad in quads if (each := fit_homography(unit, quad)) is not None]
    return np.array(found).reshape(-1, 3, 3)


def read_cells(image: Image, homographies: Floats, cells: int) -> Floats:
    """(Q, cells, cells) mean brightness of the cells of squares seen aslant.

    Args:
        image: (H, W)
        homographies: (Q, 3, 3) of `quad_homographies`.
        cells: cells along a side.
    """
    at = (np.arange(cells * SAMPLES) + 0.5) / (cells * SAMPLES)
    places = np.stack(np.meshgrid(at, at), axis=-1)
    flat = np.concatenate([np.zeros((0, cells * SAMPLES, 2)), *(map_points(each, places) for each in homographies)])
    flat = np.nan_to_num(flat, nan=-1.0).astype(np.float32)
    values = np.zeros(flat.shape[:2])
    # OpenCV takes maps of at most 32767 rows.
    for start in range(0, len(flat), REMAP_ROWS):
        part = flat[start : start + REMAP_ROWS]
        values[start : start + REMAP_ROWS] = cv2.remap(
            image, part[..., 0], part[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
    return np.asarray(values.reshape(len(homographies), cells, SAMPLES, cells, SAMPLES).mean(axis=(2, 4)))


def match_codes(cells: Floats, codes: Floats) -> tuple[Indices, Indices, Floats]:
    """For each of (Q, n, n) cells the code that they resemble most, (Q,): its number, its turn, and the correlation.

    A turn of k means that the code appears turned by k quarter turns anticlockwise, as `numpy.rot90` turns.
    """
    turned = np.stack([np.rot90(codes, k, axes=(1, 2)) for k in range(4)])
    templates = _normalise(turned.reshape(4 * len(codes), -1))
    scores = _normalise(cells.reshape(len(cells), codes[0].size)) @ templates.T
    best = scores.argmax(axis=1) if len(cells) else np.zeros(0, np.intp)
    return best % len(codes), best // len(codes), scores[np.arange(len(cells)), best]


def _normalise(rows: Floats) -> Floats:
    """Rows of mean 0 and length 1; 0 where they do not vary or are NaN."""
    rows = np.nan_to_num(rows)
    rows = rows - rows.mean(axis=1, keepdims=True)
    return np.asarray(rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-9))
