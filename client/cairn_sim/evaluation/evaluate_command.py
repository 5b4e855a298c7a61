"""Measure fusion against the simulator's truth, and draw the paper's Fig. 24.

    $ cairn sim evaluate-fusion pictures/ --map 2 --mm5 mm5_rgbdt/     # a few minutes
    $ cairn sim evaluate-fusion pictures/ --scale 0.25 --scans 3       # a quick look

The table's columns: pixels painted; error, median and 95 %; share of errors above 2 K or 20 of 255; 95 % of pixels
farther than a range pixel from any edge, and of those whose depth was filled in; median behind glass and in mirrors;
pixels painted although hidden; precision and recall of the label OCCLUDED, by the pixel, and where one a range pixel
away counts as well: where an edge is within a range pixel, no sensor said.

Then the map over a live image: intersection over union of what is drawn with the projection of the map's cubes, worked
out without the map: where the live depth agrees, and where there is none.

With --map also the temperatures of a map of whole stops, on bodies and pipes: the share of their voxels that have one
(known %), and how far these are off. A voxel has none where a step in the thermal image is nearer than a range pixel
can tell sides: of pipes a third to a half, of bodies 5 to 20 %, until a robot comes nearer. With --mm5 also hot cups
of real frames against hand labels.
"""

import argparse
import statistics
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from cairn_calib.rig.rig import Spectrum
from cairn_client.cli.arguments import say
from cairn_fusion.recording.images import write_colour
from cairn_fusion.view.telepresence import Telepresence, ViewMode, ViewOptions
from cairn_fusion.view.temperature_scale import locked_scale
from cairn_map.errors import BadInputError
from cairn_map.progress import with_progress
from cairn_sim.evaluation.fusion_evaluation import WAYS, labelled_frames, mapped_scores, plan_scans, scored_view
from cairn_sim.evaluation.fusion_pictures import error_picture, figure_24
from cairn_sim.evaluation.fusion_scores import COLUMNS, FusionScores
from cairn_sim.evaluation.overlay_scores import overlay_scores
from cairn_sim.render.sensors import ColourSensor
from cairn_sim.robots.record import Plan, scans_of, shots_of
from cairn_sim.robots.robots import SimRobot, robot_named
from cairn_sim.robots.trajectories import EXPERIMENT
from cairn_sim.scene.scene_file import load_scene

SCANS_OF_STOP = 36
FIGURE = (20, 22)
"""Stop and scan of the pictures: a person, hot things before a wall, glass, and a floor too dark for a range."""
STOPS = (3, 20, 40)
"""Stops of the experiment: a laboratory with hot pipes, one with people and hot things, the corridor."""


