"""Options of `cairn calib solve`, which `cairn calib report` reads as well: the views and the plan that they name."""

import argparse
from pathlib import Path

from cairn_calib.cli.known_lenses import add_known_options, with_known
from cairn_calib.rig.rig import Spectrum
from cairn_calib.solve.board_views import BoardViews, RangeCoding, add_ranges, read_board_views
from cairn_calib.solve.solve_plan import PITCH_SIGMA, CameraPlan, SolvePlan, usual_plan
from cairn_map.errors import BadInputError


def add_solve_options(parser: argparse.ArgumentParser) -> None:
    """Add the folders of corners and every option of a solve."""
    parser.add_argument("folders", nargs="+", type=Path, metavar="DIR", help="of corner documents, one for each camera")
    parser.add_argument(
        "--spectrum", required=True, metavar="[NAME=]SPECTRUM,...", help="range, colour or thermal, of all or by camera"
    )
    parser.add_argument("--output", type=Path, required=True, metavar="RIG.JSON")
    parser.add_argument("--report", type=Path, metavar="REPORT.HTML", help="for people; also as .json next to it")
    parser.add_argument(
        "--frame", metavar="REGEX", help="of image names without suffix; its group counts the places of the board"
    )
    parser.add_argument("--gauge", metavar="NAME", help="the camera whose frame is the rig's")
    parser.add_argument("--name", default="rig", help="of the rig (rig)")
    parser.add_argument(
        "--distortion", action="append", default=[], metavar="NAME=k1,k2,...", help="free coefficients; NAME=: none"
    )
    parser.add_argument("--fisheye", default="", metavar="NAME,...", help="cameras with the KB4 model")
    add_known_options(parser)
    parser.add_argument("--flat", action="store_true", help="the board is not bent at all")
    parser.add_argument(
        "--pitch-sigma",
        type=float,
        default=PITCH_SIGMA,
        metavar="SHARE",
        help=f"of the board's pitch ({PITCH_SIGMA:g})",
    )
    parser.add_argument("--range", type=Path, metavar="DIR", help="range images of the range camera, 16 bit")
    parser.add_argument("--range-units-per-m", type=float, default=1000.0, metavar="N", help="of those images (1000)")
    parser.add_argument("--z-depth", action="store_true", help="those images are along the axis, not along the beam")
    parser.add_argument(
        "--disparity", metavar="FOCAL_PX,BASELINE_M,N", help="those images are disparity, N counts a pixel"
    )
    parser.add_argument("--amplitude", type=Path, metavar="DIR", help="their amplitude images, 16 bit")
    parser.add_argument("--modulation-mhz", type=float, metavar="F", help="of its light, by the data sheet")


def read_by_options(args: argparse.Namespace) -> tuple[BoardViews, SolvePlan]:
    """The corners, and ranges, that the options name, and the plan that they state: what `solve_rig` needs.

    Raises:
        BadInputError: the options contradict each other, or a file cannot be read.
    """
    plan = _plan(args)
    folders = dict(zip(plan.cameras, args.folders, strict=True))
    views = read_board_views(folders, frame=args.frame)
    plan = with_known(plan, args, views.sizes_px)
    of_ranges = {
        "--amplitude": args.amplitude,
        "--modulation-mhz": args.modulation_mhz,
        "--z-depth": args.z_depth or None,
        "--disparity": args.disparity,
    }
    if args.range is None and (stray := [name for name, value in of_ranges.items() if value is not None]):
        raise BadInputError("bad_arguments", f"{', '.join(stray)}: of range images; add --range")
    if args.range is not None:
        coding = _range_coding(args)
        views = add_ranges(views, plan, args.range, coding, amplitudes=args.amplitude, frame=args.frame)
    return views, plan


def _range_coding(args: argparse.Namespace) -> RangeCoding:
    if args.disparity is None:
        return RangeCoding(units=args.range_units_per_m, is_z_depth=args.z_depth)
    try:
        focal_px, baseline_m, units = (float(part) for part in args.disparity.split(","))
    except ValueError as exc:
        raise BadInputError(
            "bad_arguments",
            "--disparity is the focal length of the rectified images in pixels, the baseline in metres and the counts "
            f"a pixel of disparity, such as 1050.2,0.12,256; got {args.disparity[:60]!r}",
        ) from exc
    if args.z_depth:
        raise BadInputError("bad_arguments", "range images are z-depth or disparity: give --z-depth or --disparity")
    return RangeCoding(units=units, disparity=(focal_px, baseline_m))


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
