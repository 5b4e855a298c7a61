"""Slow, obvious twins of rays through voxels: each voxel is tried."""

import itertools
import math


def passes(start: tuple[float, ...], end: tuple[float, ...], voxel: tuple[int, ...], *, grown: float) -> bool:
    """Whether a segment meets a voxel's cube, grown by so much on each side (or shrunken, if negative).

    A statement about the solid, not a walk: the parameters at which each axis is inside must overlap.
    """
    first, last = 0.0, 1.0
    for s, e, v in zip(start, end, voxel, strict=True):
        low, high = v - grown, v + 1 + grown
        if e == s:
            if not low <= s <= high:
                return False
            continue
        a, b = sorted(((low - s) / (e - s), (high - s) / (e - s)))
        first, last = max(first, a), min(last, b)
    return first <= last


def voxels_passed(start: tuple[float, ...], end: tuple[float, ...], *, grown: float) -> set[tuple[int, ...]]:
    """All voxels that a segment meets, each tried."""
    spans = [
        range(math.floor(min(s, e) - grown) - 1, math.floor(max(s, e) + grown) + 2)
        for s, e in zip(start, end, strict=True)
    ]
    return {voxel for voxel in itertools.product(*spans) if passes(start, end, voxel, grown=grown)}