def add_evaluate_arguments(options: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    options.description, options.formatter_class = __doc__, argparse.RawDescriptionHelpFormatter
    options.add_argument("output", type=Path, metavar="FOLDER", help="for the pictures; made if it is not there")
    options.add_argument("--scans", type=int, default=12, metavar="N", help="to score, of 3 stops (12)")
    options.add_argument("--seed", type=int, default=1, help="of all noise (1)")
    options.add_argument("--scale", type=float, default=1.0, help="of colour and thermal images, 0.1 to 1 (1)")
    options.add_argument("--poses", type=int, default=20, metavar="N", help="of the map over live images (20)")
    options.add_argument("--perfect", action="store_true", help="sensors without noise")
    options.add_argument("--map", type=int, default=0, metavar="N", help="also map N whole stops, some 20 s each (0)")
    options.add_argument("--voxel", type=float, default=0.04, metavar="M", help="of the map (0.04)")
    options.add_argument("--mm5", type=Path, metavar="FOLDER", help="also score hot cups of the MM5 frames there")


def evaluate(args: argparse.Namespace) -> int:
    """Print the tables and write the pictures."""
    try:
        args.output.mkdir(parents=True, exist_ok=True)
    except OSError as exc:
        raise BadInputError("bad_output", f"cannot make the folder {args.output}: {exc.strerror}") from exc
    for option, least in (("scans", 1), ("poses", 1), ("map", 0)):
        if getattr(args, option) < least:
            raise BadInputError("bad_option", f"--{option} must be at least {least}, got {getattr(args, option)}")
    if not 0.1 <= args.scale <= 1:
        raise BadInputError("bad_option", f"--scale must be 0.1 to 1, got {args.scale:g}")
    _images(args)
    _overlays(args)
    if args.map:
        _maps(args)
    if args.mm5 is not None:
        _frames(args)
    return 0


def _images(args: argparse.Namespace) -> None:
    """The table of fused images, Fig. 24, and a picture of errors."""
    scene, robot = load_scene("building"), _robot()
    rig, per_stop = robot.rig_of(args.scale), -(-args.scans // len(STOPS))
    plans = [_plan(args, stop) for stop in STOPS]
    step = max(1, SCANS_OF_STOP // per_stop)
    scans = [scan for plan in plans for scan in list(plan_scans(plan, rig, step=step))[:per_stop]][: args.scans]
    cameras = rig.of_spectrum(Spectrum.COLOUR)[0], rig.of_spectrum(Spectrum.THERMAL)[0]
    totals: dict[tuple[str, str], FusionScores] = {}
    for scan in with_progress(scans, "scoring", total=len(scans)):
        for camera in cameras:
            view = scored_view(scene, rig, scan, camera)
            for way, scores in view.scores.items():
                totals[camera, way] = totals[camera, way] + scores if (camera, way) in totals else scores
    for camera, what in zip(cameras, ("temperature, K, on", "colour, of 255, on"), strict=True):
        say(f"{what + ' ' + camera:<34}" + _in_columns(COLUMNS))
        for way in WAYS:
            say(f"  {way:<32}" + _in_columns(totals[camera, way].row()))
    stop, number = FIGURE
    shots = [shot for shot in shots_of(_plan(args, stop)) if shot.scan == number]
    scan = next(scan for _, scan, _ in scans_of(_plan(args, stop), shots, rig))
    view = scored_view(scene, rig, scan, cameras[0])
    scale = locked_scale(view.truth.values)
    write_colour(args.output / "fig24.png", figure_24(scan, rig, cameras[0], scale))
    write_colour(args.output / "errors.png", error_picture(scan, view.fused, view.truth, scale))
    say(f"wrote {args.output / 'fig24.png'} and {args.output / 'errors.png'}")


def _in_columns(cells: Sequence[str]) -> str:
    """A row's cells below their names."""
    return "".join(f"{cell:>{max(len(name), 5) + 2}}" for name, cell in zip(COLUMNS, cells, strict=True))


def _overlays(args: argparse.Namespace) -> None:
    """The table of a map over live images."""
    rig = _robot().rig_of(args.scale)
    name = rig.of_spectrum(Spectrum.COLOUR)[0]
    poses = overlay_scores(rig[name].camera, poses=args.poses, seed=args.seed)
    scores = list(with_progress(poses, "drawing maps", total=args.poses))
    say(f"{'map over ' + name + ', IoU':<34}" + "".join(f"{column:>12}" for column in ("poses", "mean", "least")))
    for way, found in (
        ("live depth agrees", [score.visible for score in scores]),
        ("no live depth", [score.map_only for score in scores]),
    ):
        say(f"  {way:<32}{len(found):>12}{statistics.fmean(found):>12.4f}{min(found):>12.4f}")


def _maps(args: argparse.Namespace) -> None:
    """The table of a map's temperatures."""
    scene, robot = load_scene("building"), _robot()
    rig = robot.rig_of(args.scale)
    # Colour is not looked at.
    rig = rig.model_copy(
        update={"cameras": {n: m for n, m in rig.cameras.items() if m.spectrum is not Spectrum.COLOUR}}
    )
    chosen = [(2 * n + 1) * 54 // (2 * args.map) for n in range(args.map)]
    stops = [
        [scan for _, scan, _ in scans_of(_plan(args, stop), shots_of(_plan(args, stop)), rig)]
        for stop in with_progress(chosen, "rendering stops", total=len(chosen))
    ]
    head = f"map of {len(stops)} stops, {args.voxel * 100:g} cm"
    say(f"{head:<34}" + "".join(f"{column:>12}" for column in ("voxels", "known %", "median K", "95 % K")))
    for name, scores in mapped_scores(scene, rig, stops, voxel_edge_m=args.voxel).items():
        for what, each in scores.items():
            count = f"{len(each.errors_k) + each.without:>12}{100 * each.known:>12.1f}"
            say(f"  {name + ', ' + what:<32}{count}{each.median_k:>12.2f}{each.p95_k:>12.2f}")


def _frames(args: argparse.Namespace) -> None:
    """The table of hot cups, and a picture of the first."""
    say(f"{'hot cups, IoU with hand labels':<34}{'label px':>12}{'the set':>12}{'fused':>12}")
    for number, frame in enumerate(labelled_frames(args.mm5)):
        say(f"  {frame.frame:<32}{int(frame.label.sum()):>12}{frame.given_iou:>12.3f}{frame.fused_iou:>12.3f}")
        if number == 0:
            picture = Telepresence(frame.rig, ViewOptions(mode=ViewMode.SIDE_BY_SIDE)).view(frame.scan)
            write_colour(args.output / "mm5.png", picture)
            say(f"  wrote {args.output / 'mm5.png'}")


def _robot() -> SimRobot:
    """Orpheus, its colour cameras corrected for vignetting: that is no error of fusion."""
    robot = robot_named("orpheus")
    even = ColourSensor(vignetting=0.0)
    return replace(robot, sensors=dict.fromkeys(robot.rig_of(1.0).of_spectrum(Spectrum.COLOUR), even))


def _plan(args: argparse.Namespace, stop: int) -> Plan:
    return Plan(
        scene=load_scene("building"),
        robot=_robot(),
        path=EXPERIMENT,
        scale=args.scale,
        seed=args.seed,
        perfect=args.perfect,
        truth="none",
        first_stop=stop,
        last_stop=stop + 1,
    )
