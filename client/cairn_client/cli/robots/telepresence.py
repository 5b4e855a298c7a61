"""See heat on colour: a recording's cameras fused into one picture, a folder of pictures, or a live stream.

    $ cairn telepresence lab-1 --output view.png                        # scan 0, temperatures over colour
    $ cairn telepresence lab-1 --scan 12 --mode side-by-side --output view.png
    $ cairn telepresence lab-1 --hotter 40 --scale 15:60 --output pictures/    # all scans; only hot places
    $ cairn telepresence lab-1 --band 34:38 --mode stereo --serve 8760  # for a browser: http://127.0.0.1:8760/
    $ cairn telepresence lab-1 --mode colour-on-thermal --output view.png
    $ cairn telepresence lab-1 --publish http://127.0.0.1:8750/maps/lab --robot scout    # on the page, next to the map
    $ cairn telepresence lab-1 --map lab/ --mode map --serve 8760       # the map, over the robot's view

Range carries each temperature to the colour pixel of the same place; pixels that the thermal camera does not see from
where it stands are taken from the second one. Where no temperature is known the picture is hatched: it is never shown
as cold. With --map, a folder as for `cairn map render`, reflections in mirrors are hatched, too, where the map proves
them: behind a surface that others saw from elsewhere. Glass is not detected: the pane's own temperature is painted on
the things behind it. The scale is that of the first picture, or of --scale, and stays. Temperatures are apparent, deg
C.

--mode map draws the map itself over the colour image, temperatures or another --layer, so that a robot without a
thermal camera shows those that others measured: solid where the map agrees with the live depth; in stripes what lies
behind it, fainter the farther and, where the age is known, the older; in dots what only the map knows. Its scale is
that of the layer, or of --scale. --sigma gives the uncertainty of the rig's poses, along and about any one axis, or
--covariance in full, as `cairn map render --help` explains: the map spreads by it, and is withheld where it could be
anywhere. One picture of it, with all options: `cairn map render --over`.
"""

import argparse
import logging
import math
import time
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt

from cairn_client.cli.arguments import add_token, api_of, parser, say
from cairn_client.cli.maps.overlay_drawing import MapOverlay
from cairn_client.cli.robot_arguments import add_spread_arguments, spread_of
from cairn_client.cli.source_arguments import add_source_arguments, asked_source
from cairn_client.folders.map_folder import map_of_folder
from cairn_client.http.api import MapApi
from cairn_fusion.recording.images import write_colour
from cairn_fusion.recording.recording import ScanSource
from cairn_fusion.view.mjpeg import Latest
from cairn_fusion.view.overlay import OverlayStyle
from cairn_fusion.view.painting import Emphasis
from cairn_fusion.view.telepresence import Telepresence, ViewMode, ViewOptions
from cairn_fusion.view.temperature_scale import ZERO_CELSIUS_K, TemperatureScale
from cairn_map.arrays import Rgb
from cairn_map.errors import BadInputError, UnreachableError
from cairn_map.progress import with_progress
from cairn_map.render.render_picture import Layer, Scale

log = logging.getLogger(__name__)

RATE_HZ = 5.0
ALPHA = 0.5
NO_IMAGE = ("missing_image", "unknown_camera")
"""Kinds of the error for a scan without an image of the camera."""
View = tuple[int, npt.NDArray[np.uint8]]
"""A scan's number and its picture."""
MAP = "map"
"""Mode that draws the map over the live image."""


def main(argv: list[str]) -> int:
    """Write pictures, or serve them."""
    args = _parser().parse_args(argv)
    source = asked_source(args.recording, args)
    telepresence = _pictures(source, args)
    if args.serve is not None:
        _serve(source, telepresence, args)
    elif args.publish is not None:
        _publish(source, telepresence, args)
    elif args.output.suffix.lower() == ".png":
        _write(telepresence.view(source.scan(args.scan or 0)), args.output)
        say(f"wrote {args.output}: {args.mode}, scan {args.scan or 0} of {len(source)} of {source.name}")
    else:
        _write_all(source, telepresence, args)
    return 0


def _pictures(source: ScanSource, args: argparse.Namespace) -> Telepresence | MapOverlay:
    """The maker of pictures from scans that the options ask for."""
    if args.map is not None and args.map.startswith(("http://", "https://")):
        raise BadInputError(
            "bad_option", f"the map is needed here: `cairn clone {args.map} FOLDER`, and then FOLDER for the URL"
        )
    _check_options(args)
    if args.camera is not None:
        _ = source.rig[args.camera]  # raises: there is none
    found = None if args.map is None else map_of_folder(Path(args.map))
    if args.mode != MAP:
        return Telepresence(source.rig, _options(args), None if found is None else found.snapshot)
    if found is None:
        raise BadInputError("nothing_asked", "say which map: --map FOLDER, of exported cells or of a robot's state")
    layer = args.layer or Layer.TEMPERATURE
    if layer is Layer.AGE and found.ages is None:
        raise BadInputError("no_age", f"{args.map} does not say when anything was measured; choose another --layer")
    style = OverlayStyle(layer=layer, scale=None if args.scale is None else Scale(layer, *args.scale))
    return MapOverlay(rig=source.rig, map=found, style=style, camera=args.camera, spread=spread_of(args))


