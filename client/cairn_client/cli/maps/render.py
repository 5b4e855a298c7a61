"""Draw a map as seen from any pose, or over an image of a robot's camera.

    $ cairn map render lab/ --from 1,2,1.4 --to 4,2.5,1 -o view.png
    view.png: temperature, 640 x 480 pixels, 91% of them on the map, 0.3 to 11.2 m away
    $ cairn map render http://127.0.0.1:8750/maps/lab --from 1,2,1.4 --to 4,2.5,1 --layer colour -o view.png
    $ cairn map render http://127.0.0.1:8750/maps/lab.ground --from -4,-6,7 --to 14,10,0 --layer slope -o ground.png
    $ cairn map render lab/ --from 1,2,1.4 --to 4,2.5,1 --at 14:05 -o then.png       # as it was, in a map with epochs
    $ cairn map render lab/ --over recordings/run1 --scan 12 --camera colour_left -o overlay.png
    overlay.png: temperature over colour_left, scan 12: visible 71%, see-through 22%, map only 3%

A map is the URL of one on a server, the folder that `cairn map export --cells` wrote, or the state folder of a robot
that is not running. Layers: temperature, colour, probability, depth, and age, in seconds before the newest measurement:
a server knows it of everything, a robot's state of commits of its own that it still keeps; of a level layer height,
slope, step and difficulty, for a usual vehicle. The scale is fixed (--low, --high), so that pictures can be compared;
surfaces without a value are grey, and unmapped space is dark.

Over a recorded image the map is compared with the depth that the robot measured there and then. Parts that agree are
painted solid; parts behind the surface that the camera sees, beyond the next free space, in stripes, fainter the
farther away and, where their age is known, the older; parts without live depth in dots. So a robot without a thermal
camera shows temperatures that others measured, also behind things. `cairn telepresence --map` does it live.

--sigma gives the standard deviation of the pose, along and about any one axis: the paint spreads by it, and is withheld
when it could be anywhere. --covariance gives it in full: the lower triangle, row by row, of rx, ry, rz (rad), tx, ty,
tz (m), of the motion by which the true pose differs, in the frame that is posed (--over: the rig, else the camera), as
`robot.align` gives it. --npz writes the values as NumPy arrays, kelvin and metres.
"""

import argparse
import re
from pathlib import Path
from urllib.parse import urlencode

import numpy as np

from cairn_client.cli.arguments import Subparsers, add_at, add_token, api_of, say, seconds_of
from cairn_client.cli.robot_arguments import add_spread_arguments, place, spread_of
from cairn_client.cli.source_arguments import add_source_arguments, asked_source
from cairn_client.folders.map_folder import FolderMap, map_of_folder
from cairn_map.errors import BadInputError
from cairn_map.evidence.grid import cell_of_key
from cairn_map.render.camera_rays import cells_in_sight, with_cells_around
from cairn_map.render.ground_picture import check_layer, snapshot_ground
from cairn_map.render.map_picture import arrays_of, layer_picture, layer_values, npz_of
from cairn_map.render.map_render import MapRenderer
from cairn_map.render.render_picture import SCALES, Layer, Scale, png_of
from cairn_map.render.render_request import RenderRequest, request_from

THREADS = 2


