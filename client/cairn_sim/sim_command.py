"""Simulated robots in scenes that are known exactly.

    $ cairn sim scene                                  # the scenes, robots and paths that come with cairn
    $ cairn sim show building --path labs --stop 3     # what a head sees there, as pictures
    $ cairn sim show moving-building --stop 3 --time 3700    # ... after an hour and a bit, when a door is open
    $ cairn sim record building lab-1 --path experiment --robot tof
    $ cairn sim record moving-building day --path labs --robot tof --rounds 3 --hours 2
    $ cairn sim evaluate-fusion pictures/              # fused images against the truth, and the paper's Fig. 24
    $ cairn robot replay lab-1 --map http://127.0.0.1:8750/maps/lab

A recording is like a real robot's; the truth behind every image lies in its folder truth/. The path
`experiment` of the building is the paper's: 54 stops of 36 scans. The same seed gives the same bytes.

In a scene that moves, each scan shows what is where at its own time. `--rounds` and `--hours` visit the stops at even
times over hours; nothing is rendered between them.
"""

import argparse
import math
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path

from cairn_client.cli.arguments import parser, say
from cairn_fusion.recording.images import write_colour
from cairn_map.errors import BadInputError
from cairn_map.progress import with_progress
from cairn_sim.evaluation.evaluate_command import add_evaluate_arguments, evaluate
from cairn_sim.render.render import render_scan
from cairn_sim.robots.contact_sheet import contact_sheet, view_from_above
from cairn_sim.robots.heads import RANGE_CAMERA
from cairn_sim.robots.record import Plan, places_of, record, shots_of
from cairn_sim.robots.robots import ROBOTS, robot_named
from cairn_sim.robots.targets import TARGET_SCENES
from cairn_sim.robots.trajectories import PoseErrors, path_names
from cairn_sim.scene.movements import CLOCK_START_S
from cairn_sim.scene.scene import Scene
from cairn_sim.scene.scene_file import SHIPPED, load_scene, shipped_text
from cairn_sim.scene.scene_format import ZERO_C_K

MEGABYTES_PER_SCAN = {"orpheus": 4.8, "tof": 0.24, "lidar": 0.2, "handheld": 3.1}
"""Bytes of a recording at full size with the truth of the range camera, measured in the building."""
SECONDS_MAX = 1e9
TRUTH_FACTORS = {"none": 0.95, "range": 1.0, "all": 2.1}


def main(argv: list[str]) -> int:
    """Run one subcommand."""
    args = _parser().parse_args(argv)
    actions = {"scene": _scene, "record": _record, "show": _show, "evaluate-fusion": evaluate}
    return actions[args.action](args)


def _scene(args: argparse.Namespace) -> int:
    """List what there is, or check and describe one scene."""
    if args.scene is None:
        for name in [*SHIPPED, *TARGET_SCENES]:
            scene = _load(name)
            moving = f", {len(scene.moving)} objects move" if scene.moving else ""
            say(f"{name:15} {len(scene.solids):4} solids{moving}; paths: {', '.join(path_names(name))}")
        say()
        for robot in ROBOTS.values():
            say(f"{robot.name:15} {robot.about}")
        return 0
    scene = _load(args.scene)
    if args.write is not None:
        if args.write.exists():
            raise BadInputError("file_exists", f"{args.write} is there already; choose another name")
        with _output(args.write):
            args.write.write_text(_text(args.scene), encoding="utf-8")
        say(f"wrote {args.write}; change it, and give its path wherever a scene is asked for")
        return 0
    kelvin = scene.surfaces.temperature_k
    bounds = scene.shapes.bounds[abs(scene.shapes.bounds).max(axis=1) < math.inf]
    say(f"{scene.name}: {len(scene.solids)} solids")
    if len(bounds):
        low, high = bounds[:, :3].min(axis=0), bounds[:, 3:].max(axis=0)
        span = ", ".join(f"{a} {x:.2f} to {y:.2f} m" for a, x, y in zip("xyz", low, high, strict=True))
        say(f"  spans        {span}")
    low_c, high_c, ambient_c = (k - ZERO_C_K for k in (kelvin.min(), kelvin.max(), scene.ambient_k))
    say(f"  temperature  {low_c:.1f} to {high_c:.1f} C, around it {ambient_c:.1f} C")
    for each in scene.moving:
        times_s, repeat_s = [keyframe.time_s for keyframe in each.movement.keyframes], each.movement.repeat_s
        again = "" if repeat_s is None else f", again every {repeat_s:g} s"
        say(f"  moves        {each.name}: {times_s[0]:g} to {times_s[-1]:g} s{again}")
    say(f"  paths        {', '.join(path_names(scene.name)) or '(none: cairn knows paths of its own scenes only)'}")
    return 0


