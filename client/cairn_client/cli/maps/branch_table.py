"""`cairn map branches`: the robots of a map as a table: how far behind, when last heard of, and where."""

import argparse
import json
import math
import time
from collections.abc import Iterator

from cairn_client.cli.arguments import Subparsers, add_map_parser, api_of, say, shown_age, shown_bytes
from cairn_client.sync.responses import one_line
from cairn_map.wire.messages import BranchInfo
from cairn_map.wire.utc_times import with_utc

FAR_M = 1e7
"""Metres from which on centimetres are not shown: a pose may be anything."""
HEAD = ("robot", "mode", "seen", "behind", "bytes", "waiting", "battery", "pose (m, deg)", "note")


def add_parser(commands: Subparsers) -> None:
    """Add the subcommand."""
    listing = add_map_parser(commands, "branches", _branches, text="the robots of a map: lag, last sign of life, pose")
    listing.add_argument("--json", action="store_true", help="print JSON")


def _branches(args: argparse.Namespace) -> int:
    api, name = api_of(args.map, args.token)
    with api:
        branches = api.branches(name)
    if args.json:
        say(json.dumps([with_utc(branch).model_dump(mode="json") for branch in branches]))
        return 0
    for line in branch_table(branches):
        say(line)
    if not branches:
        say("(none yet; a robot registers by itself when it first syncs)")
    return 0


def branch_table(branches: list[BranchInfo], *, now_s: float | None = None) -> Iterator[str]:
    """Lines of the table, columns as wide as they must be."""
    now_s = time.time() if now_s is None else now_s
    rows = [HEAD, *(_row(branch, now_s) for branch in branches)]
    widths = [max(len(row[c]) for row in rows) for c in range(len(HEAD))]
    for row in rows:
        yield "  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)).rstrip()


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
        one_line(status.note) if status else "",
    )


def _shown_pose(branch: BranchInfo) -> str:
    """Place, its standard deviation, and heading."""
    if branch.status is None or branch.status.pose is None:
        return "-"
    pose = branch.status.pose
    x, y, z, w = pose.q_map_rig
    heading_deg = math.degrees(math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))
    place = ", ".join(shown_metres(value) for value in pose.t_map_rig)
    return f"{place} ±{shown_metres(pose.sigma_m)}; {heading_deg:.0f}°"


def shown_metres(value: float) -> str:
    """Metres with two digits behind the point; three digits of what is too far for a map."""
    return f"{value:.2f}" if abs(value) < FAR_M else f"{value:.3g}"
