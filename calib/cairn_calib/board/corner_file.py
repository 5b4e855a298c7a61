"""Files of corners: one JSON document an image, and the four-corner file that helps where detection failed.

CONVENTIONS.md has both formats. A document of an image without a board has no corners, and names the stage
at which each attempt ended.
"""

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from cairn_calib.board.board import Board, Polarity
from cairn_calib.board.corners import Attempt, Corners, Detection
from cairn_map.arrays import Floats
from cairn_map.errors import BadInputError, DamagedDataError, first_error

Number = Annotated[float, Field(allow_inf_nan=False, ge=-1e6, le=1e6)]
Pair = tuple[Number, Number]
Side = Annotated[int, Field(ge=1, le=16384)]
FILE_BYTES_MAX = 16 << 20
SIGNIFICANT = 6
"""Decimals of pixels: a millionth."""


class CornerEntry(BaseModel):
    """One point of the board that is seen."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    column: Annotated[int, Field(ge=0, lt=64)]
    row: Annotated[int, Field(ge=0, lt=64)]
    pixel: Pair
    covariance_px2: tuple[Pair, Pair]


class AttemptEntry(BaseModel):
    """Outcome of one method at one scale."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    method: str
    scale: Number
    stage: str
    reason: str


class CornerFile(BaseModel):
    """The document of one image."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    format: Literal["cairn-corners"] = "cairn-corners"
    version: Literal[1] = 1
    image: str
    image_sha256: Annotated[str, Field(pattern="^[0-9a-f]{64}$")] | None
    """None, as the size, of an image that could not be read."""
    frames: Annotated[int, Field(ge=1, le=1 << 20)] = 1
    """Number of frames of a still pose, whose mean the image is."""
    width: Side | None
    height: Side | None
    board: Board
    polarity: Polarity
    vote: Polarity | None = None
    """Polarity that the image itself tells, if any, or that was stated; `polarity` is that of all images together."""
    upright: bool = False
    """True if the first point is named by the rows of the image, not by the board's colours."""
    disc_pitches: Annotated[float, Field(gt=0, le=2)] | None = None
    """Diameter of the discs as this image shows it, pitches."""
    corners: Annotated[tuple[CornerEntry, ...], Field(max_length=64 * 64)]
    attempts: tuple[AttemptEntry, ...]

    def to_corners(self) -> Corners | None:
        """The corners as arrays, None where there are none.

        Raises:
            DamagedDataError: a corner is none of the board's, or comes twice.
        """
        pixels, covariance = np.full((self.board.count, 2), np.nan), np.full((self.board.count, 2, 2), np.nan)
        for entry in self.corners:
            at = entry.row * self.board.columns + entry.column
            if entry.column >= self.board.columns or entry.row >= self.board.rows or np.isfinite(pixels[at, 0]):
                raise DamagedDataError(
                    "bad_corners",
                    f"{self.image}: corner {entry.column}, {entry.row} is not on the board, or comes twice",
                )
            pixels[at], covariance[at] = entry.pixel, entry.covariance_px2
        return Corners(self.board, pixels, covariance) if self.corners else None


class OuterCornersFile(BaseModel):
    """Corners that a person pointed at, to a few pixels: by image name, four outer ones or all."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    format: Literal["cairn-outer-corners"]
    version: Literal[1]
    images: dict[str, Annotated[tuple[Pair, ...], Field(min_length=4, max_length=64 * 64)]]


def corner_file(
    detection: Detection,
    board: Board,
    *,
    image: str,
    sha256: str | None,
    size: tuple[int, int] | None,
    polarity: Polarity,
    vote: Polarity | None = None,
    upright: bool = False,
    frames: int = 1,
) -> CornerFile:
    """Document of a detection in an image of `size` (width, height), which is the mean of `frames` frames.

    Digest and size are None for an image that could not be read.
    """
    width, height = (None, None) if size is None else size
    found = detection.corners
    entries = [] if found is None else [_entry(found, int(at)) for at in np.flatnonzero(found.seen)]
    return CornerFile(
        image=image,
        image_sha256=sha256,
        frames=frames,
        width=width,
        height=height,
        board=board,
        polarity=polarity,
        vote=vote,
        upright=upright,
        disc_pitches=None if detection.disc_pitches is None else round(detection.disc_pitches, SIGNIFICANT),
        corners=tuple(entries),
        attempts=tuple(_attempt_entry(attempt) for attempt in detection.attempts),
    )


def read_corner_file(path: Path) -> CornerFile:
    """The document in a file.

    Raises:
        BadInputError: no such file, or larger than 16 MiB.
        DamagedDataError: it is not of this format and version.
    """
    try:
        return CornerFile.model_validate_json(_read(path))
    except ValidationError as exc:
        raise DamagedDataError("bad_corners", f"{path} is no file of corners: {first_error(exc)}") from exc


def read_outer_corners(path: Path, board: Board) -> dict[str, Floats]:
    """(4, 2) or (N, 2) pixels by image name.

    Raises:
        BadInputError: no such file, not of this format, or neither 4 nor as many corners as the board has.
    """
    try:
        file = OuterCornersFile.model_validate_json(_read(path))
    except ValidationError as exc:
        raise BadInputError("bad_corners", f"{path} is no file of outer corners: {first_error(exc)}") from exc
    for name, corners in file.images.items():
        if len(corners) not in (4, board.count):
            raise BadInputError(
                "bad_corners", f"{path}: {name} must have 4 corners or all {board.count}, and has {len(corners)}"
            )
    return {name: np.array(corners, np.float64) for name, corners in file.images.items()}


def _entry(corners: Corners, at: int) -> CornerEntry:
    x, y = corners.pixels[at].round(SIGNIFICANT).tolist()
    (xx, xy), (yx, yy) = corners.covariance_px2[at].tolist()
    row, column = divmod(at, corners.board.columns)
    return CornerEntry(column=column, row=row, pixel=(x, y), covariance_px2=((xx, xy), (yx, yy)))


def _attempt_entry(attempt: Attempt) -> AttemptEntry:
    return AttemptEntry(method=attempt.method, scale=attempt.scale, stage=attempt.stage, reason=attempt.reason)


def _read(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            data = file.read(FILE_BYTES_MAX + 1)
    except OSError as exc:
        raise BadInputError("missing_file", f"cannot read {path}: {exc.strerror}") from exc
    if len(data) > FILE_BYTES_MAX:
        raise BadInputError("file_too_large", f"{path} must be at most {FILE_BYTES_MAX} bytes, and is larger")
    return data
