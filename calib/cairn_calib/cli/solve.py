"""Solve a rig of cameras from the corners that `cairn calib corners` found: rig.json with its uncertainty.

    $ cairn calib corners tof/*.png   --board 7x6 --square 0.1 --output corners/tof
    $ cairn calib corners left/*.png  --board 7x6 --square 0.1 --output corners/left
    $ cairn calib solve corners/tof corners/left --spectrum tof=range,left=colour --output rig.json --report report.html
    camera  boards  frame of a name    frames
    tof         20  tof01.png is 01    01, 02, 03 ... 18, 19, 20
    left        20  left01.png is 01   01, 02, 03 ... 18, 19, 20
    frames that both saw: tof and left 20
    usable: where a pixel of tof appears in left is known to 0.24 px (sigma, median)
    tof   20 images  840 points  8 outliers  noise 0.106 px  rms 0.105 px
    left  20 images  830 points  0 outliers  noise 0.154 px  rms 0.152 px
    note: tof: no corner lies near the image's corners, ... [tof_edge: 0.59 of the half diagonal, threshold 0.8 ...]
    next: the board's middle at pixel (29, 72) of tof, 1.55 m away, its right edge turned away by 35 degrees
    report.html: 0 warnings and 1 note; the same as report.json
    rig.json: tof, left

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
pixel's own part where pixels differ. Images of z-depth, as most depth cameras write them, need --z-depth; disparity of
a rectified pair --disparity FOCAL_PX,BASELINE_M,N, with N counts a pixel (256 in KITTI's, 16 in OpenCV's); either must
show, pixel by pixel, the image in which the corners were found. With --amplitude DIR (16 bit, same names) also how that
depends on the amplitude, with --modulation-mhz F its circular error: each only if amplitudes and ranges of the boards
differ enough; else a warning says so.

What is known before counts with --prior: last year's rig.json, with the covariance that it states; a file of Kalibr,
OpenCV, ROS or mrcal whose pixels are good to half a pixel (left=factory.yaml+-0.5); a number of a data sheet
(left.fx=1330+-5) or of a drawing (left.tx=0.1+-0.0005, metres in the rig's frame; left.ry=0.26+-0.01, radians of the
rotation vector of T_rig_camera: 15 degrees to the right). A prior that the images contradict is reported in sigmas, and
its standard deviations are enlarged until they hold. --hold takes the same without +-: those numbers stay as they are,
and a warning says if the images would change them. --hold rig.json holds every lens that the file has: the cameras'
places alone are solved.

The first line after the pairing says whether the result may be used: `usable`, `usable with care` and why, or `not
usable` and why; then rig.json is not written, and the exit code is 1, as where images leave a camera open (one view,
parallel boards). Warnings come next, what weighs most first; notes name what could be better: with threshold and
measured value, and which image would help most. Standard deviations count the noise that the residuals show, of each
camera, and the scatter of images that disagree by more than that. The report has it all, with residuals, coverage, and
how certain each pixel is at 1, 2 and 5 m.
"""

import argparse
import sys
import time
from typing import TYPE_CHECKING

from cairn_calib.cli.solve_options import add_solve_options, read_by_options
from cairn_calib.diagnosis.examination import examine
from cairn_calib.diagnosis.verdict import Rank, merged
from cairn_calib.report.range_report import told_ranges
from cairn_calib.report.report_files import refuse_overwriting, write_file, write_report
from cairn_calib.report.report_images import report_images
from cairn_calib.rig.calibration import Statistics
from cairn_calib.solve.solve import solve_rig
from cairn_calib.solve.solved_rig import solved_rig, statistics_of
from cairn_map.errors import BadInputError
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
    sys.stdout.write(f"{seen.verdict}\n{statistics_lines(statistics_of(solution))}{told_ranges(solution)}")
    sys.stdout.write("".join(f"known before: {each}\n" for each in solution.known))
    sys.stdout.flush()
    for warning in merged(seen.warnings):
        sys.stderr.write(f"{'note' if warning.rank is Rank.NOTE else 'warning'}: {warning}\n")
    if seen.next_images and seen.warnings:
        sys.stderr.write(f"next: {seen.next_images[0]}\n")
    if args.report is not None:
        images = report_images(dict(zip(solution.plan.cameras, args.folders, strict=True)))
        sys.stdout.write(write_report(args.report, seen, images, rig_path=args.output))
    if not seen.verdict.is_usable:
        raise BadInputError("not_usable", f"not usable, so {args.output} was not written: {seen.verdict.reason}")
    write_file(args.output, rig.to_json())
    sys.stdout.write(f"{args.output}: {', '.join(rig.cameras)}\n")


def statistics_lines(statistics: Statistics) -> str:
    """A line for each camera."""
    width = max(len(name) for name in statistics.cameras)
    return "".join(
        f"{name:<{width}}  {each.images} images  {each.points} points  {each.outliers} outliers  "
        f"noise {each.sigma_px:.3f} px  rms {each.rms_px:.3f} px\n"
        for name, each in statistics.cameras.items()
    )
