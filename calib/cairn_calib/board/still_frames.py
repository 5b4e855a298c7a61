"""Image of one still pose of a board: one file, or the mean of a folder's frames, which has less noise.

The noise of a mean of n frames is that of one by the root of n. If the board moved meanwhile, its edges are smeared and
its corners are wrong; so the first half of the frames is compared with the second at the corners that were found.
"""

import hashlib
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from cairn_calib.board.corners import Attempt, Corners, Detection
from cairn_calib.rig.image_files import Grey, read_grey
from cairn_map.errors import BadInputError

SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff")
MOVED_MAX_PX = 0.25
"""Largest move of the board between the means of both halves, pixels; its corners are then wrong by half as much."""
WINDOW = (5, 31)
"""Half widths that the comparison's window may have, pixels."""


@dataclass(frozen=True, slots=True)
class StillImage:
    """Image of one pose, with the number and digest of its frames."""

    counts: Grey
    """(H, W) float32: the mean of all frames."""
    sha256: str
    """Digest of the file's bytes; of several frames, of their bytes one after another, by name."""
    frames: int
    halves: tuple[Grey, Grey] | None
    """Means of the first and of the second half of the frames; None with a single frame."""


def read_still(path: Path) -> StillImage:
    """The image in a file, or the mean of the frames in a folder.

    Raises:
        BadInputError: a file is missing or too large; a folder has no images, or images of several sizes.
        DamagedDataError: a file cannot be decoded.
    """
    if not path.is_dir():
        counts, data = read_grey(path)
        return StillImage(counts, hashlib.sha256(data).hexdigest(), 1, None)
    paths = sorted(each for each in path.iterdir() if each.suffix.lower() in SUFFIXES)
    if not paths:
        raise BadInputError("missing_image", f"{path} must hold the frames of one pose ({', '.join(SUFFIXES)})")
    # One frame in memory at a time: a sum for each half.
    digest, sums = hashlib.sha256(), [np.zeros(0), np.zeros(0)]
    for at, each in enumerate(paths):
        counts, data = read_grey(each)
        digest.update(data)
        half = 2 * at // len(paths)
        if sums[0].size and counts.shape != sums[0].shape:
            raise BadInputError("image_size", f"{each} is {counts.shape[::-1]}, other frames {sums[0].shape[::-1]}")
        sums[half] = sums[half] + counts if sums[half].size else counts.astype(np.float64)
    if len(paths) == 1:
        return StillImage(sums[0].astype(np.float32), digest.hexdigest(), 1, None)
    # With an odd number of frames the first half has one more, as 2 * at // len(paths) counts.
    first = (len(paths) + 1) // 2
    halves = (sums[0] / first).astype(np.float32), (sums[1] / (len(paths) - first)).astype(np.float32)
    mean = ((sums[0] + sums[1]) / len(paths)).astype(np.float32)
    return StillImage(mean, digest.hexdigest(), len(paths), halves)


def refuse_movement(image: StillImage, detection: Detection) -> Detection:
    """The detection; one without corners, with the reason, if the board moved between the frames."""
    if image.halves is None or detection.corners is None:
        return detection
    moved = _moved_px(*image.halves, detection.corners)
    if moved < MOVED_MAX_PX:
        return detection
    last = detection.attempts[-1]
    reason = (
        f"the board moved by {moved:.2f} px from the first half of its {image.frames} frames to the second, at most "
        f"{MOVED_MAX_PX} px: give single frames"
    )
    return Detection(None, (*detection.attempts[:-1], Attempt(last.method, last.scale, "stillness", reason)))


def _moved_px(first: Grey, second: Grey, corners: Corners) -> float:
    """Median distance of a board's points between two images, pixels; Lucas and Kanade's method."""
    low, high = np.percentile(first, (0.5, 99.8))
    scale = 255 / max(float(high - low), 1e-9)
    before, after = (np.clip((each - low) * scale, 0, 255).astype(np.uint8) for each in (first, second))
    at = corners.pixels[corners.seen].astype(np.float32)
    # A window of most of a cell, so that neighbours do not take part.
    apart = np.linalg.norm(at[:, None] - at[None], axis=2)
    apart[np.diag_indices(len(at))] = np.inf
    side = 2 * int(np.clip(0.7 * np.median(apart.min(axis=1)), *WINDOW)) + 1
    moved, found, _ = cv2.calcOpticalFlowPyrLK(before, after, at, np.empty_like(at), winSize=(side, side))
    there = np.asarray(found).ravel() > 0
    return float(np.median(np.linalg.norm(np.asarray(moved) - at, axis=1)[there])) if there.any() else float("inf")
