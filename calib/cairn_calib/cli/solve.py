"""Solve a rig of cameras from the corners that `cairn calib corners` found: rig.json with its uncertainty.

    $ cairn calib corners tof/*.png   --board 7x6 --square 0.1 --output corners/tof
    $ cairn calib corners left/*.png  --board 7x6 --square 0.1 --output corners/left
    $ cairn calib solve corners/tof corners/left --spectrum tof=range,left=colour --output rig.json --report report.html
    warning: tof: no corner lies near the image's corners, ... [tof_edge: 0.59 of the half diagonal, threshold 0.8 ...]
    next: the board's middle at pixel (29, 72) of tof, 1.55 m away, its right edge turned away by 35 degrees
    tof   20 images  840 points  8 outliers  noise 0.106 px  rms 0.105 px
    left  20 images  830 points  0 outliers  noise 0.154 px  rms 0.152 px
    rig.json: tof, left
    report.html: 1 warnings; the same as report.json

A camera's name is its folder's. Images of one place of the board have the same last number in their names
(tof03.png, left03.png). The first range camera is the rig's frame, else the first camera (--gauge).

First each camera is solved alone, then all of them with all places of the board. Corners count by their covariance
and by each camera's own noise, which is estimated; what is off by more than 4 sigma is left out and counted. The
board may be bent (--flat: it is not), its pitch wrong by 0.02 % (--pitch-sigma). Free coefficients of every lens are
k1,k2,p1,p2,k3, with p1 and p2 assumed to be 0 +- 0.002 and k3 0 +- 0.1; --distortion says otherwise, --fisheye names
cameras with Kannala and Brandt's model.

With --range DIR the range camera's images of the same boards (16 bit, radial, --range-units-per-m) show what it adds
to its ranges, which rig.json states and mapping takes off: an offset, a scale, more at the image's corners, and each
pixel's own part where pixels differ. With --amplitude DIR (16 bit, same names) also how that depends on the amplitude,
with --modulation-mhz F its circular error: each only if amplitudes and ranges of the boards differ enough; else a
warning says so.

What the images cannot tell is warned about, with the threshold and what was measured: tilt, distances, the image's
edge, numbers that come from assumptions, halves of the images that contradict each other, single frames that much hangs
on; and which image would help most. Images that leave a camera open (one view, parallel boards, cameras that never saw
a board together) are refused. The report has it all, with residuals, coverage, and how certain each pixel is at 1, 2
and 5 m.
"""

import argparse
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from cairn_calib.cli.progress import while_working
from cairn_calib.diagnosis.examination import Examination, examined
from cairn_calib.report.range_report import told_ranges
from cairn_calib.report.report_images import ReportImage, report_images
from cairn_calib.report.solve_json import examination_json
from cairn_calib.report.solve_report import report_page
from cairn_calib.rig.calibration import Statistics
from cairn_calib.rig.rig import Spectrum
from cairn_calib.solve.board_views import read_board_views
from cairn_calib.solve.range_images import with_ranges
from cairn_calib.solve.solve import Solution, solve_rig
from cairn_calib.solve.solve_plan import PITCH_SIGMA, CameraPlan, SolvePlan, usual_plan
from cairn_calib.solve.solved_rig import solved_rig, statistics_of
from cairn_map.errors import BadInputError

if TYPE_CHECKING:
    from argparse import _SubParsersAction


