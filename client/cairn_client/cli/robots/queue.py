"""`cairn robot queue`: the commits that a robot's folder keeps, oldest first.

    $ cairn robot queue state/
    captured (UTC)           size  cells  server has it  commit
    2026-11-20 14:05:11   40.6 kB      4  yes            mole.5f0c2a9be1d3f607.11
    2026-11-20 14:05:43   40.7 kB      5  no             mole.5f0c2a9be1d3f607.12

What the server has is kept until no restore of the server from a backup can lose it.
"""

import argparse
from datetime import UTC, datetime
from pathlib import Path

from cairn_client.cli.arguments import say, shown_bytes
from cairn_client.folders.folder_status import QueuedCommit, folder_queue


def add_parser(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the subcommand."""
    queue = commands.add_parser("queue", help="the commits that a robot's folder keeps", description=__doc__)
    queue.add_argument("folder", type=Path, metavar="DIR", help="the robot's folder")
    queue.add_argument("--json", action="store_true", help="print JSON: times in UTC seconds, sizes in bytes")
    queue.set_defaults(run=_queue)


def _queue(args: argparse.Namespace) -> int:
    queue = folder_queue(args.folder)
    if args.json:
        say(queue.model_dump_json())
        return 0
    if not queue.commits:
        say(f"(nothing: all commits of {queue.robot} are on map {queue.map} for good)")
        return 0
    say(f"{'captured (UTC)':<19} {'size':>9} {'cells':>6}  {'server has it':<13}  commit")
    for commit in queue.commits:
        known = "damaged" if commit.is_damaged else "yes" if commit.acknowledged else "no"
        size = shown_bytes(commit.size_bytes)
        note = f"  {commit.note}".replace("\n", " ").rstrip()
        say(f"{_captured(commit):<19} {size:>9} {commit.cells:>6}  {known:<13}  {commit.id}{note}")
    return 0


def _captured(commit: QueuedCommit) -> str:
    try:
        first_s = commit.captured_s[0] if commit.captured_s else None
        return "-" if first_s is None else datetime.fromtimestamp(first_s, UTC).strftime("%Y-%m-%d %H:%M:%S")
    except (OverflowError, ValueError, OSError):
        return "-"
