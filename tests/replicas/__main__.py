"""Faults of what shares one database, while robots push through all of it; says what was lost.

    $ python -m tests.replicas --seconds 60          # `make soak`
    $ python -m tests.replicas lost-tail --seeds 200
    $ python -m tests.replicas standby --seconds 60  # and so objects, link, disk, log-disk, restore
    $ python -m tests.replicas races --turns 10000

kills: one fault every few seconds: `kill -9` of a server or of a process that folds, a process that sleeps for longer
than its claims last, a server that is replaced by a newer one, the database that crashes. lost-tail: an older copy of
the database is put in its place, once for each seed. standby: one that is 5 s behind becomes the primary. link: one
server is cut off from the database again and again. disk: the disk of the database's tables is full again and again;
log-disk: that of its write-ahead log, with which it ends. objects: kills, with an object store behind the database to
which everything moves at once, and which goes away. restore: to a point in time, by the commands of
docs/scale.md, with an object store. races: a retract against forgetting, and two commits of one id, at two servers at
once.

Ends with 1 where an acknowledged commit was lost or folded twice, the chain or a cell is not what the commits say, a
server sent something of a history that was lost, or robots were not answered for 15 s.
"""

import argparse
import sys
import tempfile
from pathlib import Path

from tests.fixtures.server.object_store import object_server_in
from tests.fixtures.server.postgres import programs_of
from tests.replicas.cold_run import cold_run
from tests.replicas.cut_link import cut_link_run
from tests.replicas.fault_run import FaultRun, fault_run
from tests.replicas.full_disk import full_disk_run
from tests.replicas.lost_tail import LostTails, lost_tail_run
from tests.replicas.point_in_time import Restore, restore_run
from tests.replicas.races import Races, races_run
from tests.replicas.standby import Failover, failover_run


def main() -> int:
    """Print what came of it."""
    parser = argparse.ArgumentParser("python -m tests.replicas", description=__doc__)
    parser.add_argument(
        "run",
        nargs="?",
        choices=["kills", "objects", "lost-tail", "standby", "link", "disk", "log-disk", "restore", "races"],
        default="kills",
    )
    parser.add_argument("--seconds", type=float, default=60.0, help="of all but lost-tail (60)")
    parser.add_argument("--robots", type=int, default=4, help="of kills, objects, link and disk (4)")
    parser.add_argument("--seeds", type=int, default=20, help="of lost-tail (20)")
    parser.add_argument("--turns", type=int, default=10_000, help="of each of the races (10000)")
    parser.add_argument("--postgres", choices=["system", "wheel"], default="wheel")
    parser.add_argument("--seed", type=int, default=0, help="the first one of lost-tail (0)")
    given = parser.parse_args()
    programs = programs_of(given.postgres)
    found: FaultRun | LostTails | Failover | Restore | Races
    with tempfile.TemporaryDirectory() as name:
        if given.run == "lost-tail":
            seeds = range(given.seed, given.seed + given.seeds)
            found = lost_tail_run(Path(name), programs, seeds=seeds)
        elif given.run == "standby":
            found = failover_run(Path(name), programs, seconds=given.seconds, behind_s=5.0, seed=given.seed)
        elif given.run == "restore":
            with object_server_in() as objects:
                found = restore_run(Path(name), programs, seconds=given.seconds / 4, seed=given.seed, objects=objects)
        elif given.run == "races":
            found = races_run(programs, turns=given.turns, seed=given.seed)
        elif given.run == "objects":
            found = cold_run(Path(name), programs, seconds=given.seconds, robots=given.robots, seed=given.seed)
        elif given.run == "link":
            found = cut_link_run(Path(name), programs, seconds=given.seconds, robots=given.robots, seed=given.seed)
        elif given.run in ("disk", "log-disk"):
            what = "tables" if given.run == "disk" else "log"
            options = {"seconds": given.seconds, "robots": given.robots, "seed": given.seed}
            found = full_disk_run(Path(name), programs, what=what, **options)
        else:
            found = fault_run(Path(name), programs, seconds=given.seconds, robots=given.robots, seed=given.seed)
    for what, value in found.rows():
        sys.stdout.write(f"{what:<52}{value}\n")
    is_timely = isinstance(found, Restore | Races) or found.is_timely
    return int(not (found.is_sound and is_timely))


if __name__ == "__main__":
    sys.exit(main())
