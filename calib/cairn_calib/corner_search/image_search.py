"""Search of a board in one image: its document and its picture, or the reason why there are no corners.

The work of one image depends on nothing but that image, so that images can be searched in any process and order.
"""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from cairn_calib.board.board import Board, Polarity
from cairn_calib.board.corner_detection import grey
from cairn_calib.board.corner_file import CornerFile, corner_file, read_corner_file
from cairn_calib.board.corner_pictures import encode_picture, overlay
from cairn_calib.board.corners import BY_HAND, NOT_REFUSED, Attempt, Detection
from cairn_calib.board.discs.disc_grid import disc_candidates
from cairn_calib.board.polarity import PolarityCandidates, chessboard_candidates, reverse_corners
from cairn_calib.board.still_frames import StillImage, read_still, refuse_movement
from cairn_calib.corner_search.coded_search import coded_candidates
from cairn_map.arrays import Floats
from cairn_map.errors import BadInputError, DamagedDataError

READING, REPEATED, FAILED = UNSEARCHED = "reading", "repeated", "failed"
"""Stages of images in which no corners were searched, or whose search broke off."""


@dataclass(frozen=True, slots=True)
class BoardSearch:
    """The board of a camera's images, and all that is known of how it is seen."""

    board: Board
    polarity: Polarity | Literal["vote"] = "vote"
    upright: bool = False


@dataclass(frozen=True, slots=True)
class ImageTask:
    """One image to be searched; `document` is that of an earlier run, which counts if it is of this image and board."""

    path: Path
    search: BoardSearch
    pointed: Floats | None = None
    document: Path | None = None


@dataclass(frozen=True, slots=True)
class SearchedImage:
    """Outcome of one image."""

    document: CornerFile
    picture: bytes | None
    """PNG; None for an image that could not be read, or that an earlier run did."""
    counts_sha256: bytes | None
    """Digest of its counts; None for an image that could not be read."""
    is_kept: bool = False
    """True if an earlier run's document counts."""


def search_image(task: ImageTask) -> SearchedImage:
    """Search the board in one image.

    Under the polarity "vote" the document is named by what the image itself tells, and holds its vote.

    Raises:
        BadInputError: no image tells the first corner of this board.
    """
    try:
        image = read_still(task.path)
        grey(image.counts)
    except (BadInputError, DamagedDataError) as exc:
        return SearchedImage(_document(task, None, _none(READING, exc.message)), None, None)
    digest = hashlib.sha256(image.counts.tobytes()).digest()
    kept = _earlier(task, image)
    if kept is not None:
        return SearchedImage(kept, None, digest, is_kept=True)
    candidates = _candidates(image, task)
    document = _document(task, image, candidates)
    return SearchedImage(document, draw(image, document), digest)


def repeat_of(searched: SearchedImage, task: ImageTask, first: str) -> SearchedImage:
    """The outcome of an image that has the same counts as the one named `first`, and therefore no corners."""
    # The board has moved since, and its place is not in it.
    why = f"the same counts as {first}; cameras repeat an image when they lose one, or level themselves"
    image = read_still(task.path)
    document = _document(task, image, _none(REPEATED, why))
    return replace(searched, document=document, picture=draw(image, document), is_kept=False)


def settle(searched: SearchedImage, task: ImageTask, polarity: Polarity) -> SearchedImage:
    """The outcome under the polarity that all images settled; the same where it is that already."""
    document = searched.document
    if document.polarity == polarity:
        return searched
    settled = document.model_copy(update={"polarity": polarity})
    if document.attempts[-1].stage in UNSEARCHED:
        return replace(searched, document=settled)
    if "circles" in document.board.pattern:
        # Discs of one polarity are no discs of the other.
        task = replace(task, search=replace(task.search, polarity=polarity), document=None)
        again = search_image(task)
        return replace(again, document=again.document.model_copy(update={"vote": document.vote}))
    corners = document.to_corners()
    if (
        corners is None
        or document.board.pattern != "chessboard"
        or task.search.upright
        or document.attempts[-1].method == BY_HAND
    ):
        return replace(searched, document=settled)
    turned = corner_file(
        Detection(reverse_corners(corners), ()),
        document.board,
        image=document.image,
        sha256=document.image_sha256,
        size=None,
        polarity=polarity,
    )
    settled = settled.model_copy(update={"corners": turned.corners})
    return replace(searched, document=settled, picture=draw(read_still(task.path), settled))


