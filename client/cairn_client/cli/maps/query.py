"""Ask a map on a server, or in a folder, without a robot.

    $ cairn map export http://127.0.0.1:8750/maps/lab --cells lab/
    $ cairn map query lab/ points 1.02,2.5,0.4 -0.3,0,1
         x m     y m     z m  state     probability  hits misses  colour          intensity       temperature
       1.020   2.500   0.400  occupied         0.97     9      0  (180 92 40)     1210            57.3 C +- 1.1
      -0.300   0.000   1.000  unknown             -     -      -  -               -               -
    $ cairn map query lab/ ray 1,2,0.4 0,1,0 --range 10      # the first obstacle, and its distance
    $ cairn map query lab/ nearest 1,2,0.4 --radius 3         # the nearest occupied voxel (--unknown: unknown)
    $ cairn map query lab/ hottest --count 5                  # where it is hot, hit twice or on a surface first
    $ cairn map query lab/ slice 0.5                          # a horizontal layer: # occupied, . free
    $ cairn map query lab/ height --box=-5,-5,0,5,5,2         # the highest surface of each column, metres
    $ cairn map query http://127.0.0.1:8750/maps/lab.ground elevation --png ground.png   # of a level layer
    $ cairn map query lab/ --at 14:05 nearest 1,2,0.4         # as it was then, in a map with epochs

A map is a URL, or a folder: one of `cairn map export --cells`, a clone, or the state folder of a robot that is not
running. Of a URL those cells are downloaded that points, rays and nearest voxels need, and all for `slice`, `height`
and --at with `hottest`; else the server itself finds the hottest. All lengths are metres in the map's frame,
temperatures degrees Celsius here and kelvin in JSON; unknown values are `-`, in JSON null. Of a map with epochs, points
have the time at which they were seen last, too, and readings the count of their samples and the time of the newest: the
beginning of its epoch, UTC.
Of a map with layers (`cairn map layer`) points, rays, nearest voxels, slices and heights are answered by the finest
layer that knows each place, which is named; the hottest voxels and --unknown are of its first one, the elevation is of
a level. --layer NAME asks one layer, as does its URL, MAP.LAYER. In a layer of classes points have the class with the
most votes, marked as unsure where it leads by less than two; in JSON `mean` is its number.
--json prints JSON for programs; `slice` and `height` then give all pixels, rows along y and columns along x.
"""

import argparse
import json
import math
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from cairn_client.cli.arguments import Subparsers, add_at, add_token, api_of, say, seconds_of
from cairn_client.cli.robot_arguments import box, place
from cairn_client.folders.map_folder import layers_part, open_map, open_part
from cairn_client.folders.needed_cells import Needs, along_ray, near_points
from cairn_client.http.map_url import layer_url, split_map_url
from cairn_map.arrays import Floats
from cairn_map.commits.ids import map_of_layer
from cairn_map.epochs.layer import EVIDENCE
from cairn_map.errors import BadInputError
from cairn_map.evidence.channels import ChannelKind
from cairn_map.evidence.voxels import Reading
from cairn_map.queries.distance_queries import Nearest, RayEnds
from cairn_map.queries.layers.layered_rays import LayeredEnds
from cairn_map.queries.layers.layered_snapshot import LayeredSnapshot
from cairn_map.queries.level.elevation import CLEARANCE_M, Vehicle
from cairn_map.queries.map_snapshot import MapSnapshot
from cairn_map.queries.occupancy_states import State
from cairn_map.queries.region_queries import MapImage
from cairn_map.render.elevation_picture import elevation_npz, elevation_png
from cairn_map.wire.hottest_messages import HOTTEST_MAX

ZERO_CELSIUS_K = 273.15
DATED_WIDTH = len("300.0 C +- 10.0 (1000 of 2026-01-31T12:00Z)")
WIDTH = 100
"""Widest slice on a terminal, in characters."""
SURENESS = f"{'probability':>12}{'hits':>6}{'misses':>7}"
"""Heads of the columns that say how sure a voxel is."""
HOTTEST_HEAD = f"{'x m':>8}{'y m':>8}{'z m':>8}  {SURENESS}  temperature"
NOTHING_HOT = "no occupied voxel has a temperature"
SIGNS = {State.UNKNOWN: " ", State.FREE: ".", State.OCCUPIED: "#"}
Answer = Callable[[MapSnapshot, argparse.Namespace], tuple[Any, list[str]]]
"""Answer to a question, as JSON and as lines for people."""
LayeredAnswer = Callable[[LayeredSnapshot, argparse.Namespace], tuple[Any, list[str]]]
"""Answer of all layers of a map together."""
Needed = Callable[[argparse.Namespace], Needs | None]
"""Cells of a server's map that a question needs; None: all."""


