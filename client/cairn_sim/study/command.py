"""Find out which images of a board calibrate best, in the simulator, where the truth is known.

    $ cairn calib study --output study
    sigma, px, centroids by method paper; in brackets the paper's, of other images
                colour_left       colour_right       thermal_left      thermal_right
    c9         2.19   (3.6)       2.18   (4.0)       1.08   (1.3)       1.06   (1.2)
    ...
    best: c8 (8 tilted by 30 degrees, middle and corners, near and far)
      paper colour_left   sigma 2.12 px, at most 2.8: met; rms 2.11 px, expected 2.07 (+2%): met
      grey  colour_left   sigma 0.99 px, at most 1.5: met; rms 0.99 px, expected 0.99 (+1%): met
      ...

Ten configurations c1 to c10, of 2 to 9 images: how many, head-on or tilted, middle or corners, one distance or several.
Each is photographed by the simulated head, its corners are found, the rig is solved from them alone, and verified with
circle targets along a drive of 87 images (as `cairn calib verify`). Out comes Table 2 of Kocmanova et al., ours next to
theirs. Configurations that leave a number undetermined are refused, in words.

DIR gets study.html, study.json, and rig-c1.json ... to look at with `cairn calib`. Takes some minutes; the same
seed gives the same numbers.
"""

import argparse
from pathlib import Path

from cairn_client.cli.arguments import parser, say
from cairn_map.errors import BadInputError
from cairn_map.progress import with_progress
from cairn_sim.robots.heads import full_head
from cairn_sim.study.configurations import CONFIGURATIONS
from cairn_sim.study.report import Study, study_json, study_page, study_text
from cairn_sim.study.run import driven, outcome_of, photographed, places_of

PAPER_IMAGES = 87


def main(argv: list[str]) -> int:
    """Run the subcommand."""
    options = parser("cairn calib study", __doc__)
    options.add_argument("--only", default=",".join(CONFIGURATIONS), metavar="c1,c2,...", help="(all ten)")
    options.add_argument(
        "--images", type=_count, default=PAPER_IMAGES, metavar="N", help=f"of targets ({PAPER_IMAGES})"
    )
    options.add_argument("--seed", type=int, default=0, help="of noise and places of targets (0)")
    options.add_argument("--scale", type=float, default=1.0, help="of colour and thermal images, above 0 to 1 (1)")
    options.add_argument("--output", type=Path, default=Path("study"), metavar="DIR", help="(study)")
    args = options.parse_args(argv)
    if args.seed < 0:
        raise BadInputError("bad_arguments", f"--seed counts from 0, got {args.seed}")
    names = args.only.split(",")
    head, places = full_head(scale=args.scale), places_of(names)
    corners = dict(with_progress(photographed(head, places, seed=args.seed), "board", total=len(places)))
    drive = list(with_progress(driven(head, args.images, seed=args.seed), "targets", total=args.images))
    args.output.mkdir(parents=True, exist_ok=True)
    outcomes = []
    for name in with_progress(names, "solving", total=len(names)):
        outcome = outcome_of(name, corners, drive, head)
        outcomes.append(outcome)
        if outcome.rig is not None:
            (args.output / f"rig-{name}.json").write_bytes(outcome.rig.to_json())
    study = Study(outcomes=outcomes, images=args.images, seed=args.seed, scale=args.scale)
    (args.output / "study.json").write_text(study_json(study), encoding="utf-8")
    (args.output / "study.html").write_text(study_page(study), encoding="utf-8")
    say(study_text(study))
    say(f"look at {args.output / 'study.html'}")
    return 0


def _count(text: str) -> int:
    if not text.isdecimal() or not 1 <= int(text) <= 10_000:
        raise argparse.ArgumentTypeError(f"images are 1 to 10000, got {text!r}")
    return int(text)
