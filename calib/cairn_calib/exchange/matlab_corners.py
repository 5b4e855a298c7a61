"""MATLAB's corners of a checkerboard, as detectCheckerboardPoints returns them, in a MAT-file.

    >> [imagePoints, boardSize, used] = detectCheckerboardPoints(files, 'PartialDetections', false);
    >> imageFileNames = files(used);  imageSize = [1080 1920];
    >> save('left.mat', 'imagePoints', 'boardSize', 'imageFileNames', 'imageSize', '-v7')

`imagePoints` is (M, 2, images), column by column of the board, the centre of the top-left pixel at (1, 1), NaN where a
point was not found. `boardSize` counts squares, rows first: one more than there are points. `imageFileNames` and
`imageSize` (rows, columns) may be left out. An object cameraParameters cannot be read outside MATLAB: save the arrays.
"""

import numpy as np

from cairn_calib.exchange.corner_list import KIND, SIGMA_PX, CornerList, ListedImage, isotropic, numbered
from cairn_calib.exchange.mat_file import Array, read_mat
from cairn_map.errors import BadInputError

POINTS, BOARD, NAMES, SIZE = "imagePoints", "boardSize", "imageFileNames", "imageSize"
ORIGIN_PX = 1.0
"""MATLAB's coordinate of the centre of the first pixel."""


def read_matlab_points(data: bytes, *, stem: str, name: str) -> CornerList:
    """The images of a file; numbered where it has no names.

    Args:
        data: of the file.
        stem: images without names are named by it and their number.
        name: of the file, for messages.

    Raises:
        BadInputError: it is no MAT-file, or has no such arrays.
    """
    try:
        found = read_mat(data)
    except ValueError as exc:
        raise BadInputError(KIND, f"cannot read {name}: {exc}") from exc
    points, board = found.get(POINTS), _pair(found.get(BOARD))
    if not isinstance(points, np.ndarray) or board is None:
        there = ", ".join(found) or "none that can be read"
        raise BadInputError(
            KIND,
            f"{name} must hold the arrays {POINTS} and {BOARD} of detectCheckerboardPoints, and holds {there}: save "
            f"them with save('{name}', '{POINTS}', '{BOARD}', '-v7')",
        )
    rows, columns = board[0] - 1, board[1] - 1
    values = _pixels(points, rows * columns, name)
    names = found.get(NAMES)
    is_named = isinstance(names, list) and len(names) == len(values)
    # Point n of MATLAB is in row n mod rows, column n div rows.
    order = np.arange(rows * columns).reshape(columns, rows).T.ravel()
    images = []
    for number, pixels in enumerate(values):
        label = names[number] if isinstance(names, list) and is_named else numbered(stem, number + 1)
        sigma_px = np.where(np.isfinite(pixels).all(axis=1), SIGMA_PX, np.nan)
        images.append(ListedImage(label, pixels[order] - ORIGIN_PX, isotropic(sigma_px)[order]))
    size = _pair(found.get(SIZE))
    size_px = None if size is None else (size[1], size[0])
    return CornerList("MATLAB", tuple(images), board_size=(columns, rows), size_px=size_px, is_named=is_named)


def _pixels(points: Array, count: int, name: str) -> np.ndarray[tuple[int, int, int], np.dtype[np.float64]]:
    """(images, M, 2) pixels, MATLAB's."""
    if points.ndim == 4:
        raise BadInputError(
            KIND,
            f"{name}: {POINTS} is of two cameras: save {POINTS}(:, :, :, 1) and (:, :, :, 2) as {POINTS} into a "
            "file each",
        )
    stacked = points[..., None] if points.ndim == 2 else points
    if stacked.ndim != 3 or stacked.shape[:2] != (count, 2) or stacked.dtype.kind != "f":
        raise BadInputError(
            KIND, f"{name}: {POINTS} must be {count} points x 2 x images, as {BOARD} says, got {points.shape}"
        )
    values: np.ndarray[tuple[int, int, int], np.dtype[np.float64]] = np.ascontiguousarray(
        np.moveaxis(stacked, 2, 0), np.float64
    )
    return values


def _pair(value: Array | list[str] | None) -> tuple[int, int] | None:
    """Two whole numbers of an array."""
    if not isinstance(value, np.ndarray) or value.size < 2 or value.dtype.kind not in "fiu":
        return None
    one, other = (float(each) for each in value.ravel()[:2])
    return (int(one), int(other)) if 1 < one < 1e5 and 1 < other < 1e5 else None