def add_parser(commands: Subparsers) -> None:
    """Add the subcommand, each of whose questions is a subcommand in turn."""
    text = "ask a map on a server or in a folder"
    query = commands.add_parser("query", help=text, description=__doc__)
    query.add_argument("map", metavar="URL|DIR", help="http://HOST:PORT/maps/NAME, cells, a clone, or a robot's state")
    add_token(query)
    add_at(query)
    query.set_defaults(run=_run)
    questions = query.add_subparsers(required=True, metavar="QUESTION")

    def question(
        name: str, text: str, answer: Answer, needs: Needed = _all, layered: LayeredAnswer | None = None
    ) -> argparse.ArgumentParser:
        added = questions.add_parser(name, help=text, description=text)
        added.add_argument("--json", action="store_true", help="print JSON")
        whole = "the first" if layered is None else "the finest that knows each place"
        added.add_argument("--layer", metavar="NAME", help=f"only this layer of the map ({whole})")
        added.set_defaults(answer=answer, needs=needs, layered=layered)
        return added

    points = question("points", "state, probability and readings at points", _points, _at_points, _points_of_layers)
    points.add_argument("points", nargs="+", type=place, metavar="X,Y,Z", help="metres, map frame")
    ray = question("ray", "the first occupied voxel along a ray", _ray, _on_ray, _ray_of_layers)
    ray.add_argument("origin", type=place, metavar="X,Y,Z", help="metres, map frame")
    ray.add_argument("direction", type=place, metavar="DX,DY,DZ", help="direction, of any length")
    ray.add_argument(
        "--range", type=float, default=math.inf, metavar="METRES", help="longest distance (as far as the map goes)"
    )
    nearest = question("nearest", "the nearest occupied voxel of points", _nearest, _within_radius, _nearest_of_layers)
    nearest.add_argument("points", nargs="+", type=place, metavar="X,Y,Z", help="metres, map frame")
    nearest.add_argument("--radius", type=float, default=5.0, metavar="METRES", help="longest distance (5)")
    nearest.add_argument("--unknown", action="store_true", help="the nearest unknown voxel instead")
    hottest = question("hottest", "the occupied voxels with the highest temperature", _hottest)
    hottest.add_argument("--count", type=int, default=10, help="how many (10)")
    layer = question("slice", "the horizontal layer of voxels at a height", _slice, layered=_slice)
    layer.add_argument("z", type=float, metavar="Z", help="metres, map frame")
    layer.add_argument("--what", default="state", help="state, probability, log_odds or a channel's name (state)")
    height = question("height", "the highest occupied surface of each column", _height, layered=_height)
    elevation = question("elevation", "the surface of a level layer: heights, slopes, steps, obstacles", _elevation)
    elevation.add_argument("--png", type=Path, metavar="FILE", help="picture: green easy, red hard, dark red too much")
    elevation.add_argument("--npz", type=Path, metavar="FILE", help="all of it as NumPy arrays")
    elevation.add_argument(
        "--clearance", type=float, default=CLEARANCE_M, metavar="METRES", help=f"the vehicle's height ({CLEARANCE_M})"
    )
    elevation.add_argument("--step", type=float, metavar="METRES", help="the vehicle's highest step (0.25)")
    elevation.add_argument("--slope", type=float, metavar="DEGREES", help="the vehicle's steepest slope (30)")
    for limited in (hottest, layer, height, elevation):
        limited.add_argument("--box", type=box, metavar="X0,Y0,Z0,X1,Y1,Z1", help="only in this box, metres")


