"""Find out what a thermal camera's counts mean, and read temperatures from its images.

    $ cairn calib thermal fit blackbody.csv tau.json
    planck law from 5 temperatures, 10.0 to 90.0 C: chi2 2.1 of 2
         10.00 C  read as  10.02 C   sigma 0.10 K
    pixels: noise 2.1 counts (0.05 K), pattern left 0.4 counts (0.01 K), shading 41 counts from end to end, 12 bad
    $ cairn calib thermal fit blackbody.csv calibrated.json --rig rig.json --camera thermal_left
    $ cairn calib thermal read frame.png --radiometry tau.json --emissivity 0.95 --emissivity-sigma 0.02
    frame.png: 18.2 to 61.0 C, median 21.4 C +- 0.31 K (0.29 K of it the same for all pixels)
    $ cairn calib thermal read FLIR0123.jpg --output kelvin.png
    $ cairn calib thermal read frame.png
    frame.png: counts 12501 to 20042, not radiometric: the camera has no radiometry: no reference was measured

`fit` takes a table of black bodies (CSV with a head line): image, celsius, sigma_k (standard deviation of the black
body's temperature), and, where it does not fill the view, x, y, width, height of the part of the image that it fills,
in pixels. List several images of each temperature: they tell the noise. Two temperatures will do, and four or more tell
Planck's B, too. Where black bodies fill the view, maps of the pixels' gain, offset and shading come out beside it.
Cameras that compute a temperature themselves, whose counts step by so many a kelvin, need `--law polynomial`.

`read` turns 16-bit images into kelvin; radiometric JPEGs of FLIR bring their camera's numbers along. Temperatures of
surfaces need their emissivity and what they mirror: `--emissivity`, `--reflected`. What nobody measured has no
temperature: without radiometry you get counts, and beyond its range nothing.
"""

import argparse
import csv
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from cairn_calib.corner_pictures import overlay, read_grey, write_grey16, write_picture
from cairn_calib.flat_field import FlatField, FlatFieldFit, fit_flat_field, read_flat_field, write_flat_field
from cairn_calib.flir_file import read_flir
from cairn_calib.object_temperature import NotRadiometric, Viewing, temperatures
from cairn_calib.radiometry import ZERO_C_K, Radiometry, radiometry_from_json
from cairn_calib.response_fit import Reference, ResponseFit, fit_response
from cairn_calib.rig import RIG_BYTES_MAX, load_rig, rig_from_json
from cairn_map.errors import BadInputError

if TYPE_CHECKING:
    from argparse import _SubParsersAction

COLUMNS = ["image", "celsius", "sigma_k"]
REGION = ["x", "y", "width", "height"]
COUNTS_PER_KELVIN = 100
"""Of `--output`, as in recordings; 0 is no reading."""
Region = tuple[int, int, int, int]
Row = tuple[float, float, Region | None]
"""Temperature, its standard deviation, and the part of the image."""
Rows = dict[Row, list[Path]]