def _record(args: argparse.Namespace) -> int:
    """Write a recording, with a bar."""
    plan = _plan(args)
    shots = shots_of(plan)
    stop_count = sum(shot.ends_stop for shot in shots)
    say(f"{plan.robot.name} in {plan.scene.name}, path {plan.path}: {stop_count} measurements, {len(shots)} scans")
    say(f"  goes on for {_span_of_time(shots[-1].time_s - shots[0].time_s)} of the scene's time")
    if args.scale == 1:
        size_mb = len(shots) * MEGABYTES_PER_SCAN[plan.robot.name] * TRUTH_FACTORS[args.truth]
        say(f"  takes about {size_mb / 1000:.2g} GB")
        _check_room(args.output, size_mb)
    for _ in with_progress(record(plan, args.output, scene_text=_text(args.scene)), "scans", total=len(shots)):
        pass
    say(f"wrote {args.output}; its truth is in {args.output / 'truth'}")
    return 0


def _check_room(folder: Path, size_mb: float) -> None:
    """Refuse a recording that its disk has no room for."""
    above = next((each for each in (folder.absolute(), *folder.absolute().parents) if each.exists()), Path("/"))
    usage = shutil.disk_usage(above)
    free_mb = usage.free / 1e6
    # One of no size at all is no disk: what is wrong with it is said when it is written.
    if usage.total and size_mb > free_mb:
        raise BadInputError(
            "no_space",
            f"the recording takes about {size_mb / 1000:.2g} GB, {above} has {free_mb / 1000:.2g} GB left; choose "
            "another folder, fewer rounds or stops, a smaller --scale, or --truth none",
        )


def _span_of_time(seconds: float) -> str:
    """A time for people: 45 s, 12 min, 2.0 h."""
    if seconds < 60:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 3600 else f"{seconds / 3600:.1f} h"


def _show(args: argparse.Namespace) -> int:
    """Write the pictures."""
    plan = _plan(args)
    shots = [shot for shot in shots_of(plan) if (shot.stop, shot.scan) == (args.stop, args.scan)]
    if not shots:
        raise BadInputError("no_stops", f"path {plan.path} has no stop {args.stop} with a scan {args.scan}")
    time_s = shots[0].time_s if args.time is None else CLOCK_START_S + args.time
    above = args.output.with_name(f"{args.output.stem}-plan.png") if args.output.name else args.output
    with _output(args.output):
        args.output.touch()
    scan = render_scan(
        plan.scene,
        plan.robot.rig_of(plan.scale),
        T_map_rig=shots[0].T_map_rig,
        range_camera=RANGE_CAMERA,
        time_s=time_s,
        noise=plan.noise,
        number=shots[0].number,
        sensors=plan.robot.sensors,
    )
    with _output(args.output):
        write_colour(args.output, contact_sheet(scan))
        write_colour(above, view_from_above(plan.scene.at(time_s), places_of(plan), args.stop))
    say(f"wrote {args.output}: what {plan.robot.name} sees at stop {args.stop}, scan {args.scan}, of {plan.path}")
    say(f"wrote {above}: {plan.scene.name} from above")
    return 0


@contextmanager
def _output(path: Path) -> Iterator[None]:
    """Say what is wrong with a file that cannot be written."""
    try:
        yield
    except OSError as exc:
        raise BadInputError("bad_output", f"cannot write {path}: {exc.strerror}") from exc


def _plan(args: argparse.Namespace) -> Plan:
    scene = _load(args.scene)
    errors = PoseErrors(**{field.name: getattr(args, field.name) for field in fields(PoseErrors)})
    return Plan(
        scene=scene,
        robot=robot_named(args.robot),
        path=args.path or _first_path(scene),
        seed=args.seed,
        perfect=args.perfect,
        scale=args.scale,
        truth=args.truth,
        raw=args.raw,
        errors=errors,
        backlash_rad=math.radians(args.backlash_deg),
        speed_m_s=args.speed,
        rate_hz=args.rate,
        rounds=args.rounds,
        lasts_s=args.hours * 3600,
        first_stop=args.stops[0],
        last_stop=args.stops[1],
    )


def _load(scene: str) -> Scene:
    """A scene by name or file."""
    return TARGET_SCENES[scene]() if scene in TARGET_SCENES else load_scene(scene)


def _text(scene: str) -> str:
    """The file of a scene that was loaded."""
    if scene in TARGET_SCENES:
        return f"# {scene}: made by cairn_sim.robots.targets, which has no file\n"
    return shipped_text(scene) if scene in SHIPPED else Path(scene).read_text(encoding="utf-8")


