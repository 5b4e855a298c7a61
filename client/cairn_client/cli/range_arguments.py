"""Limits of ranges, which the commands that map scans share, and the report of what the limits left out."""

import argparse

from cairn_calib.rig.rig import LIDAR_REACH_M, TIME_OF_FLIGHT_REACH_M
from cairn_fusion.mapping.beam_returns import ReturnCounts
from cairn_fusion.mapping.integrate import Integrator

CAUSES = {
    "no_return": "without a return",
    "too_far": "beyond --max-range",
    "too_near": "below --min-range",
    "saturated": "saturated",
    "flying": "between a near and a far surface",
    "own_body": "on the robot itself",
}
"""Causes for which a pixel is left out, by the field of `ReturnCounts`."""
FAR_SHARE = 0.02
"""Share of the ranges beyond the limit from which on a hint is given."""


def add_ranges(command: argparse.ArgumentParser) -> None:
    """Add options that limit ranges."""
    least_m = Integrator().min_range_m
    command.add_argument(
        "--min-range", type=float, default=least_m, metavar="METRES", help=f"ignore nearer ranges ({least_m:g})"
    )
    command.add_argument(
        "--max-range",
        type=float,
        metavar="METRES",
        help=f"ignore farther ranges ({TIME_OF_FLIGHT_REACH_M:g} of cameras, {LIDAR_REACH_M:g} of spinning lidars)",
    )


def integrator_of(args: argparse.Namespace) -> Integrator:
    """Integrator with these limits."""
    return Integrator(min_range_m=args.min_range, max_range_m=args.max_range)


def returns_line(counts: ReturnCounts) -> str:
    """Line that says which share of the pixels was mapped, and why the others were left out."""
    if not counts.pixels:
        return "ranges: none"
    causes = [
        f"{getattr(counts, name) / counts.pixels:.1%} {text}" for name, text in CAUSES.items() if getattr(counts, name)
    ]
    line = f"ranges: {counts.used / counts.pixels:.1%} of {counts.pixels} pixels are mapped"
    line += f"; left out: {', '.join(causes)}" if causes else ""
    returned = counts.pixels - counts.no_return
    if counts.too_far > FAR_SHARE * returned:
        line += (
            f". {counts.too_far / returned:.1%} of all returns are too far: give --max-range if the sensor sees them"
        )
    return line
