"""OpenCV's image_points, as its calibration sample writes them into its XML, YAML or JSON: the points of all images.

    image_width, image_height, board_width, board_height
    image_points: a matrix of two channels, a row for each image with a board, a column for each point (row by row)

The sample writes them where it is asked to (-op, Write_DetectedFeaturePoints). The file names no image and leaves out
those without a board, so that row 5 of two cameras may be of two moments.
"""

import cv2
import numpy as np

from cairn_calib.exchange.corner_list import KIND, SIGMA_PX, CornerList, ListedImage, isotropic, numbered
from cairn_map.errors import BadInputError

POINTS = "image_points"


def read_opencv_points(text: str, *, stem: str, name: str) -> CornerList:
    """The images of a file, numbered.

    Args:
        text: of the file.
        stem: images are named by it and their number.
        name: of the file, for messages.

    Raises:
        BadInputError: it is no FileStorage, or has no `image_points` of that form.
    """
    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        points = storage.getNode(POINTS).mat()
    except (cv2.error, SystemError) as exc:
        raise BadInputError(KIND, f"{name} is no file of OpenCV's FileStorage: {' '.join(str(exc).split())}") from exc
    if points is None:
        raise BadInputError(
            KIND,
            f"{name} has no matrix {POINTS}: OpenCV's calibration sample writes it with -op, or with "
            "<Write_DetectedFeaturePoints>1 in its settings",
        )
    values = np.asarray(points, np.float64)
    if values.ndim != 3 or values.shape[2] != 2 or not values.size:
        raise BadInputError(KIND, f"{name}: {POINTS} must be images x points of two channels, got {values.shape}")
    images = tuple(
        ListedImage(numbered(stem, number), pixels, isotropic(np.full(len(pixels), SIGMA_PX)))
        for number, pixels in enumerate(values, 1)
    )
    return CornerList(
        "OpenCV",
        images,
        board_size=_two(storage, "board_width", "board_height"),
        size_px=_two(storage, "image_width", "image_height"),
        is_named=False,
    )


def _two(storage: cv2.FileStorage, one: str, other: str) -> tuple[int, int] | None:
    nodes = storage.getNode(one), storage.getNode(other)
    if any(node.empty() or not node.isInt() for node in nodes):
        return None
    return int(nodes[0].real()), int(nodes[1].real())