def add_parser(commands: "_SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add `thermal` to `cairn calib`."""
    added = commands.add_parser(
        "thermal",
        help="what a thermal camera's counts mean, and temperatures by it",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    actions = added.add_subparsers(required=True, metavar="ACTION")
    fit = actions.add_parser("fit", help="the response of a camera, from black bodies")
    fit.add_argument("table", type=Path, metavar="CSV", help=f"{', '.join(COLUMNS)}[, {', '.join(REGION)}]")
    fit.add_argument("out", type=Path, metavar="OUT", help="JSON to write; maps go beside it")
    fit.add_argument("--law", choices=("planck", "polynomial"), default="planck", help="(planck)")
    fit.add_argument("--rig", type=Path, metavar="FILE", help="OUT is this rig.json with the radiometry in it")
    fit.set_defaults(run=_fit)
    read = actions.add_parser("read", help="temperatures in images")
    read.add_argument("images", type=Path, nargs="+", metavar="IMAGE", help="16-bit PNG or TIFF, or FLIR's JPEG")
    read.add_argument("--radiometry", type=Path, metavar="FILE", help="what `fit` wrote")
    read.add_argument("--rig", type=Path, metavar="FILE", help="rig.json with the radiometry, instead")
    read.add_argument("--emissivity", type=float, help="of the surface (1, or as the JPEG says)")
    read.add_argument("--emissivity-sigma", type=float, default=0.0, help="its standard deviation (0)")
    read.add_argument("--reflected", type=float, metavar="CELSIUS", help="what it mirrors (20, or as the JPEG says)")
    read.add_argument("--reflected-sigma", type=float, default=0.0, metavar="K", help="its standard deviation (0)")
    read.add_argument("--output", type=Path, metavar="PNG", help="write 16 bits, 0.01 K a count, 0: no reading")
    read.add_argument("--picture", type=Path, metavar="PNG", help="write a picture to look at")
    read.set_defaults(run=_read)
    for one in (fit, read):
        one.add_argument("--camera", metavar="NAME", help="of --rig")


def _fit(args: argparse.Namespace) -> None:
    _check_camera(args)
    rows = _rows(args.table)
    stacks = {row: np.array([read_grey(path)[0] for path in paths]) for row, paths in rows.items()}
    full = [stack for (_, _, region), stack in stacks.items() if region is None and len(stack) > 1]
    flat = fit_flat_field(full) if full else None
    references = [_reference(row, stack, flat) for row, stack in stacks.items()]
    source = f"{len(references)} black bodies, {args.table.name}"
    noise = flat.noise_counts if flat else _noise(stacks)
    fitted = fit_response(references, law=args.law, source=source, noise_counts=noise)
    update: dict[str, object] = {}
    if flat:
        maps = write_flat_field(args.out.with_name(f"{args.out.stem}.maps.npz"), flat.flat_field)
        update = {"maps": maps, "pattern_counts": flat.pattern_counts}
    radiometry = fitted.radiometry.model_copy(update=update)
    _write(args, radiometry)
    _tell(fitted, references, flat)


def _reference(
    row: tuple[float, float, Region | None], stack: npt.NDArray[np.float32], flat: FlatFieldFit | None
) -> Reference:
    celsius, sigma_k, region = row
    level = np.array([flat.flat_field.levelled(image) if flat else image for image in stack], np.float64)
    if region is not None:
        x, y, width, height = region
        if x < 0 or y < 0 or min(width, height) < 1 or x + width > level.shape[2] or y + height > level.shape[1]:
            raise BadInputError("bad_references", f"the part {region} is not within an image of {level.shape[2:0:-1]}")
        level = level[:, y : y + height, x : x + width]
    each = level.mean(axis=0)
    each = each[np.isfinite(each)]
    if not each.size:
        raise BadInputError("bad_references", f"every pixel of the black body at {celsius:g} C is bad")
    return Reference(celsius + ZERO_C_K, sigma_k, float(each.mean()), float(each.std() / np.sqrt(each.size)))


def _noise(stacks: dict[Row, npt.NDArray[np.float32]]) -> float:
    spreads = [float(np.sqrt(np.median(s.var(axis=0, ddof=1)))) for s in stacks.values() if len(s) > 1]
    return float(np.median(spreads)) if spreads else 0.0


def _tell(fitted: ResponseFit, references: Sequence[Reference], flat: FlatFieldFit | None) -> None:
    rows = sorted(references, key=lambda each: each.kelvin)
    low, high = (each.kelvin - ZERO_C_K for each in (rows[0], rows[-1]))
    response = fitted.radiometry.response
    _say(
        f"{response.law} law from {len(rows)} temperatures, {low:.1f} to {high:.1f} C: "
        f"chi2 {fitted.chi2:.1f} of {fitted.degrees_of_freedom}"
    )
    for each, residual in zip(rows, fitted.residuals_k, strict=True):
        celsius = each.kelvin - ZERO_C_K
        _say(f"  {celsius:8.2f} C  read as {celsius + residual:8.2f} C   sigma {each.sigma_k:.2f} K")
    if flat is None:
        _say("pixels: no maps, for no black body fills the view in two images")
        return
    per_k = float(response.slope((rows[0].kelvin + rows[-1].kelvin) / 2))
    field = flat.flat_field
    _say(
        f"pixels: noise {flat.noise_counts:.3g} counts ({flat.noise_counts / per_k:.3f} K), pattern left "
        f"{flat.pattern_counts:.3g} counts ({flat.pattern_counts / per_k:.3f} K), shading "
        f"{np.ptp(field.shading):.3g} counts from end to end, {int(field.bad.sum())} bad"
    )


def _write(args: argparse.Namespace, radiometry: Radiometry) -> None:
    data = radiometry.to_json()
    if args.rig:
        rig = load_rig(args.rig)
        camera = rig[args.camera].model_copy(update={"radiometry": radiometry})
        data = rig.model_copy(update={"cameras": {**rig.cameras, args.camera: camera}}).to_json()
        rig_from_json(data)
    args.out.write_bytes(data)


def _read(args: argparse.Namespace) -> None:
    _check_camera(args)
    radiometry, flat = _known(args)
    if (args.output or args.picture) and len(args.images) > 1:
        raise BadInputError("bad_arguments", "--output and --picture take one image at a time")
    for path in args.images:
        viewing, own = Viewing(), radiometry
        if radiometry is None and path.suffix.lower() in (".jpg", ".jpeg"):
            image = read_flir(path)
            counts, viewing, own = np.asarray(image.counts, np.float32), image.viewing, image.radiometry
        else:
            counts, _ = read_grey(path)
        found = temperatures(counts, own, viewing=_viewing(viewing, args), flat_field=flat)
        if isinstance(found, NotRadiometric):
            _say(f"{path.name}: counts {counts.min():g} to {counts.max():g}, not radiometric: {found.reason}")
            if args.output or args.picture:
                raise BadInputError(
                    "not_radiometric", f"{path} has no temperatures to write: pass --radiometry or --rig"
                )
            continue
        kelvin = found.kelvin.astype(np.float64)
        seen = np.isfinite(kelvin)
        if not seen.any():
            raise BadInputError("out_of_range", f"{path}: every pixel is beyond the range of its radiometry")
        low, middle, high = (float(v) - ZERO_C_K for v in np.quantile(kelvin[seen], (0, 0.5, 1)))
        sigma, common = (float(np.median(s[seen])) for s in (found.sigma_k, found.common_sigma_k))
        lost = f"; {(~seen).sum()} pixels without" if not seen.all() else ""
        line = f"{path.name}: {low:.1f} to {high:.1f} C, median {middle:.1f} C +- {sigma:.2f} K"
        _say(f"{line} ({common:.2f} K of it the same for all pixels){lost}")
        if args.output:
            centi = np.where(seen, np.clip(np.rint(np.nan_to_num(kelvin) * COUNTS_PER_KELVIN), 1, 65535), 0)
            write_grey16(args.output, centi.astype(np.uint16))
        if args.picture:
            write_picture(
                args.picture, overlay(np.where(seen, kelvin, kelvin[seen].min()).astype(np.float32), None, title=line)
            )


def _known(args: argparse.Namespace) -> tuple[Radiometry | None, FlatField | None]:
    """The radiometry that was named, if one was, with its maps."""
    if args.rig:
        radiometry, folder = load_rig(args.rig)[args.camera].radiometry, args.rig.parent
    elif args.radiometry:
        try:
            with args.radiometry.open("rb") as file:
                radiometry = radiometry_from_json(file.read(RIG_BYTES_MAX))
        except OSError as exc:
            raise BadInputError("missing_file", f"cannot read {args.radiometry}: {exc.strerror}") from exc
        folder = args.radiometry.parent
    else:
        return None, None
    maps = radiometry.maps if radiometry else None
    return radiometry, read_flat_field(folder / maps.name, maps) if maps else None


def _viewing(told: Viewing, args: argparse.Namespace) -> Viewing:
    return Viewing(
        emissivity=told.emissivity if args.emissivity is None else args.emissivity,
        emissivity_sigma=args.emissivity_sigma,
        reflected_k=told.reflected_k if args.reflected is None else args.reflected + ZERO_C_K,
        reflected_sigma_k=args.reflected_sigma,
        transmission=told.transmission,
        air_k=told.air_k,
    )


def _check_camera(args: argparse.Namespace) -> None:
    if bool(args.rig) != bool(args.camera):
        raise BadInputError("bad_arguments", "--rig and --camera go together: of which of its cameras?")


def _rows(table: Path) -> Rows:
    """The images of each black body."""
    try:
        with table.open(encoding="utf-8", newline="") as file:
            reader = csv.DictReader(file, skipinitialspace=True)
            lines = list(reader)
    except (OSError, UnicodeDecodeError) as exc:
        raise BadInputError("bad_references", f"cannot read {table}: {exc}") from exc
    if missing := [name for name in COLUMNS if name not in (reader.fieldnames or ())]:
        raise BadInputError("bad_references", f"{table} has no column {missing[0]}; its head line must name {COLUMNS}")
    rows: Rows = {}
    for number, line in enumerate(lines, start=2):
        try:
            key = (float(line["celsius"]), float(line["sigma_k"]), _region(line))
        except (TypeError, ValueError) as exc:
            raise BadInputError("bad_references", f"{table}, line {number}: {exc}") from exc
        rows.setdefault(key, []).append(table.parent / line["image"])
    return rows


def _region(line: Mapping[str, str]) -> Region | None:
    sides = [line.get(name) or "" for name in REGION]
    if not any(sides):
        return None
    x, y, width, height = (int(side) for side in sides)
    return x, y, width, height


def _say(text: str) -> None:
    sys.stdout.write(text + "\n")
