"""Kill, stop and crash what shares one database while robots push through all of it, and say what was lost.

    $ python -m tests.replicas --seconds 60          # `make soak`

One fault every few seconds: `kill -9` of a server or of a process that folds, a process that sleeps for longer than its
claims last, a server that is replaced by a newer one, the database that crashes. Ends with 1 where an acknowledged
commit was lost or folded twice, the chain or a cell is not what the commits say, or robots were not answered for 15 s.
"""

import argparse
import sys
import tempfile
from pathlib import Path

from tests.fixtures.server.postgres import programs_of
from tests.replicas.fault_run import SILENCE_MAX_S, fault_run


def main() -> int:
    """Print what came of it."""
    parser = argparse.ArgumentParser("python -m tests.replicas", description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--robots", type=int, default=4)
    parser.add_argument("--postgres", choices=["system", "wheel"], default="wheel")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        found = fault_run(
            Path(name), programs_of(given.postgres), seconds=given.seconds, robots=given.robots, seed=given.seed
        )
    for what, value in found.rows():
        sys.stdout.write(f"{what:<48}{value}\n")
    return int(not found.verdict.is_sound or bool(found.pushed.wrong) or found.pushed.silence_s > SILENCE_MAX_S)


if __name__ == "__main__":
    sys.exit(main())