def _run(args: argparse.Namespace) -> int:
    answer: Answer = args.answer
    is_server = "://" in args.map
    if args.layer is not None:
        if not is_server:
            raise BadInputError("bad_option", f"{args.map} has one layer: for --layer take the map's own URL")
        args.map = layer_url(args.map, args.layer)
    if is_server and answer is _hottest and args.at is None:
        found, lines = _hottest_of_server(args)
    elif is_server and args.layer is None and map_of_layer(split_map_url(args.map)[1]) is None and _is_layered(args):
        found, lines = _of_layers(args)
    else:
        found, lines = answer(_opened(args) if is_server else open_map(args.map, at_s=seconds_of(args.at)), args)
    for line in [json.dumps(found)] if args.json else lines:
        say(line)
    return 0


def _opened(args: argparse.Namespace) -> MapSnapshot:
    """A server's map, as far as the question needs it."""
    token, at_s = args.token.of(args.map), seconds_of(args.at)
    needs: Needs | None = args.needs(args)
    if needs is None:
        return open_map(args.map, token=token, at_s=at_s)
    return open_part(args.map, needs, token=token, at_s=at_s)


def _is_layered(args: argparse.Namespace) -> bool:
    """True if all layers of a map can answer together."""
    return args.layered is not None and not (args.answer is _nearest and args.unknown)


def _of_layers(args: argparse.Namespace) -> tuple[Any, list[str]]:
    """Answer of a server's map: of all its layers where it has several."""
    token, at_s = args.token.of(args.map), seconds_of(args.at)
    layers = layers_part(args.map, args.needs(args), token=token, at_s=at_s)
    if len(layers.names) == 1:
        answer: Answer = args.answer
        return answer(layers[EVIDENCE], args)
    layered: LayeredAnswer = args.layered
    return layered(layers, args)


def _all(args: argparse.Namespace) -> None:
    return None


def _at_points(args: argparse.Namespace) -> Needs:
    return near_points(args.points)


def _within_radius(args: argparse.Namespace) -> Needs:
    return near_points(args.points, radius_m=args.radius)


def _on_ray(args: argparse.Namespace) -> Needs:
    return along_ray(args.origin, args.direction, range_m=args.range)


def _points(snapshot: MapSnapshot, args: argparse.Namespace) -> tuple[Any, list[str]]:
    points = np.array(args.points)
    states, probability = snapshot.state_at(points), snapshot.probability_at(points)
    counts = snapshot.counts_at(points).tolist()
    readings = {
        c.name: _dated(snapshot, points, snapshot.reading_at(points, c.name)) for c in snapshot.geometry.channels
    }
    widths = {name: max(DATED_WIDTH if snapshot.has_times else 14, len(name)) for name in readings}
    # A map with epochs says when each voxel was seen last.
    seen_s = snapshot.seen_at(points).tolist() if snapshot.has_times else None
    widths |= {"seen": len("2026-01-31T12:00Z")} if seen_s else {}
    lines = [f"{'x m':>8}{'y m':>8}{'z m':>8}  {'state':<9}{SURENESS}" + _columns(widths, widths.keys())]
    found = []
    for n, (x, y, z) in enumerate(args.points):
        state, p = State(int(states[n])).name.lower(), _or_none(probability[n])
        shown = {name: _shown(reading, n) for name, reading in readings.items()}
        times = {"seen_s": _or_none(seen_s[n])} if seen_s else {}
        shown |= {"seen": _minute(seen_s[n])} if seen_s else {}
        text = f"{x:8.3f}{y:8.3f}{z:8.3f}  {state:<9}{_sureness(p, *counts[n])}"
        lines.append(text + _columns(widths, shown.values()))
        values = {name: _value(reading, n) for name, reading in readings.items()}
        sure = {"probability": p, "hits": counts[n][0], "misses": counts[n][1]}
        found.append({"point_m": [x, y, z], "state": state, **sure, **times, "readings": values})
    return found, lines


def _points_of_layers(layers: LayeredSnapshot, args: argparse.Namespace) -> tuple[Any, list[str]]:
    """State and readings of points, each in the finest layer that knows it; as JSON and as lines."""
    # What no layer knows is said of the one that the map began with.
    of_layer: dict[str, list[int]] = {name: [] for name in layers.names}
    for n, name in enumerate(layers.names_at(args.points)):
        of_layer[name or EVIDENCE].append(n)
    found: list[Any] = [None] * len(args.points)
    lines: list[str] = []
    for name, places in of_layer.items():
        if not places:
            continue
        asked = argparse.Namespace(**vars(args) | {"points": [args.points[n] for n in places]})
        answers, said = _points(layers[name], asked)
        for n, answer in zip(places, answers, strict=True):
            found[n] = {"layer": name, **answer}
        lines += [f"layer {name}, voxels of {layers[name].geometry.voxel_edge_m:g} m:", *said]
    return found, lines


