"""List the hot spots of a map: connected voxels above a temperature, the hottest first.

    $ cairn map hotspots http://127.0.0.1:8750/maps/lab --over 40
      1   63.3 C +- 1.2  at 14.44, 1.48, 1.48 m, 2.8 m over the floor, 5 voxels  mole, 2026-11-27 14:05:10 UTC
      2   54.1 C +- 1.0  at 6.10, -2.02, -0.38 m, 0.9 m over the floor, 131 voxels  wren, 2026-11-27 13:58:41 UTC
    2 hot spots
    $ cairn map hotspots http://127.0.0.1:8750/maps/lab --geojson spots.geojson

The map is a URL, whose server keeps the spots of each cell and reads only cells that changed, or a folder as
`cairn map query` takes it. A spot of which no voxel was hit twice, and which has less than four, is listed last, with a
`?`: it may be a ghost behind an edge. Who and when are those of the newest commit that measured the hottest voxel, as
far as a server has looked for it: ask again for more. Lengths and coordinates are metres in the map's frame, also in
the GeoJSON, which is not in degrees.
"""

import argparse
import csv
import io
import json
import math
import time
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from cairn_client.cli.arguments import Subparsers, add_token, api_of, say
from cairn_client.cli.robot_arguments import box
from cairn_client.folders.map_folder import open_map
from cairn_client.sync.responses import one_line
from cairn_map.errors import BadInputError
from cairn_map.evidence.grid import Geometry, centres_of_voxels
from cairn_map.queries.hot_spots import VOXELS_MIN, WARM_K, Spots
from cairn_map.wire.hot_spot_messages import SPOTS_MAX, HotSpotEntry

ZERO_CELSIUS_K = 273.15
WAIT_S = 60.0
"""Time for which a server is asked again that has not read all of a map yet."""
COLUMNS = (
    "number", "celsius", "sigma", "x_m", "y_m", "z_m", "over_floor_m", "voxels", "confirmed",
    "low_x_m", "low_y_m", "low_z_m", "high_x_m", "high_y_m", "high_z_m", "commit", "captured_utc",
)  # fmt: skip


def add_parser(commands: Subparsers) -> None:
    """Add the subcommand."""
    text = "list the hot spots of a map"
    spots = commands.add_parser("hotspots", help=text, description=__doc__)
    spots.add_argument("map", metavar="URL|DIR", help="http://HOST:PORT/maps/NAME, cells, a clone, or a robot's state")
    add_token(spots)
    over_c = WARM_K - ZERO_CELSIUS_K
    spots.add_argument(
        "--over", type=float, default=over_c, metavar="CELSIUS", help=f"least temperature of their voxels ({over_c:g})"
    )
    spots.add_argument("--min-voxels", type=int, default=VOXELS_MIN, metavar="N", help=f"least size ({VOXELS_MIN})")
    spots.add_argument("--count", type=int, default=50, metavar="N", help="most of them (50)")
    spots.add_argument("--box", type=box, metavar="X0,Y0,Z0,X1,Y1,Z1", help="only those in this box, metres")
    form = spots.add_mutually_exclusive_group()
    form.add_argument("--json", action="store_true", help="print JSON")
    form.add_argument("--csv", type=Path, metavar="FILE", help="write a table instead")
    form.add_argument("--geojson", type=Path, metavar="FILE", help="write GeoJSON in the map's frame instead")
    spots.set_defaults(run=_run)


def _run(args: argparse.Namespace) -> int:
    if not 1 <= args.count <= SPOTS_MAX or args.min_voxels < 1 or not math.isfinite(args.over):
        raise BadInputError(
            "bad_range", f"--count is 1 to {SPOTS_MAX}, --min-voxels 1 or more, --over a temperature in Celsius"
        )
    spots, note = _of_server(args) if "://" in args.map else (_of_folder(args), None)
    if args.json:
        say(json.dumps([spot.model_dump(mode="json") for spot in spots]))
    elif args.csv is not None:
        args.csv.write_text(csv_of(spots), encoding="utf-8")
        say(f"{args.csv}: {len(spots)} hot spots")
    elif args.geojson is not None:
        args.geojson.write_text(json.dumps(geojson_of(spots)), encoding="utf-8")
        say(f"{args.geojson}: {len(spots)} hot spots, in the map's frame")
    else:
        for number, spot in enumerate(spots, 1):
            say(line_of(number, spot))
        say(note or (f"(nothing is warmer than {args.over:g} C)" if not spots else f"{len(spots)} hot spots"))
    return 0


