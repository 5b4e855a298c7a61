"""Read a rig.json, say what it is, and doubt numbers that no head has.

    $ cairn calib check rig.json
    rig orpheus-head, digest 3f5c...: 3 cameras
      tof          range     176 x 144 pixels, 69 x 56 degrees, at (0.000, 0.000, 0.000) m
      colour_left  colour    1280 x 960 pixels, 60 x 47 degrees, at (0.060, 0.000, 0.012) m
    doubt: colour_left stands 60.0 m from tof: are its numbers millimetres? T_rig_camera is in metres

A file that is no rig is refused, with the field and what is wrong. Doubts are printed, and change nothing: the exit
code is 0. Commits state the digest of the rig that made them: `cairn map retract --rig rig.json` takes all of them out.
"""

import argparse
import math
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from cairn_calib.rig.camera import Camera
from cairn_calib.rig.lens import Lens
from cairn_calib.rig.rig import MountedCamera, Rig, Spectrum, load_rig

if TYPE_CHECKING:
    from argparse import _SubParsersAction

LEVER_M = 5.0
"""Distance of two cameras on one head from which on it is doubted."""
NARROW_DEG, WIDE_DEG = 1.0, 160.0
"""Field of view of a lens without a model of a fisheye, between which none is doubted."""
OFF_CENTRE = 0.25
"""Distance of the principal point from the image's middle, as a share of its side, from which on it is doubted."""
OTHER_WAY_DEG = 90.0
"""Angle between two cameras' optical axes from which on they see nothing together."""


def add_parser(commands: "_SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add `check` to `cairn calib`."""
    added = commands.add_parser(
        "check",
        help="say what is in a rig.json, and doubt numbers that no head has",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    added.add_argument("rig", type=Path, metavar="RIG", help="rig.json")
    added.set_defaults(run=_run)


def _run(args: argparse.Namespace) -> None:
    rig = load_rig(args.rig)
    lines = [f"rig {rig.name}, digest {rig.digest()}: {len(rig.cameras)} cameras"]
    width = max(map(len, rig.cameras))
    for name, mounted in rig.cameras.items():
        place = ", ".join(f"{value:.3f}" for value in mounted.transform[:3, 3])
        lines.append(f"  {name:<{width}}  {mounted.spectrum:<8}  {_raster(mounted)}, at ({place}) m")
    if rig.calibration is None:
        lines.append("  how certain these numbers are is not stated: `cairn calib solve` writes a covariance")
    lines += [f"doubt: {text}" for text in doubts_of(rig)]
    sys.stdout.write("\n".join(lines) + "\n")


def doubts_of(rig: Rig) -> Iterator[str]:
    """Sentences about numbers that no head has."""
    first, *_ = rig.of_spectrum(Spectrum.RANGE) or list(rig.cameras)
    others = [name for name in rig.cameras if name != first]
    for name in others:
        between_m = float(np.linalg.norm(rig[name].transform[:3, 3] - rig[first].transform[:3, 3]))
        if between_m > LEVER_M:
            yield (
                f"{name} stands {between_m:.1f} m from {first}: are its numbers millimetres? T_rig_camera is in metres"
            )
        if isinstance(rig[name].camera, Lens) and isinstance(rig[first].camera, Lens):
            along = float(rig[name].transform[:3, 2] @ rig[first].transform[:3, 2])
            angle_deg = math.degrees(math.acos(min(1.0, max(-1.0, along))))
            if angle_deg > OTHER_WAY_DEG:
                yield (
                    f"{name} looks {angle_deg:.0f} degrees away from {first}: is its T_rig_camera the other way round? "
                    "It maps points from the camera to the rig"
                )
    for name, mounted in rig.cameras.items():
        yield from _doubts_of_lens(name, mounted)


def _doubts_of_lens(name: str, mounted: MountedCamera) -> Iterator[str]:
    camera = mounted.camera
    if not isinstance(camera, Lens):
        return
    for axis, side, focal_px, centre_px in zip(
        "xy", (camera.width, camera.height), camera.focal_px, camera.centre_px, strict=True
    ):
        view_deg = _view_deg(camera, side, focal_px)
        if isinstance(camera, Camera) and not NARROW_DEG < view_deg < WIDE_DEG:
            yield (
                f"{name} sees {view_deg:.1f} degrees along {axis}: focal_px is {focal_px:g} for {side} pixels; it is "
                "in pixels, not in millimetres"
            )
        if abs(centre_px - (side - 1) / 2) > OFF_CENTRE * side:
            yield (
                f"{name} has its principal point at {centre_px:g} of {side} pixels along {axis}: is it of an image of "
                "another size?"
            )


def _raster(mounted: MountedCamera) -> str:
    camera = mounted.camera
    text = f"{camera.width} x {camera.height} pixels"
    if isinstance(camera, Lens):
        across, down = (
            _view_deg(camera, side, focal)
            for side, focal in zip((camera.width, camera.height), camera.focal_px, strict=True)
        )
        text += f", {across:.0f} x {down:.0f} degrees"
    return text


def _view_deg(camera: Lens, side: int, focal_px: float) -> float:
    """Field of view of a lens without distortion, and its principal point in the middle."""
    half = side / 2 / focal_px
    return math.degrees(2 * (math.atan(half) if isinstance(camera, Camera) else half))
