"""A map over what a recording's camera saw: for `cairn map render --over`."""

import argparse
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cairn_calib.rig import Spectrum
from cairn_fusion.importers import open_source
from cairn_fusion.live_range import live_range
from cairn_fusion.overlay import Live, Mode, Overlay, OverlayStyle, draw_overlay, with_overlay_legend
from cairn_fusion.overlay_blur import PoseSpread
from cairn_map.errors import BadInputError
from cairn_map.map_picture import arrays_of
from cairn_map.map_render import MapRenderer
from cairn_map.map_snapshot import MapSnapshot
from cairn_map.render_picture import Scale
from cairn_map.sight import Sight


@dataclass(frozen=True, slots=True, eq=False)
class Drawn:
    """A picture, what it was made of, and one line about it."""

    picture: npt.NDArray[np.uint8]
    arrays: dict[str, npt.NDArray[np.generic]]
    about: str


def draw_over_recording(snapshot: MapSnapshot, args: argparse.Namespace, scale: Scale, *, threads: int) -> Drawn:
    """The map over one image of a recording, as the command's options say.

    Raises:
        BadInputError: no such scan or camera, or the camera took no image then.
    """
    source = open_source(args.over)
    if not 0 <= args.scan < len(source):
        raise BadInputError("no_scan", f"{args.over} has scans 0 to {len(source) - 1}, got {args.scan}")
    scan, rig = source.scan(args.scan), source.rig
    names = rig.of_spectrum(Spectrum.COLOUR)
    name = args.camera or next((name for name in names if name in scan.colour), None)
    if name is None or name not in scan.colour:
        has = ", ".join(scan.colour) or "none"
        raise BadInputError("unknown_camera", f"scan {args.scan} has no colour image of {name}; it has {has}")
    live = Live(
        rgb=scan.colour[name],
        range_m=live_range(scan, rig, camera=name),
        sight=Sight(rig[name].camera.rays()),
        T_map_camera=scan.T_map_rig @ rig[name].transform,
        spread=PoseSpread(args.sigma[0], float(np.radians(args.sigma[1]))),
    )
    style = OverlayStyle(layer=args.layer, scale=scale, range_max_m=args.range)
    drawn = draw_overlay(MapRenderer(threads=threads), snapshot, live, style)
    arrays = arrays_of(drawn.values, drawn.front, args.layer) | {"modes": drawn.modes, "through": drawn.through}
    return Drawn(
        with_overlay_legend(drawn.picture, style.colours), arrays, f"{name}, scan {args.scan}: {_about(drawn)}"
    )


def _about(drawn: Overlay) -> str:
    if drawn.withheld is not None:
        return f"withheld, {drawn.withheld}"
    visible, alone = ((drawn.front_modes == mode).mean() for mode in (Mode.VISIBLE, Mode.MAP_ONLY))
    return f"visible {visible:.0%}, see-through {drawn.through.mean():.0%}, map only {alone:.0%}"
