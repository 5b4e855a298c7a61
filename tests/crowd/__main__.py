"""A crowd of robots on one server for a while; ends with 1 where it did not answer in time, failed, or grew.

$ python -m tests.crowd --robots 200 --seconds 600     # `make soak`
$ python -m tests.crowd --robots 50 --seconds 60       # too short to say whether memory stays flat
"""

import argparse
import sys
import tempfile
import time
from pathlib import Path

from tests.crowd.building import survey
from tests.crowd.crowd import Crowd
from tests.crowd.figures import Seen
from tests.crowd.soak import soak
from tests.crowd.verdict import findings, summary
from tests.crowd.watch import Sample

PROGRESS_S = 60.0


def main() -> int:
    """Soak, and print what came of it."""
    parser = argparse.ArgumentParser("python -m tests.crowd", description=__doc__)
    parser.add_argument("--robots", type=int, default=200, help="connections that stay open")
    parser.add_argument("--whole", type=int, default=2, help="more robots, which keep the map")
    parser.add_argument("--servers", type=int, default=1, help="several share a PostgreSQL, and one more folds")
    parser.add_argument("--listeners", type=int, default=4, help="WebSockets")
    parser.add_argument("--seconds", type=float, default=600.0)
    parser.add_argument("--sync", type=float, default=2.0, metavar="SECONDS", help="between two fetches of a robot")
    parser.add_argument("--push", type=float, default=60.0, metavar="SECONDS", help="between two pushes of a robot")
    parser.add_argument("--robot", default="tof", help="what kind of robot the scans are of")
    parser.add_argument("--voxel", type=float, default=0.04, help="voxel edge, m")
    given = parser.parse_args()
    crowd = Crowd(given.robots, given.listeners, given.seconds, sync_s=given.sync, push_s=given.push)
    start_s = time.perf_counter()
    seen_by = survey(robot=given.robot, voxel_m=given.voxel)
    _say(f"{len(seen_by.scans)} scans of {given.robot} seen in {time.perf_counter() - start_s:.0f} s")
    with tempfile.TemporaryDirectory() as folder:
        outcome = soak(
            crowd,
            seen_by,
            Path(folder),
            whole_robots=given.whole,
            every_s=PROGRESS_S,
            progress=Progress().show,
            servers=given.servers,
        )
    for line in summary(outcome):
        _say(line)
    found = findings(outcome)
    for line in found:
        _say(f"NOT GOOD: {line}")
    return min(1, len(found))


class Progress:
    """A line each time, of what came since the last one."""

    def __init__(self) -> None:
        self._fetches = self._sample = 0

    def show(self, seconds: float, seen: Seen, samples: list[Sample]) -> None:
        """Print it."""
        fetches, last, now = seen.fetches.after(self._fetches), samples[self._sample], samples[-1]
        cpu = (now.cpu_s - last.cpu_s) / max(now.time_s - last.time_s, 1e-9)
        _say(
            f"{seconds:5.0f} s: fetch {fetches}; {len(seen.pushes)} pushes; server {now.resident_bytes / 1e6:.0f} MB, "
            f"{100 * cpu:.0f} % of a core; {seen.errors.total()} errors, {seen.skipped} rounds skipped"
        )
        self._fetches, self._sample = len(seen.fetches), len(samples) - 1


def _say(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
