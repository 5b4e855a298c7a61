"""Corners as other programs' files hold them: images by name, the points of a board in order, and their noise.

    mrcal .vnl, OpenCV's image_points, MATLAB's imagePoints, a table (CSV)      a module each
        -> CornerList -> corner documents (`corner_file.py`)

A board's points are in the order of `board.py`. Where a file says nothing about noise, each point has the same,
`SIGMA_PX`: `cairn calib solve` estimates each camera's noise itself, so that only the ratios count.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatch
from pathlib import PurePath

import numpy as np
from pydantic import ValidationError

from cairn_calib.board.board import Board, Pattern
from cairn_calib.board.corner_file import CornerFile, corner_file
from cairn_calib.board.corners import Attempt, Corners, Detection
from cairn_map.arrays import Floats
from cairn_map.errors import BadInputError, first_error

KIND = "bad_corner_list"
SIGMA_PX = 0.1
"""Standard deviation of a point, one axis, pixels, where a file does not say it, and of weight 1 or level 0."""
IMAGES_MAX = 100_000


@dataclass(frozen=True, slots=True)
class ListedImage:
    """Points of one image; none where no board was found."""

    name: str
    pixels: Floats
    """(N, 2) x, y; the centre of the top-left pixel is (0, 0); NaN where a point is hidden."""
    covariance_px2: Floats
    """(N, 2, 2) pixels squared."""


@dataclass(frozen=True, slots=True)
class CornerList:
    """The images of one file."""

    program: str
    images: tuple[ListedImage, ...]
    board_size: tuple[int, int] | None = None
    """Columns and rows, where the file states them."""
    size_px: tuple[int, int] | None = None
    """Width and height of the images, where the file states them."""
    is_named: bool = True
    """False where the file has no names of images: they are numbered as they stand in it."""

    def matching(self, pattern: str) -> "CornerList":
        """The images whose path, or whose name without folders, matches a pattern such as `*-cam0.jpg`.

        Raises:
            BadInputError: none does.
        """
        kept = [each for each in self.images if fnmatch(each.name, pattern) or fnmatch(_leaf(each.name), pattern)]
        if not kept:
            names = ", ".join(each.name for each in self.images[:3])
            raise BadInputError(KIND, f"no image of the file matches {pattern!r}; there are {names}, ...")
        return replace(self, images=tuple(kept))


def isotropic(sigma_px: Floats) -> Floats:
    """(N, 2, 2) covariances of (N,) standard deviations."""
    return sigma_px[:, None, None] ** 2 * np.eye(2)


def numbered(stem: str, number: int) -> str:
    """Name of an image that has none: the file's, and a number from 1."""
    return f"{stem}-{number:04d}"


def board_of(
    listed: CornerList, *, size: tuple[int, int] | None, pitch_m: float, pattern: Pattern, disc_m: float | None
) -> Board:
    """The board of a list: its size as given, or as the file states it.

    Raises:
        BadInputError: neither says it, or both and not the same.
    """
    if size is None and listed.board_size is None:
        raise BadInputError("bad_arguments", f"{listed.program}'s file does not say the board's size: add --board")
    if size is not None and listed.board_size is not None and size != listed.board_size:
        told = "x".join(map(str, listed.board_size))
        raise BadInputError("bad_arguments", f"the board in the file is {told}, --board is {size[0]}x{size[1]}")
    columns, rows = size or listed.board_size or (0, 0)
    try:
        return Board(pattern=pattern, columns=columns, rows=rows, pitch_m=pitch_m, disc_m=disc_m)
    except ValidationError as exc:
        raise BadInputError("bad_board", first_error(exc)) from exc


def corners_of(image: ListedImage, board: Board, *, source: str) -> Detection:
    """The points of one image as a detection.

    Raises:
        BadInputError: there are not as many as the board has, or they run the wrong way round.
    """
    if not len(image.pixels):
        return Detection(None, (Attempt("import", 1.0, "candidates", f"no board in {source}"),))
    if len(image.pixels) != board.count:
        raise BadInputError(
            KIND,
            f"{image.name}: {source} has {len(image.pixels)} points of it, the board has {board.columns} x "
            f"{board.rows} = {board.count}: is the board's size right? Of a chessboard it counts inner corners",
        )
    pixels, covariance_px2 = image.pixels.copy(), image.covariance_px2.copy()
    hidden = ~np.isfinite(pixels[:, 0] + pixels[:, 1])
    pixels[hidden], covariance_px2[hidden] = np.nan, np.nan
    corners = Corners(board, pixels, covariance_px2)
    if is_mirrored(corners):
        raise BadInputError(
            KIND,
            f"{image.name}: its points run mirrored: going along a row, the next row must be to the right hand, as "
            f"seen in the image. Give --board as {board.rows}x{board.columns} if columns and rows are swapped in "
            f"{source}; else the image was mirrored, or its points go column by column",
        )
    return Detection(corners, (Attempt("import", 1.0, "found", f"from {source}"),))


def is_mirrored(corners: Corners) -> bool:
    """True if the points run counter-clockwise in the image: no board that is seen from the front does.

    By the affine map that fits them best; False for points in a line.
    """
    places = np.column_stack([corners.board.lattice(), np.ones(corners.board.count)])[corners.seen]
    fitted, *_ = np.linalg.lstsq(places, corners.pixels[corners.seen], rcond=None)
    return float(np.linalg.det(fitted[:2])) < 0


def documents(
    listed: CornerList, board: Board, *, source: str, files: Sequence[tuple[str | None, tuple[int, int]] | None]
) -> Iterator[tuple[str, CornerFile]]:
    """A corner document for each image, by its name without suffix.

    Args:
        listed: the list.
        board: of all images.
        source: the file's name, for people.
        files: digest and size of each image, None where both are unknown.

    Raises:
        BadInputError: two images have one name, or an image's size is not known, or its points are not the board's.
    """
    stems: dict[str, str] = {}
    for image, file in zip(listed.images, files, strict=True):
        stem = PurePath(_leaf(image.name)).stem
        if stem in stems:
            raise BadInputError(
                KIND,
                f"{stems[stem]} and {image.name} have one name without their folders: choose one camera's images with "
                "--images PATTERN, such as 'left/*'",
            )
        stems[stem] = image.name
        size = listed.size_px if file is None else file[1]
        if size is None:
            raise BadInputError(
                "bad_arguments",
                f"how large the images are is not in {source}, and {image.name} is not there to look: add --size "
                "WIDTHxHEIGHT",
            )
        detection = corners_of(image, board, source=source)
        _check_inside(image, size)
        sha256 = None if file is None else file[0]
        yield (
            stem,
            corner_file(detection, board, image=_leaf(image.name), sha256=sha256, size=size, polarity="normal"),
        )


def _check_inside(image: ListedImage, size: tuple[int, int]) -> None:
    far = np.nanmax(np.abs(image.pixels - (np.array(size) - 1) / 2) - np.array(size) / 2, initial=-np.inf)
    if far > max(size) / 2:
        raise BadInputError(
            KIND,
            f"{image.name}: points are up to {far:.0f} px outside its {size[0]} x {size[1]} pixels: is --size right?",
        )


def _leaf(name: str) -> str:
    return PurePath(name.replace("\\", "/")).name
