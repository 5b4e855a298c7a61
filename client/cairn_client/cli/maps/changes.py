"""List what changed in a map between two times of capture: appeared, gone, moved by a voxel, warmer, colder.

    $ cairn map changes http://127.0.0.1:8750/maps/lab --since 2025-10-09T09:35
    since 2025-10-09 09:36:00 UTC, until now
      appeared     794 voxels    0.099 m3   around 16.71, 8.65, -0.76   from 16.25, 8.25, -1.10 to 17.30, 9.15, -0.55
      gone         598 voxels    0.075 m3   around 15.22, 1.82, 0.33   from 14.80, 1.75, -0.05 to 15.60, 1.90, 0.70
      moved        341 voxels next to a surface that was or is there: mostly poses that are off by a voxel

A voxel counts as changed by a statistical test, not because two readings differ: in a room where nothing moved, noise
makes hundreds of voxels read otherwise. On a map with epochs a time stands for the end of its epoch. On a map without
epochs the answer is made of the commits that are kept; if some are not, it is refused (`not_known`).

Times: 14:05 of today, 2026-11-27T14:05, both UTC, 2026-11-27T14:05+01:00, or seconds since 1970.
"""

import argparse
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime

import numpy as np
import numpy.typing as npt

from cairn_client.cli.arguments import Subparsers, add_map_parser, api_of, say, seconds_of
from cairn_client.cli.robot_arguments import box
from cairn_map.arrays import Floats
from cairn_map.wire.change_messages import CellVoxels, ChangesAnswer

THINGS = ("appeared", "gone", "warmer", "colder")
THINGS_MAX = 20
"""Most things of a way that are listed, the largest first."""


def add_parser(commands: Subparsers) -> None:
    """Add the subcommand."""
    changes = add_map_parser(commands, "changes", _run, text="list what changed in a map between two times")
    changes.description = __doc__
    changes.add_argument("--since", required=True, metavar="TIME", help="end of the time before")
    changes.add_argument("--until", metavar="TIME", help="end of the time after (now)")
    changes.add_argument("--box", type=box, metavar="X0,Y0,Z0,X1,Y1,Z1", help="only in this box, metres")
    changes.add_argument("--json", action="store_true", help="print all voxels as JSON")


def _run(args: argparse.Namespace) -> int:
    api, name = api_of(args.map, args.token)
    with api:
        edge_m = api.map_info(name).geometry.voxel_edge_m
        since_s, until_s = seconds_of(args.since), seconds_of(args.until)
        found = api.changes(name, since_s=since_s, until_s=until_s, box_m=args.box)
    if args.json:
        say(found.model_dump_json())
        return 0
    for line in _lines(found, edge_m):
        say(line)
    return 0


def _lines(found: ChangesAnswer, edge_m: float) -> Iterator[str]:
    yield f"since {_moment(found.since_s)}, until {'now' if found.until_s is None else _moment(found.until_s)}"
    for way in THINGS:
        things = things_of(getattr(found, way), edge_m)
        for thing in things[:THINGS_MAX]:
            low, high = thing.min(axis=0) - edge_m / 2, thing.max(axis=0) + edge_m / 2
            size = f"{len(thing):7} voxels {len(thing) * edge_m**3:8.3f} m3"
            yield f"  {way:<9}{size}   around {_place(thing.mean(axis=0))}   from {_place(low)} to {_place(high)}"
        if len(things) > THINGS_MAX:
            rest = things[THINGS_MAX:]
            yield f"  {way:<9}{sum(map(len, rest)):7} voxels in {len(rest)} smaller places"
    if found.counts.moved:
        yield (
            f"  {'moved':<9}{found.counts.moved:7} voxels next to a surface that was or is there: mostly poses that "
            "are off by a voxel"
        )
    if not any(found.counts.model_dump().values()):
        yield "  nothing changed"


def things_of(cells: Sequence[CellVoxels], edge_m: float) -> list[Floats]:
    """Voxels that hang together by faces, edges or corners: (N, 3) centres of each thing, metres, the largest first."""
    centres = [np.array(cell.centres_m, np.float64).reshape(-1, 3) for cell in cells]
    if not centres:
        return []
    all_m = np.concatenate(centres)
    rows = {voxel: row for row, voxel in enumerate(map(tuple, np.floor(all_m / edge_m).astype(np.int64).tolist()))}
    left, things = set(rows), []
    while left:
        # Flood from one voxel through all its neighbours.
        edge = [left.pop()]
        thing = [rows[edge[0]]]
        while edge:
            x, y, z = edge.pop()
            near = {(x + i, y + j, z + k) for i in (-1, 0, 1) for j in (-1, 0, 1) for k in (-1, 0, 1)} & left
            left -= near
            edge += near
            thing += [rows[voxel] for voxel in near]
        things.append(all_m[np.sort(thing)])
    return sorted(things, key=len, reverse=True)


def _place(point_m: npt.NDArray[np.float64]) -> str:
    return ", ".join(f"{value:.2f}" for value in point_m)


def _moment(time_s: float) -> str:
    return f"{datetime.fromtimestamp(time_s, UTC):%Y-%m-%d %H:%M:%S} UTC"
