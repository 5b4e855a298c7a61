"""Compare two calibrations of the same cameras: how far apart they put the same points, and whether that is expected.

    $ cairn calib compare rig-march.json rig-april.json --report compared.html
    lens of left, 2 m             0.041 px rms, 0.062 expected, score 0.51 (limit 2.31)
    lens of left, infinity        0.044 px rms, 0.063 expected, score 0.55 (limit 2.42)
    tof to left, 2 m              1.310 px rms, 0.240 expected, score 38.2 (limit 2.87)   differs
    rig-march.json and rig-april.json do not agree within their stated uncertainty: 1.3 px rms apart where 0.24 px is
    expected (tof to left, 2 m), most at pixel (1102, 840), by 2.9 px
    compared.html: the same as compared.json

Use it after a shock, a change of lens, or a year; for two solves, of other images or with other options; or for a
calibration of another program, in any format that `cairn calib convert` reads. Without a stated uncertainty (a
rig.json that `cairn calib solve` wrote has one, other formats have none) there are figures, and no verdict.

Lenses: each pixel of the first calibration sees a point; where does the second see it? The second camera is turned (at
a finite distance also moved) to fit the first, for what "straight ahead" means is each calibration's own: a shifted
principal point with a turned camera is the same camera. Pairs: a pixel of the first camera, carried to another one at
that distance, by both calibrations; nothing is fitted. Cameras belong together by name; single ones by themselves.

The score is the mean squared difference in units of what both covariances predict: about 1 if they are right, above
the limit once in a hundred comparisons.
"""

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from cairn_calib.exchange.rig_exchange import RIG, format_of_text, read_cameras, read_text, rig_of_cameras
from cairn_calib.report.report_files import write_file
from cairn_calib.rig.lens import Lens
from cairn_calib.rig.rig import Rig, Spectrum, rig_from_json
from cairn_calib.verify.comparison_report import comparison_json, comparison_page, verdict, what_of
from cairn_calib.verify.rig_comparison import compare_rigs
from cairn_map.errors import BadInputError

if TYPE_CHECKING:
    from argparse import _SubParsersAction


def add_parser(commands: "_SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add `compare` to `cairn calib`."""
    added = commands.add_parser(
        "compare",
        help="how far two calibrations are apart, and whether that is within their uncertainty",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    added.add_argument("files", nargs=2, type=Path, metavar="FILE", help="rig.json, or what cairn calib convert reads")
    added.add_argument("--camera", action="append", default=[], metavar="NAME", help="only this one; again: that too")
    added.add_argument("--at", default="2,inf", metavar="METRES,...", help="distances of the points (2,inf)")
    added.add_argument("--report", type=Path, metavar="REPORT.HTML", help="with maps; also as .json next to it")
    added.set_defaults(run=run)


def run(args: argparse.Namespace) -> None:
    """Compare, and report on standard output."""
    ranges_m = _ranges(args.at)
    names = _names(args.files)
    rigs = (_load(args.files[0]), _load(args.files[1]))
    cameras = _pairs(*rigs, args.camera)
    found = compare_rigs(*rigs, cameras, ranges_m)
    width = max(len(what_of(each)) for each in found)
    for each in found:
        expected = (
            "what is expected is not stated"
            if each.score is None or each.limit is None
            else f"{each.expected_px:.3f} expected, score {each.score:.2f} (limit {each.limit:.2f})"
        )
        mark = "   differs" if each.agrees is False else ""
        sys.stdout.write(f"{what_of(each):<{width}}  {each.rms_px:.3f} px rms, {expected}{mark}\n")
    sys.stdout.write(f"{verdict(names, found)}\n")
    if args.report is not None:
        figures = args.report.with_suffix(".json")
        if figures.resolve() in [path.resolve() for path in args.files]:
            raise BadInputError("bad_arguments", f"the figures go to {figures}: name the report otherwise")
        write_file(args.report, comparison_page(names, rigs, found).encode())
        write_file(figures, comparison_json(names, rigs, found))
        sys.stdout.write(f"{args.report}: the same as {figures.name}\n")


def _names(files: list[Path]) -> tuple[str, str]:
    """Names of both files for people: with their folders where they are the same."""
    one, other = files
    return (one.name, other.name) if one.name != other.name else (str(one), str(other))


def _load(path: Path) -> Rig:
    text = read_text(path)
    if format_of_text(path, text) == RIG:
        return rig_from_json(text.encode())
    cameras = read_cameras(path, text).cameras
    # No format of others says a spectrum, and none is needed here.
    return rig_of_cameras(cameras, name="other", spectra={each.name: Spectrum.COLOUR for each in cameras})


def _pairs(a: Rig, b: Rig, wanted: list[str]) -> list[tuple[str, str]]:
    """Names of each camera in both rigs."""
    in_a, in_b = ([name for name, each in rig.cameras.items() if isinstance(each.camera, Lens)] for rig in (a, b))
    if wanted:
        in_a = [name for name in in_a if name in wanted]
    common = [name for name in in_a if name in in_b]
    if unknown := [name for name in wanted if name not in a.cameras]:
        raise BadInputError("unknown_camera", f"there is no camera {unknown[0]!r}; there are {', '.join(a.cameras)}")
    if common:
        return [(name, name) for name in common]
    if len(in_a) == len(in_b) == 1:
        return [(in_a[0], in_b[0])]
    raise BadInputError(
        "unknown_camera",
        f"no camera has one name in both: {', '.join(in_a) or 'no lens'}, and {', '.join(in_b) or 'no lens'}; write "
        "the one to compare to a file of its own (cairn calib convert --camera NAME)",
    )


def _ranges(text: str) -> list[float]:
    try:
        ranges_m = [float(part) for part in text.split(",") if part]
    except ValueError:
        ranges_m = []
    if not ranges_m or not all(0.01 <= each <= 1e6 or np.isinf(each) for each in ranges_m):
        raise BadInputError(
            "bad_arguments", f"--at is metres, 0.01 to 1000000 or inf, such as 2,inf; got {text[:40]!r}"
        )
    return ranges_m