def _of_server(args: argparse.Namespace) -> tuple[list[HotSpotEntry], str | None]:
    """Spots that a server lists, and what is to be said of the list."""
    api, name = api_of(args.map, args.token)
    ask = partial(api.hot_spots, name, min_voxels=args.min_voxels, count=args.count, box_m=args.box)
    over_k, end_s = max(0.0, args.over + ZERO_CELSIUS_K), time.monotonic() + WAIT_S
    with api:
        answer = ask(over_k=over_k)
        # What was read is kept: each answer goes on from the one before.
        while not answer.complete and time.monotonic() < end_s:
            answer = ask(over_k=over_k)
    if not answer.complete:
        return answer.spots, "(the server has not read all of the map yet: ask again, it goes on from there)"
    if answer.total > len(answer.spots):
        return answer.spots, f"{len(answer.spots)} of {answer.total} hot spots; --count N lists more"
    return answer.spots, None


def _of_folder(args: argparse.Namespace) -> list[HotSpotEntry]:
    snapshot = open_map(args.map)
    box_m = None if args.box is None else np.array(args.box).reshape(2, 3)
    found = snapshot.hot_spots(over_k=args.over + ZERO_CELSIUS_K, voxels_min=args.min_voxels, box_m=box_m)
    return [_message(found, n, snapshot.geometry) for n in range(min(args.count, len(found)))]


def _message(spots: Spots, n: int, geometry: Geometry) -> HotSpotEntry:
    """A spot as a server states it, as far as a folder knows it."""
    kelvin, measured_s, (hits, misses) = float(spots.kelvin[n]), float(spots.measured_s[n]), spots.counts[n].tolist()
    corners = np.stack([spots.low[n], spots.high[n] + 1]) * geometry.voxel_edge_um / 1e6
    low_m, high_m = np.round(corners, 6).tolist()
    return HotSpotEntry(
        voxel=tuple(spots.peaks[n].tolist()),
        point_m=tuple(np.round(centres_of_voxels(spots.peaks[n], geometry), 6).tolist()),
        kelvin=round(kelvin, 3),
        celsius=round(kelvin - ZERO_CELSIUS_K, 2),
        sigma=round(float(spots.sigma[n]), 4),
        weight=int(spots.weight[n]),
        hits=hits,
        misses=misses,
        confirmed=bool(spots.confirmed[n]),
        voxels=int(spots.voxels[n]),
        low_m=tuple(low_m),
        high_m=tuple(high_m),
        over_floor_m=None,
        measured_s=None if math.isnan(measured_s) else measured_s,
    )


def line_of(number: int, spot: HotSpotEntry) -> str:
    """A spot as a line for people."""
    x, y, z = spot.point_m
    heat = f"{spot.celsius:.1f} C +- {spot.sigma:.1f}{' ' if spot.confirmed else '?'}"
    height = "" if spot.over_floor_m is None else f", {spot.over_floor_m:.1f} m over the floor"
    voxels = f"{spot.voxels} voxel{'' if spot.voxels == 1 else 's'}"
    line = f"{number:3}  {heat:>15} at {x:.2f}, {y:.2f}, {z:.2f} m{height}, {voxels}"
    if spot.commit is not None:
        line += f"  {one_line(spot.commit.split('.')[0])}, {_utc(spot) or 'at an unknown time'}"
    return line


def csv_of(spots: list[HotSpotEntry]) -> str:
    """Spots as a table, RFC 4180."""
    text = io.StringIO()
    table = csv.writer(text)
    table.writerow(COLUMNS)
    for number, spot in enumerate(spots, 1):
        height = "" if spot.over_floor_m is None else spot.over_floor_m
        table.writerow([
            number, spot.celsius, spot.sigma, *spot.point_m, height, spot.voxels, int(spot.confirmed),
            *spot.low_m, *spot.high_m, spot.commit or "", _utc(spot),
        ])  # fmt: skip
    return text.getvalue()


def geojson_of(spots: list[HotSpotEntry]) -> dict[str, Any]:
    """Spots as points of a GeoJSON collection, whose coordinates are metres in the map's frame."""
    features = [
        {
            "type": "Feature",
            "geometry": {"type": "Point", "coordinates": list(spot.point_m)},
            "properties": {"number": number, **spot.model_dump(mode="json", exclude={"point_m"})},
        }
        for number, spot in enumerate(spots, 1)
    ]
    return {"type": "FeatureCollection", "coordinates": "metres in the map's frame, not degrees", "features": features}


def _utc(spot: HotSpotEntry) -> str:
    """Time of the last scan of the commit that measured it, UTC; empty: unknown."""
    if spot.captured_s is None:
        return ""
    return f"{datetime.fromtimestamp(spot.captured_s[1], UTC):%Y-%m-%d %H:%M:%S} UTC"