def _first_path(scene: Scene) -> str:
    names = path_names(scene.name)
    if not names:
        raise BadInputError("unknown_path", f"cairn knows no path in {scene.name}; name the scene as one of its own")
    return names[0]


def _span(text: str) -> tuple[int, int | None]:
    first, colon, last = text.partition(":")
    if not all(part.isdecimal() or not part for part in (first, last)) or not text.strip(":"):
        raise argparse.ArgumentTypeError(f"stops are FROM:TO, FROM: or one number, from 0, got {text!r}")
    if not colon:
        return int(first), int(first) + 1
    return int(first or 0), int(last) if last else None


def _seconds(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0 <= value <= SECONDS_MAX:
        raise argparse.ArgumentTypeError(f"a time is 0 to {SECONDS_MAX:g} seconds, got {text!r}")
    return value


def _parser() -> argparse.ArgumentParser:
    options = parser("cairn sim", __doc__)
    actions = options.add_subparsers(dest="action", required=True, metavar="ACTION")
    scene = actions.add_parser("scene", help="list scenes and robots; check and describe one scene")
    scene.add_argument("scene", nargs="?", help=f"{', '.join([*SHIPPED, *TARGET_SCENES])}, or a scene file")
    scene.add_argument("--write", type=Path, metavar="FILE", help="write the scene's text there, to change it")
    recording = actions.add_parser("record", help="write what a robot records along a path, and the truth")
    show = actions.add_parser("show", help="write what a robot sees at one stop as PNG, and the scene from above")
    add_evaluate_arguments(actions.add_parser("evaluate-fusion", help="measure fusion against the truth; Fig. 24"))
    for one in (recording, show):
        one.add_argument("scene", help=f"{', '.join([*SHIPPED, *TARGET_SCENES])}, or a scene file")
    recording.add_argument("output", type=Path, metavar="FOLDER", help="new or empty")
    recording.add_argument("--truth", choices=list(TRUTH_FACTORS), default="range", help="for which images (range)")
    recording.add_argument(
        "--stops", type=_span, default=(0, None), metavar="FROM:TO", help="a part of the stops (all)"
    )
    recording.add_argument("--raw", action="store_true", help="thermal images as raw counts, too")
    recording.add_argument("--rounds", type=int, default=1, metavar="N", help="times along the path (1)")
    recording.add_argument(
        "--hours", type=float, default=0.0, metavar="H", help="of the scene's time, with pauses between stops (0: none)"
    )
    show.set_defaults(truth="none", raw=False, stops=(0, None), rounds=1, hours=0.0)
    show.add_argument("--output", type=Path, default=Path("view.png"), metavar="FILE", help="picture (view.png)")
    show.add_argument("--stop", type=int, default=0, help="of the path, from 0 (0)")
    show.add_argument(
        "--time", type=_seconds, metavar="S", help="seconds after the scene's start (as in a recording of the path)"
    )
    show.add_argument("--scan", type=int, default=0, help="of the stop, from 0 (0)")
    for one in (recording, show):
        _add_plan(one)
    return options


def _add_plan(options: argparse.ArgumentParser) -> None:
    options.add_argument("--robot", default="orpheus", choices=list(ROBOTS), help="(orpheus)")
    options.add_argument("--path", help="a path of the scene; see `cairn sim scene` (the scene's first)")
    options.add_argument("--seed", type=int, default=1, help="of all noise (1)")
    options.add_argument("--perfect", action="store_true", help="sensors without noise: each pixel is the truth")
    options.add_argument("--scale", type=float, default=1.0, help="of colour and thermal images, above 0 to 1 (1)")
    options.add_argument(
        "--speed", type=float, default=0.0, metavar="M/S", help="drive through, scan by scan (0: stop)"
    )
    options.add_argument("--rate", type=float, default=5.0, metavar="HZ", help="scans a second of a drive (5)")
    errors = options.add_argument_group("pose errors; the true poses are kept in truth/")
    errors.add_argument("--sigma-m", type=float, default=0.0, metavar="M", help="of each position (0)")
    errors.add_argument("--sigma-rad", type=float, default=0.0, metavar="RAD", help="of each rotation (0)")
    errors.add_argument("--drift", type=float, default=0.0, metavar="M", help="random walk after 1 m of way (0)")
    errors.add_argument("--drift-rad", type=float, default=0.0, metavar="RAD", help="of the heading, after 1 m (0)")
    errors.add_argument("--backlash-deg", type=float, default=0.0, metavar="DEG", help="play of the head's gears (0)")