def add_parser(commands: "_SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add `solve` to `cairn calib`."""
    added = commands.add_parser(
        "solve",
        help="cameras and their places from corners: rig.json with its uncertainty",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    added.add_argument("folders", nargs="+", type=Path, metavar="DIR", help="of corner documents, one for each camera")
    added.add_argument(
        "--spectrum", required=True, metavar="[NAME=]SPECTRUM,...", help="range, colour or thermal, of all or by camera"
    )
    added.add_argument("--output", type=Path, required=True, metavar="RIG.JSON")
    added.add_argument("--report", type=Path, metavar="REPORT.HTML", help="for people; beside it the same as .json")
    added.add_argument("--gauge", metavar="NAME", help="the camera whose frame is the rig's")
    added.add_argument("--name", default="rig", help="of the rig (rig)")
    added.add_argument(
        "--distortion", action="append", default=[], metavar="NAME=k1,k2,...", help="free coefficients; NAME=: none"
    )
    added.add_argument("--fisheye", default="", metavar="NAME,...", help="cameras with the KB4 model")
    added.add_argument("--flat", action="store_true", help="the board is not bent at all")
    added.add_argument(
        "--pitch-sigma",
        type=float,
        default=PITCH_SIGMA,
        metavar="SHARE",
        help=f"of the board's pitch ({PITCH_SIGMA:g})",
    )
    added.add_argument("--range", type=Path, metavar="DIR", help="range images of the range camera, 16 bit")
    added.add_argument("--range-units-per-m", type=float, default=1000.0, metavar="N", help="of those images (1000)")
    added.add_argument("--amplitude", type=Path, metavar="DIR", help="their amplitude images, 16 bit")
    added.add_argument("--modulation-mhz", type=float, metavar="F", help="of its light, by the data sheet")
    added.set_defaults(run=run)


def solved(args: argparse.Namespace) -> Solution:
    """What the arguments ask for, solved."""
    plan = _plan(args)
    folders = dict(zip(plan.cameras, args.folders, strict=True))
    views = read_board_views(folders)
    if args.range is None and (args.amplitude is not None or args.modulation_mhz is not None):
        raise BadInputError("bad_arguments", "--amplitude and --modulation-mhz are of range images: add --range")
    if args.range is not None:
        views = with_ranges(views, plan, args.range, args.range_units_per_m, amplitudes=args.amplitude)
    return solve_rig(views, plan)


def run(args: argparse.Namespace) -> None:
    """Solve, and write what was asked for."""
    refuse_overwriting(args.report, args.output)
    with while_working("solving"):
        solution = solved(args)
        rig = solved_rig(solution, made_s=time.time())
    with while_working("comparing halves of the images, and without each of them"):
        seen = examined(solution, rig)
    _write(args.output, rig.to_json())
    sys.stdout.write(told(statistics_of(solution)) + told_ranges(solution))
    for each in seen.warnings:
        sys.stderr.write(f"warning: {each}\n")
    if seen.next_images and seen.warnings:
        sys.stderr.write(f"next: {seen.next_images[0]}\n")
    sys.stdout.write(f"{args.output}: {', '.join(rig.cameras)}\n")
    if args.report is not None:
        write_report(args.report, seen, report_images(dict(zip(solution.plan.cameras, args.folders, strict=True))))


def refuse_overwriting(report: Path | None, rig: Path) -> None:
    """Whether a report's JSON would be written over rig.json.

    Raises:
        BadInputError: it would.
    """
    if report is not None and report.with_suffix(".json").resolve() == rig.resolve():
        raise BadInputError(
            "bad_arguments",
            f"the report's numbers go to {report.with_suffix('.json')}, which is {rig}: name the report otherwise",
        )


def write_report(path: Path, seen: Examination, images: Mapping[str, Sequence[ReportImage]]) -> None:
    """The report as HTML, and beside it as JSON."""
    _write(path, report_page(seen, images).encode())
    _write(path.with_suffix(".json"), examination_json(seen))
    count = f"{len(seen.warnings)} warning{'s' * (len(seen.warnings) != 1)}"
    sys.stdout.write(f"{path}: {count}; the same as {path.stem}.json\n")


def _write(path: Path, data: bytes) -> None:
    try:
        path.write_bytes(data)
    except OSError as exc:
        raise BadInputError("cannot_write", f"cannot write {path}: {exc.strerror}") from exc


def told(statistics: Statistics) -> str:
    """A line for each camera."""
    width = max(len(name) for name in statistics.cameras)
    return "".join(
        f"{name:<{width}}  {each.images} images  {each.points} points  {each.outliers} outliers  "
        f"noise {each.sigma_px:.3f} px  rms {each.rms_px:.3f} px\n"
        for name, each in statistics.cameras.items()
    )


def _plan(args: argparse.Namespace) -> SolvePlan:
    names = [folder.resolve().name for folder in args.folders]
    if len(set(names)) < len(names):
        raise BadInputError("bad_arguments", f"folders must have names of their own, got {', '.join(names)}")
    spectra = _spectra(args.spectrum, names)
    usual = usual_plan(spectra, rig_name=args.name, gauge=args.gauge)
    free = dict(_distortion(text, names) for text in args.distortion)
    fisheyes = [name for name in args.fisheye.split(",") if name]
    if strange := [name for name in fisheyes if name not in names]:
        raise BadInputError(
            "unknown_camera", f"--fisheye: there is no camera {strange[0]!r}; there are {', '.join(names)}"
        )
    cameras = {
        name: CameraPlan(spectrum=spectra[name], model="kb4" if name in fisheyes else "pinhole", free=free.get(name))
        for name in names
    }
    if not 0 <= args.pitch_sigma < 0.1:
        raise BadInputError("bad_arguments", f"--pitch-sigma is a share, 0 to 0.1, got {args.pitch_sigma:g}")
    return SolvePlan(
        cameras=cameras,
        gauge=usual.gauge,
        rig_name=args.name,
        warp=not args.flat,
        pitch_sigma=args.pitch_sigma,
        modulation_hz=_modulation_hz(args.modulation_mhz),
    )


def _spectra(text: str, names: list[str]) -> dict[str, Spectrum]:
    spectra: dict[str, Spectrum] = {}
    for part in filter(None, text.split(",")):
        name, _, value = part.rpartition("=")
        if value not in list(Spectrum):
            raise BadInputError("bad_arguments", f"a spectrum is {', '.join(Spectrum)}, got {value[:80]!r}")
        if name and name not in names:
            raise BadInputError(
                "unknown_camera", f"--spectrum: there is no camera {name!r}; there are {', '.join(names)}"
            )
        spectra.update(dict.fromkeys([name] if name else names, Spectrum(value)))
    if lost := [name for name in names if name not in spectra]:
        raise BadInputError("bad_arguments", f"--spectrum does not say what {', '.join(lost)} sees")
    return {name: spectra[name] for name in names}


def _distortion(text: str, names: list[str]) -> tuple[str, tuple[str, ...]]:
    name, equals, values = text.partition("=")
    if not equals or name not in names:
        raise BadInputError(
            "bad_arguments", f"--distortion is NAME=k1,k2,... with one of {', '.join(names)}, got {text[:80]!r}"
        )
    return name, tuple(value for value in values.split(",") if value)


def _modulation_hz(modulation_mhz: float | None) -> float | None:
    if modulation_mhz is not None and not 0.1 <= modulation_mhz <= 10_000:
        raise BadInputError("bad_arguments", f"--modulation-mhz is 0.1 to 10000 MHz, got {modulation_mhz:g}")
    return None if modulation_mhz is None else 1e6 * modulation_mhz
