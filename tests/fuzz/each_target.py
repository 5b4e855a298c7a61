"""Targets fuzzed, each in a process forked from one that has imported and compiled all that they need.

    $ python -m tests.fuzz.each_target cell view --seconds 60 --jobs 2 --folder some/where
    view 0
    cell 77

One line as each ends: its exit code, negative for a signal. What it said is in `some/where/NAME/said`, and its finding
beside it in `findings`. Starting takes several seconds, as much as a short fuzz itself: hence once for all.
"""

import argparse
import os
import sys
import time
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.connection import wait
from multiprocessing.context import ForkProcess
from pathlib import Path
from typing import TYPE_CHECKING

from tests.fuzz.one_target import CORPUS, fuzz, instrumented_targets, read_seeds

if TYPE_CHECKING:
    from tests.fuzz.targets import Target

SAID, FOUND_IN, GROWN = "said", "findings", "grown"
"""In a target's folder; `grown` holds the inputs that were found to reach more."""
ENDING_S = 300
"""Of wall time that a fuzz may take beyond its own, on a busy machine."""


@dataclass(frozen=True, slots=True)
class Running:
    """A target under way."""

    name: str
    process: ForkProcess
    ends_by_s: float


def main() -> None:
    """Fuzz the targets, `jobs` at a time."""
    parser = argparse.ArgumentParser("python -m tests.fuzz.each_target", description=__doc__)
    parser.add_argument("targets", nargs="+", metavar="TARGET")
    parser.add_argument("--seconds", type=int, required=True, help="of each target")
    parser.add_argument("--jobs", type=int, required=True, help="targets at a time")
    parser.add_argument("--folder", type=Path, required=True, help="has a folder for each target")
    given = parser.parse_args()
    targets = instrumented_targets()
    for name in given.targets:
        with suppress(Exception):  # it reads them again itself, and says what is wrong
            read_seeds(targets[name], CORPUS / name)
    waiting, running = list(given.targets), list[Running]()
    while waiting or running:
        while waiting and len(running) < given.jobs:
            name = waiting.pop(0)
            running.append(_started(name, targets[name], given.folder / name, seconds=given.seconds))
        for one in _ended(running):
            running.remove(one)
            sys.stdout.write(f"{one.name} {one.process.exitcode}\n")
            sys.stdout.flush()


def _started(name: str, target: "Target", folder: Path, *, seconds: int) -> Running:
    process = get_context("fork").Process(target=_fuzz, args=(name, target, folder, seconds))
    process.start()
    return Running(name, process, time.monotonic() + seconds + ENDING_S)


def _fuzz(name: str, target: "Target", folder: Path, seconds: int) -> None:
    with (folder / SAID).open("wb") as said:
        for stream in (sys.stdout, sys.stderr):
            os.dup2(said.fileno(), stream.fileno())
    fuzz(target, CORPUS / name, seconds=seconds, grown=folder / GROWN, findings=folder / FOUND_IN)


def _ended(running: list[Running]) -> list[Running]:
    """Those that have ended, one at least; one that does not end in time is killed."""
    first = min(running, key=lambda one: one.ends_by_s)
    if not wait([one.process.sentinel for one in running], timeout=max(0, first.ends_by_s - time.monotonic())):
        first.process.kill()
        first.process.join()
    return [one for one in running if not one.process.is_alive()]


if __name__ == "__main__":
    main()
