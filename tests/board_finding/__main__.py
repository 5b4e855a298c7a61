"""How many boards are found, simulated and real ones, and how many grids in images without a board.

    $ python -m tests.board_finding --boards 1000 --discs 300 --real 500 --empty 10000        # part of `make soak`
    tof      cells 4 to 6: found 99.8% of 600
    ...
    real boards, near: found 500 of 500, OpenCV's two detectors together 470
    real boards, changed: found 100.0% of 500; votes for the polarity: 460 right, 0 wrong, 40 open
    images without a board: 0 false grids of 10000

Boards vary in distance, tilt (up to 45 degrees), blur, noise (contrast 10 times it or more) and polarity. In
time-of-flight images cells are 4 px or more. A board counts as found if each of its points lies where it is, in order.
`--seed` draws others. Exit code 1 if fewer than 99 % are found (98 % through lenses of up to 150 degrees), any grid is
false, any image votes wrongly, or more than 1 % of the discs' centroids are beyond 3 of their stated sigmas.
"""

import argparse
import sys
from dataclasses import replace
from itertools import pairwise

import numpy as np
from tests.board_finding.disc_trials import disc_trial, false_grids
from tests.board_finding.empty_images import KINDS, empty_image
from tests.board_finding.real_boards import changed, found_as_recorded, found_by_opencv, near, recorded, voted
from tests.board_finding.trials import SPECTRA, Trial, found_rightly, trial
from tests.fixtures.calib.board_images import BOARD

from cairn_calib.board.corner_detection import find_chessboard

FOUND_MIN = 0.99
LENSES_MIN = 0.98
"""Least share found of boards through lenses of up to 150 degrees, leaning by up to 50, next to clutter."""
EMPTY = np.zeros((0, 0), np.uint8)
TABLE = (("cells", "cell_px", (4, 6, 10, 40, 400)), ("tilt", "tilt_deg", (0, 15, 30, 45.1)))


def main() -> int:
    """Draw, find, print."""
    parser = argparse.ArgumentParser(
        "python -m tests.board_finding", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--boards", type=int, default=1000, help="chessboards of each spectrum (1000)")
    parser.add_argument("--discs", type=int, default=300, help="grids of discs of each spectrum (300)")
    parser.add_argument("--real", type=int, default=500, help="changed images of CAIRN_TEST_DATA's boards (500)")
    parser.add_argument("--empty", type=int, default=10000, help="images without a board (10000)")
    parser.add_argument("--seed", type=int, default=0, help="of the first of each (0)")
    args = parser.parse_args()
    seed = args.seed
    good = [_boards(name, "chessboard", range(seed, seed + args.boards)) for name in SPECTRA]
    good += [_boards(name, "discs", range(seed, seed + args.discs)) for name in SPECTRA]
    good += [_lenses(range(seed, seed + args.discs))]
    good += [_real_boards(range(seed, seed + args.real)), _false_grids(range(seed, seed + args.empty))]
    return 0 if all(good) else 1


def _boards(name: str, target: str, seeds: range) -> bool:
    trials: list[Trial] = []
    found: list[bool] = []
    for seed in seeds:
        each = trial(name, seed, target=target)
        found.append(found_rightly(each))
        trials.append(replace(each, image=EMPTY))
        if not found[-1]:
            _say(f"    not {target}, seed {seed}: {each}")
    for label, field, bounds in TABLE:
        for low, high in pairwise(bounds):
            those = [right for each, right in zip(trials, found, strict=True) if low <= getattr(each, field) < high]
            if those:
                _say(f"{name:8} {target} {label} {low:g} to {high:g}: found {_share(those)} of {len(those)}")
    for way in ("normal", "reversed"):
        those = [right for each, right in zip(trials, found, strict=True) if each.polarity == way]
        if those:
            _say(f"{name:8} {target} {way}: found {_share(those)} of {len(those)}")
    if found:
        _say(f"{name:8} {target} all: found {_share(found)} of {len(found)}, at least {FOUND_MIN:.0%}")
    return sum(found) >= FOUND_MIN * len(found)


def _lenses(seeds: range) -> bool:
    """Grids of discs through lenses of 40 to 150 degrees."""
    trials = [disc_trial(seed) for seed in seeds]
    for each in trials:
        if not each.is_found:
            _say(f"    discs, {each}")
    found = [each.is_found for each in trials]
    sigmas = np.concatenate([each.sigmas for each in trials]) if trials else np.zeros(1)
    far = float((sigmas > 3).mean())
    if found:
        _say(f"discs, lenses of 40 to 150 degrees: found {_share(found)} of {len(found)}, {far:.2%} beyond 3 sigma")
    return sum(found) >= LENSES_MIN * len(found) and far < 0.01 and not any(each.is_wrong for each in trials)


def _real_boards(seeds: range) -> bool:
    if not recorded():
        _say("real boards: none, CAIRN_TEST_DATA is not set")
        return True
    found, votes = [], {"right": 0, "wrong": 0, "open": 0}
    for seed in seeds:
        change = changed(seed)
        found.append(found_as_recorded(change))
        if not found[-1]:
            _say(f"    not real, seed {seed}: {change.text}")
        vote = voted(change)
        votes["open" if vote is None else "right" if vote == change.polarity else "wrong"] += 1
    told = ", ".join(f"{count} {way}" for way, count in votes.items())
    if found:
        _say(f"real boards, changed: found {_share(found)} of {len(found)}; votes for the polarity: {told}")
    close = [near(seed) for seed in seeds]
    ours, theirs = (sum(map(find, close)) for find in (found_as_recorded, found_by_opencv))
    _say(f"real boards, near: found {ours} of {len(close)}, OpenCV's two detectors together {theirs}")
    return sum(found) >= FOUND_MIN * len(found) and not votes["wrong"] and ours >= theirs


def _false_grids(seeds: range) -> bool:
    false = 0
    for seed in seeds:
        kind, image = empty_image(seed)
        detection = find_chessboard(image, BOARD)
        if detection.corners is not None:
            false += 1
            _say(f"    false grid, seed {seed} ({kind}): {detection.attempts[-1]}")
        if false_grids(image, seed):
            false += 1
            _say(f"    false grid of discs, seed {seed} ({kind})")
    _say(f"images without a board, of {len(set(KINDS))} kinds: {false} false grids of {len(seeds)}")
    return not false


def _share(found: list[bool]) -> str:
    return f"{sum(found) / len(found):.1%}"


def _say(text: str) -> None:
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