def _check_options(args: argparse.Namespace) -> None:
    """Refuse options that the mode would not show.

    Raises:
        BadInputError: kind `bad_option`.
    """
    painted = {f"--{name}" for name in ("alpha", "hotter", "band") if getattr(args, name) is not None}
    marker = {"--no-marker"} if args.no_marker else set[str]()
    spread = set[str]() if spread_of(args).is_exact else {f"--sigma or --covariance (of --mode {MAP})"}
    of_map = spread if args.layer is None else spread | {f"--layer (of --mode {MAP})"}
    unused = {
        MAP: painted | marker,
        ViewMode.SIDE_BY_SIDE: painted | of_map,
        ViewMode.STEREO: of_map if args.camera is None else of_map | {"--camera"},
    }.get(args.mode, of_map)
    if unused:
        raise BadInputError(
            "bad_option", f"--mode {args.mode} does not show {', '.join(sorted(unused))}; leave that out"
        )


def _views(source: ScanSource, telepresence: Telepresence | MapOverlay, numbers: Iterable[int]) -> Iterator[View]:
    """Numbers and pictures of scans in order; scans without an image of the camera are reported and left out.

    Raises:
        BadInputError: kind `missing_image` or `unknown_camera`: none has one.
    """
    shown, why = 0, None
    for number in numbers:
        try:
            picture = telepresence.view(source.scan(number))
        except BadInputError as exc:
            if exc.kind not in NO_IMAGE:
                raise
            say(f"left out scan {number}: {exc.message}")
            why = exc
        else:
            shown += 1
            yield number, picture
    if why is not None and not shown:
        raise why


def _write_all(source: ScanSource, telepresence: Telepresence | MapOverlay, args: argparse.Namespace) -> None:
    """One PNG a scan."""
    try:
        args.output.mkdir(parents=True, exist_ok=True)
    except OSError as exc:
        raise BadInputError("bad_output", f"cannot make the folder {args.output}: {exc.strerror}") from exc
    numbers = range(len(source)) if args.scan is None else [args.scan]
    written = 0
    for number, picture in _views(source, telepresence, with_progress(numbers, "pictures", total=len(numbers))):
        _write(picture, args.output / f"{number:06d}.png")
        written += 1
    say(f"wrote {written} pictures into {args.output}: {args.mode} of {source.name}")


def _write(picture: npt.NDArray[np.uint8], path: Path) -> None:
    try:
        write_colour(path, picture)
    except OSError as exc:
        raise BadInputError("bad_output", f"cannot write {path}: {exc.strerror}") from exc


def _serve(source: ScanSource, telepresence: Telepresence | MapOverlay, args: argparse.Namespace) -> None:
    """Show the scans one after the other, again and again, or one for good, until interrupted."""
    try:
        from cairn_fusion.view.mjpeg_server import stream_pictures
    except ModuleNotFoundError as exc:
        raise BadInputError("missing_extra", f'--serve needs {exc.name}: pip install "cairn-robotics[server]"') from exc
    host, port = args.serve
    latest = Latest()
    numbers = range(len(source)) if args.scan is None else [args.scan]
    # The first round finds out which scans have an image; the next ones show these.
    pictures = _views(source, telepresence, numbers)
    first, picture = next(pictures)
    latest.show(picture)
    with stream_pictures(latest, host=host, port=port) as url:
        say(f"{args.mode} of {source.name} at {url} ; end with Ctrl-C")
        there = [first]
        for number, picture in _paced(pictures, args.rate):
            latest.show(picture)
            there.append(number)
        while True:
            for _, picture in _paced(_views(source, telepresence, there), args.rate):
                latest.show(picture)


def _publish(source: ScanSource, telepresence: Telepresence | MapOverlay, args: argparse.Namespace) -> None:
    """Show each scan once on the server's page, to operators that follow the robot."""
    if args.robot is None:
        raise BadInputError("nothing_asked", "say whose view it is: --robot NAME, as it is registered with the map")
    api, map_name = api_of(args.publish, args.token)
    numbers = range(len(source)) if args.scan is None else [args.scan]
    with api:
        pictures = _paced(_views(source, telepresence, numbers), args.rate)
        sent, lost = publish_views((picture for _, picture in pictures), api, map_name, args.robot)
    missed = f", {lost} did not get through" if lost else ""
    say(f"{args.robot} showed {sent} pictures of {source.name}: {args.mode}{missed}")


def _paced(views: Iterator[View], rate_hz: float) -> Iterator[View]:
    """The views, at most `rate_hz` of them a second."""
    while True:
        due_s = time.monotonic() + 1 / rate_hz
        view = next(views, None)
        if view is None:
            return
        yield view
        time.sleep(max(0.0, due_s - time.monotonic()))


