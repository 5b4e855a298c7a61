"""Many seeds, or one step by step.

    $ python -m tests.sync_sim --seeds 100000 --jobs 2     # `make soak`
    $ python -m tests.sync_sim --seed 4711

Ends with 1 where a seed went wrong, and names it: a failing seed fails again.
"""

import argparse
import logging
import multiprocessing
import os
import sys
import time
from concurrent.futures import ProcessPoolExecutor

from tests.sync_sim.history import failures, run_seed

CHUNK = 50


def main() -> int:
    """Run, and print what came of it."""
    parser = argparse.ArgumentParser("python -m tests.sync_sim", description=__doc__)
    parser.add_argument("--seeds", type=int, default=100_000, help="how many (100 000)")
    parser.add_argument("--first", type=int, default=0, help="the first of them (0)")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="seeds at a time (all processors)")
    parser.add_argument("--seed", type=int, help="only this one, telling what happens")
    parser.add_argument("--until-wrong", action="store_true", help="stop soon after a seed went wrong")
    given = parser.parse_args()
    if given.seed is not None:
        logging.basicConfig(level=logging.INFO, format="          %(message)s", stream=sys.stdout)
        run_seed(given.seed, log=lambda text: print(text, flush=True))  # noqa: T201
        return 0
    return _many(range(given.first, given.first + given.seeds), given.jobs, until_wrong=given.until_wrong)


def _many(seeds: range, jobs: int, *, until_wrong: bool) -> int:
    start_s, done, wrong = time.monotonic(), 0, 0
    chunks = [seeds[n : n + CHUNK] for n in range(0, len(seeds), CHUNK)]
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(jobs, context, initializer=logging.disable, initargs=(logging.CRITICAL,)) as pool:
        for chunk, found in zip(chunks, pool.map(failures, chunks), strict=True):
            done += len(chunk)
            wrong += len(found)
            for seed, why in found:
                sys.stdout.write(f"\rseed {seed} went wrong: {why}\n")
            rate = done / (time.monotonic() - start_s)
            left_s = (len(seeds) - done) / rate
            if wrong and until_wrong:
                pool.shutdown(cancel_futures=True)
                break
            sys.stderr.write(f"\r{done} of {len(seeds)} seeds, {rate:.0f} a second, {left_s / 60:.0f} min left ")
    sys.stderr.write("\n")
    sys.stdout.write(f"{done} seeds, {wrong} went wrong\n")
    if wrong:
        sys.stdout.write("see what happens in one: python -m tests.sync_sim --seed N\n")
    return min(1, wrong)


if __name__ == "__main__":
    sys.exit(main())