def _ray(snapshot: MapSnapshot, args: argparse.Namespace) -> tuple[Any, list[str]]:
    ends = snapshot.cast_rays([args.origin], [args.direction], max_range_m=args.range)
    return _end_of_ray(ends, args, {"voxel": ends.voxels[0].tolist() if ends.hit[0] else None})


def _ray_of_layers(layers: LayeredSnapshot, args: argparse.Namespace) -> tuple[Any, list[str]]:
    """End of a ray through each place as the finest layer that knows it has it; as JSON and as a line."""
    ends = layers.cast_rays([args.origin], [args.direction], max_range_m=args.range)
    return _end_of_ray(ends, args, {"layer": ends.names[0]})


def _end_of_ray(ends: RayEnds | LayeredEnds, args: argparse.Namespace, where: dict[str, Any]) -> tuple[Any, list[str]]:
    """The end of one ray, with what says where it is: its voxel, or its layer."""
    if not ends.hit[0]:
        far = "as far as the map goes" if math.isinf(args.range) else f"within {args.range:g} m"
        return {"hit": False, "distance_m": None, **where, "point_m": None}, [f"nothing is in the way {far}"]
    distance_m, point_m = float(ends.distance_m[0]), ends.points_m[0].tolist()
    place = ", ".join(f"{value:.3f}" for value in point_m)
    found = {"hit": True, "distance_m": distance_m, **where, "point_m": point_m}
    of_layer = f", layer {where['layer']}" if "layer" in where else ""
    return found, [f"occupied after {distance_m:.3f} m, at ({place}){of_layer}"]


def _nearest(snapshot: MapSnapshot, args: argparse.Namespace) -> tuple[Any, list[str]]:
    ask = snapshot.nearest_unknown if args.unknown else snapshot.nearest_occupied
    what = "unknown" if args.unknown else "occupied"
    return _nearest_of(ask(args.points, radius_m=args.radius), args, what)


def _nearest_of_layers(layers: LayeredSnapshot, args: argparse.Namespace) -> tuple[Any, list[str]]:
    """Nearest occupied voxel of all layers to each point; as JSON and as lines."""
    nearest = layers.nearest_occupied(args.points, radius_m=args.radius)
    found, lines = _nearest_of(nearest, args, "occupied")
    found = [{**each, "layer": name} for each, name in zip(found, nearest.names, strict=True)]
    said = zip(lines, nearest.names, strict=True)
    return found, [f"{line}, layer {name}" if name is not None else line for line, name in said]


def _nearest_of(
    nearest: Nearest | LayeredEnds, args: argparse.Namespace, what: str
) -> tuple[list[dict[str, Any]], list[str]]:
    found, lines = [], []
    asked = zip(args.points, nearest.distance_m.tolist(), nearest.points_m.tolist(), strict=True)
    for (x, y, z), distance_m, nearest_m in asked:
        there = nearest_m if math.isfinite(distance_m) else None
        found.append({"point_m": [x, y, z], "distance_m": _or_none(distance_m), "nearest_m": there})
        text = f"{distance_m:.3f} m to {what} space" if math.isfinite(distance_m) else f"none within {args.radius:g} m"
        lines.append(f"{x:8.3f}{y:8.3f}{z:8.3f}  {text}")
    return found, lines


def _hottest(snapshot: MapSnapshot, args: argparse.Namespace) -> tuple[Any, list[str]]:
    voxels = snapshot.hottest(args.count, box_m=_corners(args))
    reading = voxels.of_kind(ChannelKind.TEMPERATURE)
    assert reading is not None  # noqa: S101 - or the snapshot had refused
    reading = _dated(snapshot, voxels.centres_m, reading)
    found, lines = [], [HOTTEST_HEAD]
    for n, (x, y, z) in enumerate(voxels.centres_m.tolist()):
        p, (hits, misses) = float(voxels.probability[n]), voxels.counts[n].tolist()
        sure = {"probability": p, "hits": hits, "misses": misses}
        found.append({"point_m": [x, y, z], **sure, **(_value(reading, n) or {})})
        lines.append(f"{x:8.3f}{y:8.3f}{z:8.3f}  {_sureness(p, hits, misses)}  {_shown(reading, n)}")
    return found, lines if found else [NOTHING_HOT]


