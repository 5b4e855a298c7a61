"""Report an existing calibration: from rig.json and the corners that it was solved from.

    $ cairn calib report rig.json corners/tof corners/left --output report.html
    rig.json comes from these corners: the same to 0.0001 sigma
    usable: where a pixel of tof appears in left is known to 0.24 px (sigma, median)
    report.html: 0 warnings and 2 notes; the same as report.json

`cairn calib solve --report` writes the same page while it solves. This command makes it again, with later additions to
rig.json (the radiometry of `cairn calib thermal fit`), and changes nothing: the corners are solved once more with the
options that rig.json states, and it is an error if another rig comes out, or if a document is not the one that went in.
Options that rig.json does not state go into --solved-with: `--solved-with "--flat --range ranges --prior old.json"`.

The page is one file, to be read without a network and to be printed: estimates and how certain they are, warnings, the
image to shoot next, residuals, coverage, certainty at 1, 2 and 5 m, radiometry, and every image with its corners.
"""

import argparse
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from cairn_calib.cli.solve_options import add_solve_options, read_by_options
from cairn_calib.diagnosis.examination import examine
from cairn_calib.report.report_files import refuse_overwriting, write_report
from cairn_calib.report.report_images import report_images
from cairn_calib.rig.calibration import PIXEL_NAMES, POSE_UNITS
from cairn_calib.rig.lens import Lens
from cairn_calib.rig.range_bias import RangeBias
from cairn_calib.rig.raster import Raster
from cairn_calib.rig.rig import Rig, load_rig
from cairn_calib.solve.board_views import BoardViews
from cairn_calib.solve.solution import Solution
from cairn_calib.solve.solve import solve_rig
from cairn_calib.solve.solved_rig import solved_rig
from cairn_map.errors import BadInputError

if TYPE_CHECKING:
    from argparse import _SubParsersAction

SAME_SIGMAS = 0.05
"""Two solves of the same corners differ by rounding and where an outlier's fate hangs on it."""


