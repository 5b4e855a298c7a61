"""Doubts about the way of a source's sensor and the unit of its ranges: sentences for people, before it is mapped.

    times that run backwards    a scan whose time is before that of the scan before it
    jumps                       a step that no robot makes between two scans
    extent                      a way of some millimetres or of kilometres: another unit than the metre
    ranges                      a first scan whose ranges are millimetres, or thousands of metres, as metres

Pose files have checks of their own, which refuse; a recording's own poses are taken as they are, and said.
"""

from collections.abc import Iterator

import numpy as np

from cairn_fusion.recording.frame_poses import LARGE_EXTENT_M, SMALL_EXTENT_M
from cairn_fusion.recording.recording import ScanSource

JUMP_M, JUMP_M_PER_S = 10.0, 50.0
"""Step between two scans, and its speed, both of which a doubted one exceeds."""
NEAR_M = 0.02
"""Median range below which the unit is doubted."""


def way_doubts(source: ScanSource) -> Iterator[str]:
    """Sentences that begin with `doubt:`, each with a count and the first scan concerned."""
    places = [source.place(index) for index in range(len(source))]
    times_s = np.array([time_s for time_s, _ in places])
    t = np.array([T[:3, 3] for _, T in places])
    if len(places) > 1:
        steps_s, steps_m = np.diff(times_s), np.linalg.norm(np.diff(t, axis=0), axis=1)
        back = np.flatnonzero(steps_s < 0) if source.has_times else np.empty(0, int)
        if len(back):
            yield (
                f"doubt: {len(back)} times run backwards; the first: scan {back[0] + 1} is {-steps_s[back[0]]:.6g} s "
                f"before scan {back[0]}"
            )
        # Scans far apart in time may be far apart in space.
        allowed_m = np.maximum(JUMP_M, JUMP_M_PER_S * np.maximum(steps_s, 0)) if source.has_times else JUMP_M
        jumps = np.flatnonzero(steps_m > allowed_m)
        if len(jumps):
            yield (
                f"doubt: {len(jumps)} steps that no robot makes; the first: {steps_m[jumps[0]]:.4g} m from scan "
                f"{jumps[0]} to scan {jumps[0] + 1}"
            )
        extent_m = float(np.linalg.norm(t.max(axis=0) - t.min(axis=0)))
        if 0 < extent_m < SMALL_EXTENT_M or extent_m > LARGE_EXTENT_M:
            yield f"doubt: the poses span {extent_m:.4g} m in all: is their unit the metre?"
    range_m = source.scan(0).range_m
    seen = range_m[np.isfinite(range_m)]
    if len(seen) and float(np.median(seen)) < NEAR_M:
        yield (
            f"doubt: the ranges of the first scan have a median of {float(np.median(seen)):.4g} m: is their unit right "
            "(--depth-units of a folder of frames)?"
        )