def _hottest_of_server(args: argparse.Namespace) -> tuple[Any, list[str]]:
    """Hottest voxels of a server's map, of which it reads the hottest cells alone; as JSON and as lines."""
    if not 1 <= args.count <= HOTTEST_MAX:
        raise BadInputError("bad_range", f"a server names 1 to {HOTTEST_MAX} voxels, not {args.count}")
    api, name = api_of(args.map, args.token)
    with api:
        answer = api.hottest(name, count=args.count, box_m=args.box)
    lines = [HOTTEST_HEAD]
    for voxel in answer.voxels:
        x, y, z = voxel.point_m
        text = f"{x:8.3f}{y:8.3f}{z:8.3f}  {_sureness(voxel.probability, voxel.hits, voxel.misses)}"
        whence = "" if voxel.measured_s is None else _whence(voxel.weight, voxel.measured_s)
        lines.append(f"{text}  {_shown_kelvin(voxel.mean, voxel.sigma)}{whence}")
    lines = lines if answer.voxels else [NOTHING_HOT]
    if not answer.complete:
        lines.append("(the server's search ended at its bounds, there may be hotter places: ask for a --box)")
    return [voxel.model_dump(mode="json") for voxel in answer.voxels], lines


def _slice(snapshot: MapSnapshot | LayeredSnapshot, args: argparse.Namespace) -> tuple[Any, list[str]]:
    image = snapshot.layer_at(args.z, args.what, box_m=_corners(args))
    drawn = _drawn(image.values) if args.what == "state" else _span(image.values, args.what)
    return _image_json(image), [_image_head(image), *drawn]


def _height(snapshot: MapSnapshot | LayeredSnapshot, args: argparse.Namespace) -> tuple[Any, list[str]]:
    image = snapshot.height_map(box_m=_corners(args))
    return _image_json(image), [_image_head(image), *_span(image.values, "height in m")]


def _elevation(snapshot: MapSnapshot, args: argparse.Namespace) -> tuple[Any, list[str]]:
    limits = {"step_max_m": args.step, "slope_max_rad": None if args.slope is None else math.radians(args.slope)}
    vehicle = Vehicle(**{name: value for name, value in limits.items() if value is not None})
    ground = snapshot.elevation(box_m=_corners(args), clearance_m=args.clearance)
    known = np.isfinite(ground.height_m)
    passable = ground.difficulty(vehicle)[known] <= 1
    for path, made in ((args.png, elevation_png), (args.npz, elevation_npz)):
        if path is not None:
            try:
                path.write_bytes(made(ground, vehicle))
            except OSError as exc:
                raise BadInputError("bad_output", f"cannot write {path}: {exc.strerror}") from exc
    H, W = known.shape
    lines = [f"{W} x {H} columns of {ground.edge_m:g} m, {int(known.sum())} known, from {_place(ground.origin_m)}"]
    if known.any():
        low, high = ground.height_m[known].min(), ground.height_m[known].max()
        lines.append(f"height {low:.2f} to {high:.2f} m, +- {np.median(ground.sigma_m[known]):.3f} m in the median")
        lines.append(f"{passable.mean():.0%} of the known columns are passable")
    found = {name: _numbers(values) for name, values in ground.arrays().items()}
    return found | {"difficulty": _numbers(ground.difficulty(vehicle))}, lines


def _place(origin_m: tuple[float, float]) -> str:
    return f"x {origin_m[0]:g} m, y {origin_m[1]:g} m"


def _numbers(values: npt.NDArray[Any]) -> Any:
    """An array as nested lists for JSON, unknown numbers null."""
    found = values.astype(object)
    found[~np.isfinite(values)] = None
    return found.tolist()


def _corners(args: argparse.Namespace) -> npt.NDArray[np.float64] | None:
    return None if args.box is None else np.array(args.box).reshape(2, 3)


