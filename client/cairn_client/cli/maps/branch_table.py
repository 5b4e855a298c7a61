"""The robots of a map as a table: who is how far behind, when it was last heard of, and where it is."""

import math
import time
from collections.abc import Iterator

from cairn_client.cli.arguments import shown_bytes
from cairn_map.wire.messages import BranchInfo

HEAD = ("robot", "mode", "seen", "behind", "bytes", "waiting", "battery", "pose (m, deg)", "note")


def branch_table(branches: list[BranchInfo], *, now_s: float | None = None) -> Iterator[str]:
    """Lines of the table, columns as wide as they must be."""
    now_s = time.time() if now_s is None else now_s
    rows = [HEAD, *(_row(branch, now_s) for branch in branches)]
    widths = [max(len(row[c]) for row in rows) for c in range(len(HEAD))]
    for row in rows:
        yield "  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)).rstrip()


def shown_age(seconds: float) -> str:
    """How long ago, for people."""
    for limit, unit, size in ((120, "s", 1), (7200, "min", 60), (172_800, "h", 3600)):
        if seconds < limit:
            return f"{max(0.0, seconds) / size:.0f} {unit}"
    return f"{seconds / 86_400:.0f} d"


def _row(branch: BranchInfo, now_s: float) -> tuple[str, ...]:
    status = branch.status
    behind = "-" if branch.behind is None else str(branch.behind)
    if branch.mode == "low-end":
        behind = "cells"  # it fetches whole ones, and has no place in the log
    return (
        branch.branch,
        branch.mode,
        shown_age(now_s - branch.last_seen_s),
        behind,
        "-" if branch.behind_bytes is None else shown_bytes(branch.behind_bytes),
        f"{status.waiting} ({shown_bytes(status.waiting_bytes)})" if status else "-",
        f"{status.battery:.0%}" if status and status.battery is not None else "-",
        _shown_pose(branch),
        status.note.replace("\n", " ") if status else "",
    )


def _shown_pose(branch: BranchInfo) -> str:
    """Place and heading, and how surely."""
    if branch.status is None or branch.status.pose is None:
        return "-"
    pose = branch.status.pose
    x, y, z, w = pose.q_map_rig
    heading_deg = math.degrees(math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))
    place = ", ".join(f"{value:.2f}" for value in pose.t_map_rig)
    return f"{place} ±{pose.sigma_m:.2f}; {heading_deg:.0f}°"