def draw(image: StillImage, document: CornerFile) -> bytes:
    """PNG of an image with the corners of its document."""
    return encode_picture(overlay(image.counts, document.to_corners(), title=outcome_line(document)))


def outcome_line(document: CornerFile) -> str:
    """One line on an image: its corners and their standard deviation, or the furthest stage, and why it ended there."""
    corners, last = document.to_corners(), document.attempts[-1]
    if corners is None:
        furthest = max(document.attempts, key=lambda attempt: attempt.stage != "candidates")
        return f"{document.image}: no board ({furthest.stage}: {furthest.reason})"
    sigma = float(np.sqrt(np.nanmedian(np.trace(corners.covariance_px2, axis1=1, axis2=2) / 2)))
    _, odd, why = last.reason.partition(f"; {NOT_REFUSED}")
    return (
        f"{document.image}: {corners.seen.sum()} of {len(corners.seen)} corners, sigma {sigma:.3f} px "
        f"({last.method} x{last.scale:g}){odd}{why}"
    )


def _earlier(task: ImageTask, image: StillImage) -> CornerFile | None:
    """The document of an earlier run, if a search would give it again."""
    if task.document is None or task.pointed is not None:
        return None
    try:
        found = read_corner_file(task.document)
    except (BadInputError, DamagedDataError):
        return None
    asked = task.search
    is_same = (found.image, found.image_sha256, found.frames) == (task.path.name, image.sha256, image.frames)
    is_same &= (found.board, found.upright) == (asked.board, asked.upright)
    # With a stated polarity no image has a vote of its own.
    is_same &= asked.polarity == "vote" or (found.polarity, found.vote) == (asked.polarity, asked.polarity)
    last = found.attempts[-1] if found.attempts else None
    is_own = last is not None and last.stage not in UNSEARCHED and last.method != BY_HAND
    return found if is_same and is_own else None


def _candidates(image: StillImage, task: ImageTask) -> PolarityCandidates:
    search = task.search
    look: Callable[..., PolarityCandidates] = disc_candidates
    if search.board.pattern == "chessboard":
        look = chessboard_candidates
    if search.board.has_tags:
        look = coded_candidates
    try:
        found = look(image.counts, search.board, polarity=search.polarity, upright=search.upright, pointed=task.pointed)
        return found.filter(lambda detection: refuse_movement(image, detection))
    except (cv2.error, np.linalg.LinAlgError, MemoryError) as exc:
        # One image that breaks the search must not end that of the others.
        return _none(FAILED, f"{type(exc).__name__}: {exc}")


def _none(stage: str, reason: str) -> PolarityCandidates:
    """Candidates of an image in which no corners were searched, with the reason."""
    nothing = Detection(None, (Attempt("image", 1.0, stage, reason),))
    return PolarityCandidates(nothing, nothing, None)


def _document(task: ImageTask, image: StillImage | None, candidates: PolarityCandidates) -> CornerFile:
    stated = task.search.polarity
    polarity: Polarity = (candidates.vote or "normal") if stated == "vote" else stated
    return corner_file(
        candidates.detection(polarity),
        task.search.board,
        image=task.path.name,
        sha256=None if image is None else image.sha256,
        size=None if image is None else (image.counts.shape[1], image.counts.shape[0]),
        polarity=polarity,
        vote=candidates.vote if stated == "vote" else stated,
        upright=task.search.upright,
        frames=1 if image is None else image.frames,
    )
