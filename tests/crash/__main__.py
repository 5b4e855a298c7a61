"""Crash stores and servers, and say what was lost.

    $ python -m tests.crash --trials 1000 --kills 200     # `make soak`
    $ python -m tests.crash --trials 100 --kills 0 --level NORMAL

One line for each kind of crash; ends with 1 where an acknowledged commit was lost, or a store was left damaged.
"""

import argparse
import itertools
import logging
import multiprocessing
import sys
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor
from functools import partial

from tests.crash.kills import Killed, killed_servers
from tests.crash.lives import Trial, trial
from tests.crash.verdict import Verdict

KILLS_OF_ONE_STORE = 10


def main() -> int:
    """Crash, and print what came of it."""
    parser = argparse.ArgumentParser("python -m tests.crash", description=__doc__)
    parser.add_argument("--trials", type=int, default=1000, help="power cuts are tried on so many stores")
    parser.add_argument("--kills", type=int, default=200, help="of servers")
    parser.add_argument("--level", default="FULL", help="SQLite's `synchronous` in the power cuts")
    parser.add_argument("--seed", type=int, default=0, help="of the first trial")
    parser.add_argument("--jobs", type=int, default=2, help="trials at a time")
    given = parser.parse_args()
    sys.stdout.write(f"{'crash':<20}{'crashes':>8}{'commits':>9}{'folds':>7}{'lost':>6}{'corrupt':>9}{'wrong':>7}\n")
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(given.jobs, context, initializer=logging.disable, initargs=(logging.ERROR,)) as pool:
        seeds = range(given.seed, given.seed + given.trials)
        trials = list(pool.map(partial(trial, level=given.level), seeds, chunksize=10))
        _show_trials(trials, given.level)
        groups = range(given.seed, given.seed + -(-given.kills // KILLS_OF_ONE_STORE))
        killed = list(pool.map(partial(killed_servers, kills=KILLS_OF_ONE_STORE), groups))
        _show_killed(killed)
    bad = [(f"trial {done.seed}", done.verdict) for done in trials if not done.verdict.is_sound]
    bad += [
        (f"servers, kill {n}", verdict)
        for done in killed
        for n, verdict in enumerate(done.verdicts)
        if not verdict.is_sound
    ]
    for what, verdict in itertools.islice(bad, 10):
        sys.stdout.write(f"{what}: {verdict}\n")
    return min(1, len(bad))


def _show_trials(trials: list[Trial], level: str) -> None:
    if trials:
        cuts, commits, folds = (sum(n) for n in zip(*((t.lives, len(t.acked), t.folds) for t in trials), strict=True))
        _show(f"power cut, {level}", cuts, commits, f"{folds}", [done.verdict for done in trials])


def _show_killed(killed: list[Killed]) -> None:
    if killed:
        verdicts = [verdict for done in killed for verdict in done.verdicts]
        kills, commits = (sum(n) for n in zip(*((done.kills, len(done.acked)) for done in killed), strict=True))
        _show("kill -9", kills, commits, "", verdicts)


def _show(what: str, crashes: int, commits: int, folds: str, verdicts: Iterable[Verdict]) -> None:
    found = list(verdicts)
    lost = sum(len(verdict.lost) for verdict in found)
    corrupt, wrong = sum(bool(verdict.corrupt) for verdict in found), sum(bool(verdict.wrong) for verdict in found)
    sys.stdout.write(f"{what:<20}{crashes:>8}{commits:>9}{folds:>7}{lost:>6}{corrupt:>9}{wrong:>7}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