def _options(args: argparse.Namespace) -> ViewOptions:
    from_c, to_c = args.band or (args.hotter if args.hotter is not None else -math.inf, math.inf)
    alpha = ALPHA if args.alpha is None else args.alpha
    emphasis = Emphasis(alpha=alpha, from_k=from_c + ZERO_CELSIUS_K, to_k=to_c + ZERO_CELSIUS_K)
    scale = None
    if args.scale is not None:
        scale = TemperatureScale(args.scale[0] + ZERO_CELSIUS_K, args.scale[1] + ZERO_CELSIUS_K)
    mode = ViewMode(args.mode)
    return ViewOptions(mode=mode, camera=args.camera, emphasis=emphasis, scale=scale, marks_hottest=not args.no_marker)


def _celsius(text: str) -> tuple[float, float]:
    """Two temperatures, LOW:HIGH."""
    low, colon, high = text.partition(":")
    try:
        if not colon:
            raise ValueError(text)
        return float(low), float(high)
    except ValueError as exc:
        raise argparse.ArgumentTypeError(f"two temperatures in deg C are LOW:HIGH, got {text!r}") from exc


def _address(text: str) -> tuple[str, int]:
    """PORT on loopback, or HOST:PORT."""
    host, _, port = text.rpartition(":")
    if not port.isdecimal() or int(port) > 65535:
        raise argparse.ArgumentTypeError(f"an address is PORT or HOST:PORT, got {text!r}")
    return host or "127.0.0.1", int(port)


def _rate(text: str) -> float:
    try:
        rate = float(text)
    except ValueError:
        rate = math.nan
    if not 0 < rate <= 1000:
        raise argparse.ArgumentTypeError(f"pictures a second are above 0, at most 1000, got {text!r}")
    return rate


def _parser() -> argparse.ArgumentParser:
    options = parser("cairn telepresence", __doc__)
    options.add_argument("recording", type=Path, help="a recording, a bag, or a folder of frames or clouds")
    where = options.add_mutually_exclusive_group(required=True)
    where.add_argument("--output", type=Path, metavar="PNG|FOLDER", help="one picture, or a folder with one a scan")
    where.add_argument(
        "--serve", type=_address, metavar="[HOST:]PORT", help="stream to browsers (host 127.0.0.1: this machine alone)"
    )
    where.add_argument("--publish", metavar="URL", help="show them on the page of a server: http://HOST:PORT/maps/NAME")
    options.add_argument("--robot", metavar="NAME", help="the robot whose view is published")
    add_token(options)
    options.add_argument("--scan", type=int, metavar="N", help="only this scan, from 0")
    options.add_argument(
        "--mode", choices=[*(mode.value for mode in ViewMode), MAP], default=ViewMode.THERMAL_ON_COLOUR.value
    )
    options.add_argument("--map", metavar="FOLDER", help="a robot's state, a clone, or exported cells")
    options.add_argument("--layer", type=Layer, choices=list(Layer), help="layer of the map (temperature)")
    add_spread_arguments(options)
    options.add_argument("--camera", help="camera of the rig to look through (the first that fits)")
    options.add_argument("--alpha", type=float, help=f"opacity of temperatures over colour, 0 to 1 ({ALPHA:g})")
    painted = options.add_mutually_exclusive_group()
    painted.add_argument("--hotter", type=float, metavar="C", help="paint only hotter places, deg C")
    painted.add_argument("--band", type=_celsius, metavar="LOW:HIGH", help="paint only places between the two, deg C")
    options.add_argument(
        "--scale", type=_celsius, metavar="LOW:HIGH", help="ends of the palette, deg C (first picture)"
    )
    options.add_argument("--no-marker", action="store_true", help="do not mark the hottest place")
    options.add_argument("--rate", type=_rate, default=RATE_HZ, metavar="HZ", help=f"pictures a second ({RATE_HZ:g})")
    add_source_arguments(options, scale=("--pose-scale",))
    return options


def publish_views(pictures: Iterable[Rgb], api: MapApi, map_name: str, branch: str) -> tuple[int, int]:
    """Send pictures, (H, W, 3) uint8, R, G, B, as they come; counts of those sent and of those lost.

    Raises:
        CairnError: the server refuses them: the robot is not registered, or this is not its token.
    """
    latest = Latest()
    sent = lost = 0
    again_s = -math.inf
    for picture in pictures:
        if time.monotonic() < again_s:
            lost += 1
            continue
        latest.show(picture)
        try:
            api.put_view(map_name, branch, latest.jpeg)
            sent += 1
        except UnreachableError as exc:
            lost += 1
            again_s = time.monotonic() + (exc.retry_after_s or 0.0)
            log.warning("picture %d of %s was not sent: %s", sent + lost, branch, exc.message)
    return sent, lost
