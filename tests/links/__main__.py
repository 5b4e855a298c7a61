"""Three robots map the building over links that fail, with `--kill` while they and their server are killed.

$ python -m tests.links --minutes 30
$ python -m tests.links --minutes 15 --kill
"""

import argparse
import sys
import tempfile
import time
from pathlib import Path

from tests.crowd.building import SCANS, survey
from tests.links.life import Building
from tests.links.soak import Outcome, Plan, Soak


def main() -> int:
    """Let it happen, and print what came of it."""
    parser = argparse.ArgumentParser("python -m tests.links", description=__doc__)
    parser.add_argument("--minutes", type=float, default=30.0, help="how long (30)")
    parser.add_argument("--kill", action="store_true", help="kill robots and server, too, every 3 s")
    parser.add_argument("--seed", type=int, default=int(time.time()), help="of faults and kills (the time)")
    parser.add_argument("--voxel", type=float, default=0.04, metavar="METRES", help="edge (0.04)")
    parser.add_argument("--stops", type=int, help="of the building's path (all 54)")
    parser.add_argument("--robot", default="orpheus", help="of cairn sim (orpheus)")
    parser.add_argument("--no-faults", action="store_true", help="of the proxy: the kernel has its own")
    given = parser.parse_args()
    seen = survey(robot=given.robot, voxel_m=given.voxel, stops=given.stops)
    building = Building(seen.geometry, seen.stops, SCANS[0] * SCANS[1])
    plan = Plan(
        seconds=60.0 * given.minutes,
        commit_every_s=2.0,
        cut_bytes=1_000_000,
        kill_every_s=3.0 if given.kill else None,
        has_faults=not given.no_faults,
        seed=given.seed,
    )
    sys.stdout.write(f"seed {given.seed}\n")
    with tempfile.TemporaryDirectory() as folder:
        soak = Soak(Path(folder), building, plan)
        try:
            outcome = soak.run(_tell)
        finally:
            soak.close()
    _tell(plan.seconds, outcome)
    verdict = outcome.verdict
    sys.stdout.write(f"{verdict.commits} commits, {verdict.cells} cells, {len(verdict.wrong)} things wrong\n")
    for what in verdict.wrong[:20]:
        sys.stdout.write(f"{what}\n")
    return min(1, len(verdict.wrong))


def _tell(seconds: float, outcome: Outcome) -> None:
    sys.stdout.write(
        f"{seconds:5.0f} s  {outcome.size_bytes / 1e6:.1f} MB, {outcome.connections} connections, {outcome.cuts} cut, "
        f"server killed {outcome.server_kills} times, robots {outcome.robot_kills}\n"
    )
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
