"""Fuzz targets one after another, or a few at a time, and say what was found.

    $ python -m tests.fuzz --seconds 600 --jobs 2       # `make soak`; every target
    $ python -m tests.fuzz cell commit --seconds 60

Inputs that reach more than the committed corpus did are kept in `build/fuzz` for the next time. Ends with 1, and leaves
the inputs in `tests/fuzz/findings`, where anything was found.
"""

import argparse
import sys
from importlib.util import find_spec

from tests.fuzz.soak import FINDINGS, SoakReport, soak
from tests.fuzz.targets import TARGETS


def main() -> int:
    """Fuzz and print one line per target."""
    parser = argparse.ArgumentParser("python -m tests.fuzz", description=__doc__)
    parser.add_argument("targets", nargs="*", metavar="TARGET", help=f"of {', '.join(TARGETS)}; default: all")
    parser.add_argument("--seconds", type=int, default=600, help="of each target")
    parser.add_argument("--jobs", type=int, default=2, help="targets at a time")
    given = parser.parse_args()
    if unknown := set(given.targets) - set(TARGETS):
        parser.error(f"there is no target {', '.join(sorted(unknown))}; there are {', '.join(TARGETS)}")
    if find_spec("atheris") is None:
        sys.stdout.write("atheris is not installed: it has wheels for Linux on x86-64 only; nothing was fuzzed\n")
        return 1
    sys.stdout.write(f"{'target':<16}{'inputs':>10}{'per s':>8}{'slowest':>9}{'memory':>9}  result\n")
    names = given.targets or list(TARGETS)
    reports = [_shown(report) for report in soak(names, seconds=given.seconds, jobs=given.jobs, findings=FINDINGS)]
    found = [report for report in reports if report.finding or report.failure]
    for report in found:
        sys.stdout.write(f"\n{report.target}: {report.failure}\n{report.how_to_repeat}\n")
    return min(1, len(found))


def _shown(report: SoakReport) -> SoakReport:
    sys.stdout.write(
        f"{report.target:<16}{report.inputs:>10}{report.inputs_per_s:>8}{report.slowest_s:>7} s{report.memory_mb:>6} MB"
        f"  {'FOUND' if report.finding else 'FAILED' if report.failure else 'nothing found'}\n"
    )
    sys.stdout.flush()
    return report


if __name__ == "__main__":
    sys.exit(main())
