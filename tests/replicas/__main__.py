"""Faults of what shares one database, while robots push through all of it; says what was lost.

    $ python -m tests.replicas --seconds 60          # `make soak`
    $ python -m tests.replicas lost-tail --seeds 200

kills: one fault every few seconds: `kill -9` of a server or of a process that folds, a process that sleeps for longer
than its claims last, a server that is replaced by a newer one, the database that crashes. lost-tail: an older copy of
the database is put in its place, once for each seed. Ends with 1 where an acknowledged commit was lost or folded twice,
the chain or a cell is not what the commits say, a server sent something of a history that was lost, or robots were not
answered for 15 s.
"""

import argparse
import sys
import tempfile
from pathlib import Path

from tests.fixtures.server.postgres import programs_of
from tests.replicas.fault_run import FaultRun, fault_run
from tests.replicas.lost_tail import LostTails, lost_tail_run


def main() -> int:
    """Print what came of it."""
    parser = argparse.ArgumentParser("python -m tests.replicas", description=__doc__)
    parser.add_argument("run", nargs="?", choices=["kills", "lost-tail"], default="kills")
    parser.add_argument("--seconds", type=float, default=60.0, help="of kills (60)")
    parser.add_argument("--robots", type=int, default=4, help="of kills (4)")
    parser.add_argument("--seeds", type=int, default=20, help="of lost-tail (20)")
    parser.add_argument("--postgres", choices=["system", "wheel"], default="wheel")
    parser.add_argument("--seed", type=int, default=0, help="of kills, or the first of lost-tail (0)")
    given = parser.parse_args()
    programs = programs_of(given.postgres)
    found: FaultRun | LostTails
    with tempfile.TemporaryDirectory() as name:
        if given.run == "lost-tail":
            seeds = range(given.seed, given.seed + given.seeds)
            found = lost_tail_run(Path(name), programs, seeds=seeds)
        else:
            found = fault_run(Path(name), programs, seconds=given.seconds, robots=given.robots, seed=given.seed)
    for what, value in found.rows():
        sys.stdout.write(f"{what:<52}{value}\n")
    return int(not found.is_sound)


if __name__ == "__main__":
    sys.exit(main())