def add_parser(commands: Subparsers) -> None:
    """Add the subcommand."""
    text = "draw a map from a pose, or over a camera's image"
    render = commands.add_parser("render", help=text, description=__doc__)
    render.add_argument("map", metavar="URL|DIR", help="http://HOST:PORT/maps/NAME, or a folder")
    render.add_argument("-o", "--output", type=Path, metavar="FILE", help="PNG")
    render.add_argument(
        "--npz",
        type=Path,
        metavar="FILE",
        help="the values as arrays; with --over also `modes`, the agreement of image and map at each pixel",
    )
    render.add_argument("--from", dest="eye", type=place, metavar="X,Y,Z", help="where the eye is, metres, map frame")
    render.add_argument(
        "--to", dest="target", type=place, metavar="X,Y,Z", help="the place in the middle of the picture"
    )
    render.add_argument("--size", type=_size, default=(640, 480), metavar="WxH", help="pixels (640x480)")
    render.add_argument("--fov", type=float, default=70.0, metavar="DEG", help="field of view across the picture (70)")
    render.add_argument("--layer", type=Layer, choices=list(Layer), default=Layer.TEMPERATURE, help="(temperature)")
    render.add_argument("--low", type=float, help="lower end of the scale (10 deg C)")
    render.add_argument("--high", type=float, help="upper end of the scale (50 deg C)")
    render.add_argument("--range", type=float, default=20.0, metavar="METRES", help="longest range of sight (20)")
    render.add_argument(
        "--over",
        metavar="RECORDING",
        help="draw over a camera's image: of anything that `cairn robot replay` takes, with the same options",
    )
    render.add_argument("--scan", type=int, default=0, metavar="N", help="number of the scan (0)")
    render.add_argument("--camera", metavar="NAME", help="name of the colour camera (the first)")
    add_spread_arguments(render)
    add_at(render)
    add_token(render)
    add_source_arguments(render)
    render.set_defaults(run=_run)


def _run(args: argparse.Namespace) -> int:
    if args.output is None and args.npz is None:
        raise BadInputError("nothing_asked", "say what to write: -o FILE.png, or --npz FILE")
    is_url = args.map.startswith(("http://", "https://"))
    if args.over is None:
        _check_no_source(args)
        if args.eye is None or args.target is None:
            raise BadInputError("nothing_asked", "say from where to look, and at what: --from X,Y,Z --to X,Y,Z")
        request = _request(args)
        if is_url:
            _ask_server(args, request)
        else:
            _look(args, request, _folder_map(args))
        return 0
    if is_url:
        raise BadInputError(
            "bad_option", "an overlay needs the map here: `cairn clone URL DIR`, and then DIR for the URL"
        )
    _draw_over(args, _folder_map(args))
    return 0


def _check_no_source(args: argparse.Namespace) -> None:
    """Refuse options about a recording where none is asked for."""
    names = ("topics", "poses", "depth", "pose", "frames", "up", "T_map_world")
    given = [name for name in names if getattr(args, name) is not None]
    if given:
        raise BadInputError("bad_option", f"--{given[0].replace('_', '-')} is about a recording: give --over RECORDING")


def _folder_map(args: argparse.Namespace) -> FolderMap:
    """The map here; with an age, if that is asked for."""
    found = map_of_folder(Path(args.map), at_s=seconds_of(args.at))
    if args.layer is Layer.AGE and found.ages is None:
        raise BadInputError(
            "no_age",
            f"{args.map} does not say when anything was measured: without epochs, exported cells never do, and a "
            "robot's state only of commits of its own that it still keeps; give the map's URL, whose server knows",
        )
    return found


def _draw_over(args: argparse.Namespace, found: FolderMap) -> None:
    """The map over one image of a recording."""
    from cairn_client.cli.maps.overlay_drawing import MapOverlay, about, modes_of  # fusion, only where it is asked for
    from cairn_fusion.view.overlay import OverlayStyle, with_overlay_legend

    source = asked_source(Path(args.over), args)
    if not 0 <= args.scan < len(source):
        raise BadInputError("no_scan", f"{args.over} has scans 0 to {len(source) - 1}, got {args.scan}")
    style = OverlayStyle(layer=args.layer, scale=_scale(args), range_max_m=args.range)
    overlay = MapOverlay(rig=source.rig, map=found, style=style, camera=args.camera, spread=spread_of(args))
    scan = source.scan(args.scan)
    drawn = overlay.draw(scan)
    picture = with_overlay_legend(drawn.picture, style.colours)
    _write(args, picture, arrays_of(drawn.values, drawn.front, args.layer) | modes_of(drawn))
    about_it = f"{overlay.camera_of(scan)}, scan {args.scan}: {about(drawn)}"
    say(f"{args.output or args.npz}: {args.layer} over {about_it}")


