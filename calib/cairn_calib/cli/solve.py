"""Solve a rig of cameras from the corners that `cairn calib corners` found: rig.json with its uncertainty.

    $ cairn calib corners tof/*.png   --board 7x6 --square 0.1 --output corners/tof
    $ cairn calib corners left/*.png  --board 7x6 --square 0.1 --output corners/left
    $ cairn calib solve corners/tof corners/left --spectrum tof=range,left=colour --output rig.json --report report.html
    warning: tof: no corner lies near the image's corners, ... [tof_edge: 0.59 of the half diagonal, threshold 0.8 ...]
    next: the board's middle at pixel (29, 72) of tof, 1.55 m away, its right edge turned away by 35 degrees
    tof   20 images  840 points  8 outliers  noise 0.106 px  rms 0.105 px
    left  20 images  830 points  0 outliers  noise 0.154 px  rms 0.152 px
    rig.json: tof, left
    report.html: 1 warnings; the same as report.json

A camera's name is its folder's. Images of one place of the board are paired by their names: what differs from name to
name of a folder is the frame (03 of tof03.png and of 03-left.jpg), as text: 200 and 0200 are two moments. The table
that is printed first shows it; --frame '([0-9]+)$' says which part of a name counts. Cameras that share no frame, or
one alone, are refused. The first range camera is the rig's frame, else the first camera (--gauge).

First each camera is solved alone, then all of them with all places of the board. Corners count by their covariance
and by each camera's own noise, which is estimated; corners off by more than 4 sigma are left out and counted. The
board may be bent (--flat: it is not), its pitch wrong by 0.02 % (--pitch-sigma). Free coefficients of every lens are
k1,k2,p1,p2,k3, with p1 and p2 assumed to be 0 +- 0.002 and k3 0 +- 0.1; --distortion says otherwise, --fisheye names
cameras with Kannala and Brandt's model.

With --range DIR the range camera's images of the same boards (16 bit, radial, --range-units-per-m) show the bias of
its ranges, which rig.json states and mapping takes off: an offset, a scale, more at the image's corners, and each
pixel's own part where pixels differ. With --amplitude DIR (16 bit, same names) also how that depends on the amplitude,
with --modulation-mhz F its circular error: each only if amplitudes and ranges of the boards differ enough; else a
warning says so.

Warnings name what the images do not determine, with threshold and measured value: tilt, distances, the image's
edge, numbers that come from assumptions, halves of the images that contradict each other, single frames that much hangs
on; and which image would help most. Images that leave a camera open (one view, parallel boards) are refused. The report
has it all, with residuals, coverage, and how certain each pixel is at 1, 2 and 5 m.
"""

import argparse
import sys
import time
from typing import TYPE_CHECKING

from cairn_calib.cli.solve_options import add_solve_options, read_by_options
from cairn_calib.diagnosis.examination import examine
from cairn_calib.report.range_report import told_ranges
from cairn_calib.report.report_files import refuse_overwriting, write_file, write_report
from cairn_calib.report.report_images import report_images
from cairn_calib.rig.calibration import Statistics
from cairn_calib.solve.solve import solve_rig
from cairn_calib.solve.solved_rig import solved_rig, statistics_of
from cairn_map.progress import while_working

if TYPE_CHECKING:
    from argparse import _SubParsersAction


def add_parser(commands: "_SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add `solve` to `cairn calib`."""
    added = commands.add_parser(
        "solve",
        help="cameras and their places from corners: rig.json with its uncertainty",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_solve_options(added)
    added.set_defaults(run=run)


def run(args: argparse.Namespace) -> None:
    """Solve, and write the rig and, if asked for, the report."""
    refuse_overwriting(args.report, args.output)
    views, plan = read_by_options(args)
    sys.stdout.write(views.pairing_table())
    sys.stdout.flush()
    with while_working("solving"):
        solution = solve_rig(views, plan)
        rig = solved_rig(solution, made_s=time.time())
    with while_working("comparing halves of the images, and without each of them"):
        seen = examine(solution, rig)
    write_file(args.output, rig.to_json())
    sys.stdout.write(statistics_lines(statistics_of(solution)) + told_ranges(solution))
    for each in seen.warnings:
        sys.stderr.write(f"warning: {each}\n")
    if seen.next_images and seen.warnings:
        sys.stderr.write(f"next: {seen.next_images[0]}\n")
    sys.stdout.write(f"{args.output}: {', '.join(rig.cameras)}\n")
    if args.report is not None:
        images = report_images(dict(zip(solution.plan.cameras, args.folders, strict=True)))
        sys.stdout.write(write_report(args.report, seen, images))


def statistics_lines(statistics: Statistics) -> str:
    """A line for each camera."""
    width = max(len(name) for name in statistics.cameras)
    return "".join(
        f"{name:<{width}}  {each.images} images  {each.points} points  {each.outliers} outliers  "
        f"noise {each.sigma_px:.3f} px  rms {each.rms_px:.3f} px\n"
        for name, each in statistics.cameras.items()
    )
