"""Calibrate the counts of a thermal camera, and read temperatures from its images.

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
in pixels. List several images of each temperature: they show the noise. Two temperatures will do, and four or more fix
Planck's B, too. Where black bodies fill the view, maps of the pixels' gain, offset and shading come out next to it,
each with its standard deviation. Cameras that compute a temperature themselves, whose counts step by so many a kelvin,
need `--law polynomial`.

A warm camera sees itself: give `housing_celsius`, what its own thermometer said, in the table, black bodies seen by a
cold and by a warm camera, and `read --housing` later. Images during a flat-field correction (the shutter) and within
2 s after it are left out: the column `since_ffc_s` says how long ago it was, 0 during it; repeated
images are found by the program.

`read` turns 16-bit images into kelvin; radiometric JPEGs of FLIR bring their camera's numbers along. Temperatures of
surfaces need their emissivity and what they mirror: `--emissivity`, `--reflected`. There is no temperature
without a measurement: without radiometry you get counts, and beyond its range nothing.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from cairn_calib.board.corner_pictures import overlay, write_picture
from cairn_calib.rig.image_files import read_grey, write_grey16
from cairn_calib.rig.radiometry import ZERO_C_K, Radiometry, radiometry_from_json
from cairn_calib.rig.rig import RIG_BYTES_MAX, load_rig, rig_from_json
from cairn_calib.thermal.flat_field import FlatField, FlatFieldFit, fit_flat_field, read_flat_field, write_flat_field
from cairn_calib.thermal.flir_file import read_flir
from cairn_calib.thermal.object_temperature import NotRadiometric, Viewing, temperatures
from cairn_calib.thermal.reference_table import (
    COLUMNS,
    HOUSING,
    REGION,
    SINCE_FFC,
    BlackBody,
    read_references,
    repetition_text,
)
from cairn_calib.thermal.response_fit import Reference, ResponseFit, fit_response
from cairn_map.errors import BadInputError

if TYPE_CHECKING:
    from argparse import _SubParsersAction

COUNTS_PER_KELVIN = 100
"""Unit of `--output`, as in recordings; 0 is no reading."""


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
    columns = f"{', '.join(COLUMNS)}[, {', '.join(REGION)}][, {HOUSING}][, {SINCE_FFC}]"
    fit.add_argument("table", type=Path, metavar="CSV", help=columns)
    fit.add_argument("out", type=Path, metavar="OUT", help="JSON to write; maps go next to it")
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
    read.add_argument("--housing", type=float, metavar="CELSIUS", help="how warm the camera itself was")
    read.add_argument("--output", type=Path, metavar="PNG", help="write 16 bits, 0.01 K a count, 0: no reading")
    read.add_argument("--picture", type=Path, metavar="PNG", help="write a picture to look at")
    read.set_defaults(run=_read)
    for one in (fit, read):
        one.add_argument("--camera", metavar="NAME", help="of --rig")


def _fit(args: argparse.Namespace) -> None:
    _check_camera(args)
    table = read_references(args.table)
    full = [body.counts for body in table.bodies if body.region is None and len(body.counts) > 1]
    flat = fit_flat_field(full) if full else None
    references = [_reference(body, flat) for body in table.bodies]
    lost = f"; {len(table.left_out)} images left out" if table.left_out else ""
    source = f"{len(references)} black bodies, {args.table.name}{lost}"
    noise = flat.noise_counts if flat else _noise(table.bodies)
    fitted = fit_response(references, law=args.law, source=source, noise_counts=noise)
    update: dict[str, object] = {}
    if flat:
        maps = write_flat_field(args.out.with_name(f"{args.out.stem}.maps.npz"), flat.flat_field)
        update = {"maps": maps, "pattern_counts": flat.pattern_counts}
    radiometry = fitted.radiometry.model_copy(update=update)
    _write(args, radiometry)
    for line in table.left_out:
        _say(f"left out: {line}")
    _tell(fitted, references, flat)


def _reference(body: BlackBody, flat: FlatFieldFit | None) -> Reference:
    level = np.array([flat.flat_field.level_counts(image) if flat else image for image in body.counts], np.float64)
    region = body.region
    if region is not None:
        x, y, width, height = region
        if x < 0 or y < 0 or min(width, height) < 1 or x + width > level.shape[2] or y + height > level.shape[1]:
            raise BadInputError("bad_references", f"the part {region} is not within an image of {level.shape[2:0:-1]}")
        level = level[:, y : y + height, x : x + width]
    each = level.mean(axis=0)
    each = each[np.isfinite(each)]
    if not each.size:
        raise BadInputError("bad_references", f"every pixel of the black body at {body.celsius:g} C is bad")
    sigma = float(each.std() / np.sqrt(each.size))
    return Reference(body.celsius + ZERO_C_K, body.sigma_k, float(each.mean()), sigma, body.housing_k)


def _noise(bodies: Sequence[BlackBody]) -> float:
    stacks = (body.counts for body in bodies)
    spreads = [float(np.sqrt(np.median(s.var(axis=0, ddof=1)))) for s in stacks if len(s) > 1]
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
    _tell_housing(fitted.radiometry, references)
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


def _tell_housing(radiometry: Radiometry, references: Sequence[Reference]) -> None:
    housing = radiometry.housing
    if housing is not None:
        low, high = (k - ZERO_C_K for k in housing.range_k)
        sigma = float(np.sqrt(housing.covariance_row[3]))
        _say(
            f"housing: {housing.counts_per_k:.3g} +- {sigma:.2g} counts a kelvin of it, {low:.1f} to {high:.1f} C; "
            f"if its temperature is not given, {abs(housing.counts_per_k) * housing.spread_k:.3g} counts are open"
        )
    elif any(each.housing_k is not None for each in references):
        _say("housing: it was nearly as warm all the time, or warmed with the black bodies: what it adds is not known")


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
    radiometry, flat = _radiometry_and_maps(args)
    if (args.output or args.picture) and len(args.images) > 1:
        raise BadInputError("bad_arguments", "--output and --picture take one image at a time")
    housing_k = None if args.housing is None else args.housing + ZERO_C_K
    seen_before: dict[bytes, str] = {}
    for path in args.images:
        viewing, own = Viewing(), radiometry
        if radiometry is None and path.suffix.lower() in (".jpg", ".jpeg"):
            image = read_flir(path)
            counts, viewing, own = np.asarray(image.counts, np.float32), image.viewing, image.radiometry
        else:
            counts, _ = read_grey(path)
        if (twin := seen_before.setdefault(counts.tobytes(), path.name)) != path.name:
            _say(f"{path.name}: {repetition_text(twin)}")
        found = temperatures(counts, own, viewing=_viewing(viewing, args), flat_field=flat, housing_k=housing_k)
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


def _radiometry_and_maps(args: argparse.Namespace) -> tuple[Radiometry | None, FlatField | None]:
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


def _say(text: str) -> None:
    sys.stdout.write(text + "\n")