def _or_none(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _minute(time_s: float) -> str:
    """Time in UTC to the minute."""
    return f"{datetime.fromtimestamp(time_s, UTC):%Y-%m-%dT%H:%MZ}" if math.isfinite(time_s) else "-"


def _sureness(p: float | None, hits: int, misses: int) -> str:
    """Columns of probability and counts."""
    if p is None:
        return f"{'-':>12}{'-':>6}{'-':>7}"
    return f"{p:12.2f}{hits:6}{misses:7}"


def _value(reading: Reading, n: int) -> dict[str, Any] | None:
    """Reading of one voxel in a channel, with its unit; None if there is none."""
    if not reading.weight[n]:
        return None
    value = {"mean": reading.mean[n].tolist(), "unit": reading.channel.unit, "weight": int(reading.weight[n])}
    value |= {} if reading.measured_s is None else {"measured_s": _or_none(reading.measured_s[n])}
    if reading.unsure is not None:
        value |= {"class": reading.name_at(n), "unsure": bool(reading.unsure[n])}
    if reading.spread is None or reading.sigma is None:
        return value
    return value | {"spread": float(reading.spread[n]), "sigma": float(reading.sigma[n])}


def _shown_kelvin(mean: float, sigma: float) -> str:
    return f"{mean - ZERO_CELSIUS_K:.1f} C +- {sigma:.1f}"


def _dated(snapshot: MapSnapshot, points_m: Floats, reading: Reading) -> Reading:
    """The reading at (N, 3) points, in a map with epochs with the times of its samples."""
    measured_s = snapshot.measured_at(points_m, reading.channel.name) if snapshot.has_times else None
    return replace(reading, measured_s=measured_s)


def _shown(reading: Reading, n: int) -> str:
    if not reading.weight[n]:
        return "-"
    measured_s = reading.measured_s
    return _shown_mean(reading, n) + ("" if measured_s is None else _whence(int(reading.weight[n]), measured_s[n]))


def _whence(samples: int, measured_s: float) -> str:
    """Count of a reading's samples, and time of the newest."""
    return f" ({samples} of {_minute(measured_s)})" if math.isfinite(measured_s) else f" ({samples})"


def _shown_mean(reading: Reading, n: int) -> str:
    mean = reading.mean[n]
    if reading.unsure is not None:
        return f"{reading.name_at(n)}{' (unsure)' if reading.unsure[n] else ''}"
    if reading.channel.kind is ChannelKind.COLOUR:
        return "({:.0f} {:.0f} {:.0f})".format(*mean)
    if reading.channel.kind is ChannelKind.TEMPERATURE and reading.sigma is not None:
        return _shown_kelvin(float(mean), float(reading.sigma[n]))
    return f"{mean:.4g} {reading.channel.unit}"


def _columns(widths: dict[str, int], texts: Any) -> str:
    return "".join(f"  {text:<{width}}" for width, text in zip(widths.values(), texts, strict=True)).rstrip()


def _image_json(image: MapImage) -> dict[str, Any]:
    values = image.values.astype(object)
    values[~np.isfinite(image.values.astype(np.float64))] = None
    return {"origin_m": list(image.origin_m), "edge_m": image.edge_m, "values": values.tolist()}


def _image_head(image: MapImage) -> str:
    H, W = image.values.shape[:2]
    x, y = (value - image.edge_m / 2 for value in image.origin_m)
    return f"x {x:.2f} to {x + W * image.edge_m:.2f} m, y {y:.2f} to {y + H * image.edge_m:.2f} m"


def _span(values: npt.NDArray[np.number], what: str) -> list[str]:
    known = values[np.isfinite(values)]
    text = f"{known.min():.4g} to {known.max():.4g}" if known.size else "nothing is known"
    return [f"{what}: {text} ({known.size} of {values.size} values known; --json prints them)"]


def _drawn(states: npt.NDArray[np.number]) -> list[str]:
    """The layer in characters, y upwards; of several voxels, the one that says most: occupied, then free."""
    H, W = states.shape
    step = max(1, -(-W // WIDTH))
    rows = [states[y : y + 2 * step, :] for y in range(0, H, 2 * step)]  # a character is twice as high as wide
    worst = [[int(row[:, x : x + step].max()) for x in range(0, W, step)] for row in rows]
    return ["".join(SIGNS[State(state)] for state in row).rstrip() for row in reversed(worst)]
