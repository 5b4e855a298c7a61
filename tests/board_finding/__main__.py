"""How many simulated boards are found, and how many grids in images without a board.

    $ python -m tests.board_finding --boards 1000 --empty 10000        # part of `make soak`
    tof      cells 4 to 6: found 99.8% of 600
    ...
    images without a board (85 real ones among their sources): 0 false grids of 10000

Boards vary in distance, tilt (up to 45 degrees), blur, noise (contrast 10 times it or more) and polarity. In
time-of-flight images cells are 4 px or more. A board counts as found if each of its corners lies where it is, in order.
Exit code 1 if fewer than 99 % are found, or any grid is false.
"""

import argparse
import sys
from itertools import pairwise

from tests.board_finding.empty_images import KINDS, empty_image, real_images
from tests.board_finding.trials import SPECTRA, Trial, found_rightly, trial
from tests.cairn_calib.board_images import BOARD

from cairn_calib.corner_detection import find_chessboard

FOUND_MIN = 0.99
TABLE = (("cells", "cell_px", (4, 6, 10, 40, 400)), ("tilt", "tilt_deg", (0, 15, 30, 45.1)))


def main() -> int:
    """Draw, find, print."""
    parser = argparse.ArgumentParser(
        "python -m tests.board_finding", description="How many boards are found, and how many false."
    )
    parser.add_argument("--boards", type=int, default=1000, help="of each spectrum")
    parser.add_argument("--empty", type=int, default=10000)
    args = parser.parse_args()
    good = [_boards(name, args.boards) for name in SPECTRA]
    false = _false_grids(args.empty)
    return 0 if all(good) and not false else 1


def _boards(name: str, count: int) -> bool:
    trials = [trial(name, seed) for seed in range(count)]
    found = [found_rightly(each) for each in trials]
    for label, field, bounds in TABLE:
        for low, high in pairwise(bounds):
            those = [right for each, right in zip(trials, found, strict=True) if low <= getattr(each, field) < high]
            if those:
                _say(f"{name:8} {label} {low:g} to {high:g}: found {sum(those) / len(those):.1%} of {len(those)}")
    for way in ("normal", "reversed"):
        those = [right for each, right in zip(trials, found, strict=True) if each.polarity == way]
        _say(f"{name:8} {way}: found {sum(those) / max(len(those), 1):.1%} of {len(those)}")
    share = sum(found) / count
    _say(f"{name:8} all: found {share:.2%} of {count}, at least {FOUND_MIN:.0%}")
    for each in [each for each, right in zip(trials, found, strict=True) if not right][:10]:
        _say(f"    not {_told(each)}")
    return share >= FOUND_MIN


def _told(each: Trial) -> str:
    return (
        f"seed {each.seed}: cells {each.cell_px:.1f} px, tilt {each.tilt_deg:.0f} deg, blur {each.blur_px:.2f} px, "
        f"contrast {each.contrast:.0f} x noise, {each.polarity}"
    )


def _false_grids(count: int) -> int:
    real = real_images()
    false = dict.fromkeys(KINDS, 0)
    for seed in range(count):
        kind, image = empty_image(seed, real)
        detection = find_chessboard(image, BOARD)
        if detection.corners is not None:
            false[kind] += 1
            _say(f"    false grid, seed {seed} ({kind}): {detection.attempts[-1]}")
    total = sum(false.values())
    _say(f"images without a board ({len(real)} real ones among their sources): {total} false grids of {count}")
    return total


def _say(text: str) -> None:
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