def _look(args: argparse.Namespace, request: RenderRequest, found: FolderMap) -> None:
    snapshot, scale, spread = found.snapshot, request.scale, request.spread
    if snapshot.geometry.is_flat:
        check_layer(snapshot.geometry, request.layer)
        cells = np.array([cell_of_key(key) for key in snapshot.frozen.keys], np.int64).reshape(-1, 3)
        inside = cells_in_sight(
            cells,
            request.sight,
            request.T_map_camera,
            edges_m=snapshot.geometry.cell_edges_m,
            range_max_m=request.range_m,
        )
        ground = snapshot_ground(snapshot, with_cells_around(cells, inside))
        image = ground.seen(request.sight, request.T_map_camera, range_max_m=request.range_m)
        seen, values = image.seen, image.values(request.layer, found.ages)
        picture = layer_picture(values, seen, scale, spread, shade=image.shade)
    else:
        renderer = MapRenderer(threads=THREADS)
        seen = renderer.nearest(snapshot, request.sight, request.T_map_camera, range_max_m=request.range_m)
        values = layer_values(renderer, snapshot, seen, request.layer, found.ages)
        picture = layer_picture(values, seen, scale, spread)
    _write(args, picture, arrays_of(values, seen, request.layer, spread))
    near, far = (float(f(seen.range_m[seen.hit])) if seen.hit.any() else np.nan for f in (np.min, np.max))
    say(
        f"{args.output or args.npz}: {request.layer}, {request.width} x {request.height} pixels, "
        f"{seen.hit.mean():.0%} of them on the map, {near:.1f} to {far:.1f} m away"
    )


def _ask_server(args: argparse.Namespace, request: RenderRequest) -> None:
    api, name = api_of(args.map, args.token)
    with api:
        for path, form in ((args.output, "png"), (args.npz, "npz")):
            if path is not None:
                asked = request.model_copy(update={"format": form})
                query = urlencode(asked.model_dump(mode="json", exclude_none=True))
                path.write_bytes(api.probe(f"/maps/{name}/main/render?{query}").body)
                say(f"{path}: {request.layer}, {request.width} x {request.height} pixels, drawn by the server")


def _write(
    args: argparse.Namespace, picture: "np.ndarray[tuple[int, ...], np.dtype[np.uint8]]", arrays: object
) -> None:
    if args.output is not None:
        args.output.write_bytes(png_of(picture))
    if args.npz is not None:
        args.npz.write_bytes(npz_of(arrays))  # type: ignore[arg-type]


def _request(args: argparse.Namespace) -> RenderRequest:
    width, height = args.size
    if not 1 <= args.fov < 170:
        raise BadInputError("bad_option", f"--fov must be 1 to 170 degrees, got {args.fov:g}")
    focal_px = width / 2 / float(np.tan(np.radians(args.fov) / 2))
    scale = _scale(args)
    about = {"width": width, "height": height, "focal_px": focal_px, "layer": args.layer, "range_m": args.range}
    if args.at is not None:
        about["at"] = repr(seconds_of(args.at))
    if args.covariance is not None:
        about["covariance_lower"] = ",".join(f"{number!r}" for number in args.covariance)
    else:
        about |= {"sigma_m": args.sigma[0], "sigma_rad": float(np.radians(args.sigma[1]))}
    return request_from(args.eye, args.target, low=scale.low, high=scale.high, **about)


def _scale(args: argparse.Namespace) -> Scale:
    usual = SCALES[args.layer]
    low, high = (own if own is not None else common for own, common in ((args.low, usual.low), (args.high, usual.high)))
    return Scale(args.layer, low, high)


def _size(text: str) -> tuple[int, int]:
    found = re.fullmatch(r"(\d{1,5})x(\d{1,5})", text)
    if not found:
        raise argparse.ArgumentTypeError(f"a size is WIDTHxHEIGHT in pixels, such as 640x480; got {text!r}")
    return int(found[1]), int(found[2])
