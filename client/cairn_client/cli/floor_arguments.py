"""Options that name a storey and the robot that drives on it, and the ground that they choose."""

import argparse
import re

from cairn_client.cli.arguments import say
from cairn_map.queries.floor_grid import Band
from cairn_map.queries.map_snapshot import MapSnapshot

HEIGHTS = re.compile(r"\s*(\d+(?:\.\d*)?),(\d+(?:\.\d*)?)")


def add_floor_arguments(parser: argparse.ArgumentParser) -> None:
    """Add `--ground` and `--band`."""
    floor = parser.add_argument_group(
        "a storey's floor",
        "a pixel is occupied if the band has an obstacle; free if from the band's top down all is known free to the "
        "ground, give or take LOW; else unknown. A ramp steeper than that is not followed: give its storeys one by one",
    )
    floor.add_argument(
        "--ground", type=float, metavar="METRES", help="height of the ground, map frame (of the largest storey)"
    )
    floor.add_argument(
        "--band", type=_band, metavar="LOW,HIGH", help="heights above the ground that the robot takes, metres (0.1,1.5)"
    )


def asked_ground(snapshot: MapSnapshot, args: argparse.Namespace) -> float:
    """Height of the ground that the options name, metres; else of the largest storey: others are printed.

    Raises:
        BadInputError: kind `bad_band`.
        NotFoundError: kind `no_ground`.
    """
    if args.ground is not None:
        ground_m: float = args.ground
        return ground_m
    (chosen_m, _), *others = snapshot.grounds(band_m=args.band)
    if others:
        heights = ", ".join(f"--ground={height_m:.2f} ({area_m2:.0f} m2)" for height_m, area_m2 in others)
        say(f"other storeys: {heights}")
    return chosen_m


def _band(text: str) -> Band:
    found = HEIGHTS.fullmatch(text)
    if not found:
        raise argparse.ArgumentTypeError(f"a band is its lowest and highest height in metres, 0.1,1.5; got {text!r}")
    return float(found[1]), float(found[2])
