"""Turn rig.json into a camera file of Kalibr, OpenCV, ROS or mrcal, and back.

    $ cairn calib convert rig.json camchain.yaml --format kalibr
    camchain.yaml: tof, left, right
    left out: cameras.tof.spectrum, cameras.left.spectrum, cameras.right.spectrum
    $ cairn calib convert camchain.yaml rig.json --spectrum tof=range,left=colour,right=colour
    $ cairn calib convert rig.json '{camera}.cameramodel'               # a file for each camera
    $ cairn calib convert left.cameramodel right.cameramodel rig.json --spectrum colour
    $ cairn calib convert rig.json left.yaml --format ros --camera left --drop T_rig_camera
    $ ros2 topic echo --once /left/camera_info > info.yaml              # read as it is printed
    $ cairn calib convert info.yaml left.json --spectrum colour

OUT's format follows its suffix (.json: rig.json; .cameramodel: mrcal); to .yaml say --format. What IN is, is found out.

    format    a file holds     lenses                                   place of a camera
    kalibr    all cameras      Brown k1, k2, p1, p2; KB4 fisheye        T_cn_cnm1 (or T_cam_imu, T_imu_cam)
    opencv    one camera       Brown to 8 coefficients; KB4 fisheye     R, T: rig to camera
    ros       one camera       Brown to 8 coefficients; KB4 fisheye     none
    mrcal     one camera       Brown to 8 coefficients                  extrinsics: rig to camera

Every number of a lens comes back as it was, places to rounding. A number that the other format cannot say is an error
that names it; what it may do without (T_rig_camera, sensing, calibration_sigma_px, radiometry, range_bias, body,
calibration) can be left out by --drop. No format says what spectrum a camera sees: coming back, --spectrum does.

The rig's frame is that of Kalibr's first camera; where the IMU is on the head goes into no rig.json, and is named as
left out. Lenses of other models (omni, EUCM, double sphere, FOV, splined) are refused by name, with the way out: the
same images calibrated as a fisheye (equidistant) or as Brown's pinhole.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from cairn_calib.exchange.placed_camera import KIND, CameraFile, PlacedCamera
from cairn_calib.exchange.rig_exchange import (
    DROPPABLE,
    FORMATS,
    RIG,
    cameras_of_rig,
    choose_cameras,
    format_of_text,
    read_cameras,
    read_text,
    rig_of_cameras,
)
from cairn_calib.rig.rig import Spectrum, rig_from_json
from cairn_map.errors import BadInputError

if TYPE_CHECKING:
    from argparse import _SubParsersAction

SUFFIXES = {".json": RIG, ".cameramodel": "mrcal"}
PLACEHOLDER = "{camera}"


def add_parser(commands: "_SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add `convert` to `cairn calib`."""
    added = commands.add_parser(
        "convert",
        help="rig.json from and to the camera files of Kalibr, OpenCV, ROS and mrcal",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    added.add_argument("files", nargs="+", type=Path, metavar="IN", help="one file, or several with a camera each")
    added.add_argument("out", type=Path, metavar="OUT", help="what to write; {camera} in it: a file for each camera")
    added.add_argument("--format", choices=[RIG, *FORMATS], help="of OUT (by its suffix)")
    added.add_argument("--camera", action="append", default=[], metavar="NAME", help="only this one; again: that too")
    added.add_argument("--drop", default="", metavar="FIELD,...", help=f"leave out: {', '.join(DROPPABLE)}")
    added.add_argument(
        "--spectrum", default="", metavar="[NAME=]SPECTRUM,...", help="range, colour or thermal; to rig.json"
    )
    added.add_argument("--name", help="of the rig, to rig.json (the first IN's)")
    added.set_defaults(run=run)


def run(args: argparse.Namespace) -> None:
    """Convert; report the files on standard output, and left-out fields on standard error."""
    out: Path = args.out
    target = args.format or SUFFIXES.get(out.suffix)
    if target is None:
        raise BadInputError("bad_arguments", f"{out.name} may be of any of {', '.join(FORMATS)}: add --format")
    drop = [field for field in args.drop.split(",") if field]
    if unknown := [field for field in drop if field not in DROPPABLE]:
        raise BadInputError("bad_arguments", f"--drop takes {', '.join(DROPPABLE)}, got {unknown[0][:80]!r}")
    found = [_read(path, target, args.camera, drop) for path in args.files]
    cameras = choose_cameras([each for foreign in found for each in foreign.cameras], args.camera)
    if target == RIG:
        rig = rig_of_cameras(cameras, name=args.name or args.files[0].stem, spectra=_spectra(args.spectrum, cameras))
        _write(out, rig.to_json().decode(), cameras)
    elif PLACEHOLDER in out.name:
        for each in cameras:
            _write(out.with_name(out.name.replace(PLACEHOLDER, each.name)), FORMATS[target].write([each]), [each])
    else:
        _write(out, FORMATS[target].write(cameras), cameras)
    if left_out := [field for foreign in found for field in foreign.left_out]:
        sys.stderr.write(f"left out: {', '.join(left_out)}\n")


def _read(path: Path, target: str, names: Sequence[str], drop: Sequence[str]) -> CameraFile:
    text = read_text(path)
    if format_of_text(path, text) != RIG:
        return read_cameras(path, text)
    if target == RIG:
        raise BadInputError("bad_arguments", f"{path.name} is a rig.json already")
    rig = rig_from_json(text.encode())
    if names:
        rig = rig.model_copy(update={"cameras": {name: rig[name] for name in names}})
    return cameras_of_rig(rig, format_name=target, drop=drop)


def _write(path: Path, text: str, cameras: Sequence[PlacedCamera]) -> None:
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as exc:
        raise BadInputError(KIND, f"cannot write {path}: {exc.strerror}") from exc
    sys.stdout.write(f"{path}: {', '.join(each.name for each in cameras)}\n")


def _spectra(text: str, cameras: Sequence[PlacedCamera]) -> dict[str, Spectrum]:
    """Spectra by camera, of `range` for all or `tof=range,left=colour`."""
    spectra = {}
    for part in filter(None, text.split(",")):
        name, _, value = part.rpartition("=")
        if value not in list(Spectrum):
            raise BadInputError("bad_arguments", f"a spectrum is {', '.join(Spectrum)}, got {value[:80]!r}")
        if name and name not in [each.name for each in cameras]:
            known = ", ".join(each.name for each in cameras)
            raise BadInputError("unknown_camera", f"--spectrum: there is no camera {name!r}; there are {known}")
        spectra.update(dict.fromkeys([name] if name else [each.name for each in cameras], Spectrum(value)))
    return spectra