def add_parser(commands: "_SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add `report` to `cairn calib`."""
    added = commands.add_parser(
        "report",
        help="the report of a calibration, again, with what came to rig.json since",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    added.add_argument("rig", type=Path, metavar="RIG", help="rig.json that cairn calib solve wrote")
    added.add_argument("folders", nargs="+", type=Path, metavar="DIR", help="of corner documents, as given to solve")
    added.add_argument("--output", type=Path, required=True, metavar="REPORT.HTML", help="also as .json next to it")
    added.add_argument("--solved-with", default="", metavar="OPTIONS", help="the other options of solve, in quotes")
    added.set_defaults(run=run)


def run(args: argparse.Namespace) -> None:
    """Solve again, compare, and write the report."""
    refuse_overwriting(args.output, args.rig)
    rig = load_rig(args.rig)
    views, plan = read_by_options(solve_arguments(rig, args.folders, shlex.split(args.solved_with), args.rig))
    again = solve_rig(views, plan)
    _refuse_other_inputs(rig, again.views, args.rig)
    off = sigmas_apart(rig, again)
    if not off < SAME_SIGMAS:
        raise BadInputError(
            "not_that_rig",
            f"these corners give another rig than {args.rig}, {off:.3g} sigma off: tell what else it was solved with, "
            'such as --solved-with "--flat --range DIR", or solve again if it was changed by hand',
        )
    sys.stdout.write(f"{args.rig} comes from these corners: the same to {max(off, 1e-4):.1g} sigma\n")
    folders = dict(zip(again.plan.cameras, args.folders, strict=True))
    seen = examine(again, rig)
    sys.stdout.write(f"{seen.verdict}\n{write_report(args.output, seen, report_images(folders), rig_path=args.rig)}")


def solve_arguments(rig: Rig, folders: list[Path], more: list[str], path: Path) -> argparse.Namespace:
    """The arguments of `cairn calib solve` that a rig was made with, as far as it says."""
    calibration = rig.calibration
    if calibration is None or calibration.covariance is None:
        raise BadInputError(
            "not_calibrated", f"{path} does not say how it was calibrated: cairn calib solve makes such"
        )
    names = [folder.resolve().name for folder in folders]
    if sorted(names) != sorted(rig.cameras):
        raise BadInputError(
            "unknown_camera",
            f"the folders must be of {path}'s cameras {', '.join(rig.cameras)}, got {', '.join(names)}",
        )
    arguments = ["--spectrum", ",".join(f"{name}={rig[name].spectrum}" for name in names), "--gauge", calibration.gauge]
    intrinsic = {*PIXEL_NAMES, *POSE_UNITS}
    for name in names:
        free = [each.name for each in calibration.covariance.parameters if each.camera == name]
        arguments += ["--distortion", f"{name}={','.join(each for each in free if each not in intrinsic)}"]
        arguments += _holds(name, rig[name].camera, free)
    fisheyes = [name for name in names if getattr(rig[name].camera, "model", "") == "kb4"]
    arguments += ["--fisheye", ",".join(fisheyes), "--name", rig.name, "--output", str(path), *more]
    parser = argparse.ArgumentParser("cairn calib report --solved-with")
    add_solve_options(parser)
    return parser.parse_args([*map(str, folders), *arguments])


def _holds(name: str, lens: Raster, free: Sequence[str]) -> list[str]:
    """Options that hold the numbers of a lens that were held; coefficients of 0 are without an option."""
    if not isinstance(lens, Lens):
        return []
    held = {
        each: value
        for each, value in zip(lens.intrinsic_names, lens.intrinsics.tolist(), strict=True)
        if each not in free and (value or each in PIXEL_NAMES)
    }
    return [part for each, value in held.items() for part in ("--hold", f"{name}.{each}={value!r}")]


def sigmas_apart(rig: Rig, again: Solution) -> float:
    """The largest difference between a rig's cameras and a solution's, in standard deviations of the solution.

    With their range bias: else the page of a rig that was solved with ranges would leave them out and not say so.
    """
    other, sigmas = solved_rig(again, made_s=0.0), again.sigmas()
    apart = [0.0]
    for name, mounted in rig.cameras.items():
        lens, theirs = mounted.camera, other[name].camera
        if not isinstance(lens, Lens) or not isinstance(theirs, Lens) or lens.intrinsic_names != theirs.intrinsic_names:
            return np.inf
        for each, one, two in zip(lens.intrinsic_names, lens.intrinsics, theirs.intrinsics, strict=True):
            apart.append(_sigmas_between(one - two, sigmas.get((name, each))))
        moved = mounted.transform[:3, 3] - other[name].transform[:3, 3]
        turned = (mounted.transform[:3, :3] @ other[name].transform[:3, :3].T - np.eye(3))[[2, 0, 1], [1, 2, 0]]
        for each, off in zip(POSE_UNITS, (*turned, *moved), strict=True):
            apart.append(_sigmas_between(off, sigmas.get((name, each))))
        apart.append(_bias_sigmas_apart(mounted.range_bias, other[name].range_bias))
    return float(np.max(apart))


def _bias_sigmas_apart(one: RangeBias | None, two: RangeBias | None) -> float:
    """Largest difference between two range biases, in standard deviations of the second; infinite for other shapes."""
    if one is None or two is None:
        return 0.0 if one is two else np.inf
    if one.names != two.names or (one.pixel_offsets is None) != (two.pixel_offsets is None):
        return np.inf
    sigmas = np.sqrt(np.diag(two.covariance)).tolist()
    return max(map(_sigmas_between, (one.values - two.values).tolist(), sigmas))


def _sigmas_between(difference: float, sigma: float | None) -> float:
    """A difference in standard deviations; a parameter that is held must be the same."""
    return abs(difference) / sigma if sigma else (0.0 if abs(difference) < 1e-9 else np.inf)


def _refuse_other_inputs(rig: Rig, views: BoardViews, path: Path) -> None:
    known = {each.name: each.sha256 for each in rig.calibration.inputs} if rig.calibration else {}
    if not known:
        return
    found = {each.name: each.sha256 for each in views.inputs[: len(known)]}
    strange = sorted(name for name in known.keys() | found.keys() if known.get(name) != found.get(name))
    if strange:
        raise BadInputError(
            "not_those_corners",
            f"{path} was not solved from these corners: {strange[0]} is another, or missing"
            f"{f', and {len(strange) - 1} more' if len(strange) > 1 else ''}; solve them to get their rig",
        )
