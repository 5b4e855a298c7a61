"""The paper's experiment: one map at several resolutions, with the paper's tables and figures next to ours.

    $ cairn experiment --resolutions 4 --output experiment
    2 robots, 54 measurements, 1944 scans; maps at 4 cm
    4 cm: 56 cells; cairn, exact, fast 22.9 MB, 1:39; ...; pointer octree, zip 7.18 MB, 1:125; ... recall 92.6%
    wrote experiment/report.html and experiment/report.json

Two simulated robots drive through three laboratories and a corridor (VI.C of the paper); each stop's 36 scans become
a commit, and the sum of all commits is the map. The report compares with Table 3 and draws Figs 20, 22 and 23; it says
how fast images became evidence, how large commits are, and how much of the map is true. Scans are taken once for all
resolutions, and never kept.

    report.html    for people: one file, to be printed or mailed
    report.json    the same numbers, and those of every cell and commit
    map-4cm/ ...   the maps; `cairn map create URL --from experiment/map-4cm` serves one

`--recording` maps what was recorded instead: each folder is one robot's. Recordings of `cairn sim record` have the
truth in their folder. `--stops 2` is a short run. A run at 2 cm needs 5 GB of memory; interrupted, it keeps the
resolutions that were finished.
"""

import argparse
import os
from pathlib import Path

from cairn_client.cli.arguments import parser, say
from cairn_map.errors import BadInputError
from cairn_sim.experiment.figures import Json, ResolutionFigures
from cairn_sim.experiment.robots import ExperimentRobot, recorded_robot, simulated_robots
from cairn_sim.experiment.run import ExperimentSettings, run_experiment
from cairn_sim.experiment.tables import MIB, shown
from cairn_sim.robots.robots import ROBOTS, robot_named
from cairn_sim.scene.scene_file import load_scene


def main(argv: list[str]) -> int:
    """Run the experiment."""
    args = _parser().parse_args(argv)
    threads = args.threads or os.cpu_count() or 1
    robots = _robots(args, threads)
    settings = ExperimentSettings(
        voxel_edges_m=[cm / 100 for cm in args.resolutions], threads=threads, ceiling_m=args.ceiling, about=_about(args)
    )
    stops, scans = sum(len(robot.stops) for robot in robots), sum(robot.scan_count for robot in robots)
    resolutions = ", ".join(f"{cm:g}" for cm in args.resolutions)
    say(f"{len(robots)} robots, {stops} measurements, {scans} scans; maps at {resolutions} cm")
    try:
        run = run_experiment(robots, args.output, settings)
    except KeyboardInterrupt:
        report = args.output / "report.html"
        say(f"interrupted; {report} has what was finished" if report.exists() else "interrupted; nothing was finished")
        raise
    for resolution in run.resolutions:
        say(_line(resolution))
    say(f"wrote {args.output / 'report.html'} and {args.output / 'report.json'}")
    return 0


def _line(resolution: ResolutionFigures) -> str:
    codings = "; ".join(
        f"{name} {shown(total.map_bytes / MIB)} MB, 1:{total.ratio:.0f}"
        for name in resolution.coding_names
        for total in [resolution.totals(name)]
    )
    images = resolution.rates()["images_per_s"]
    truth = f"; recall {resolution.truth.scores.recall:.1%}" if resolution.truth else ""
    return f"{resolution.title}: {len(resolution.cells)} cells; {codings}; {images:.1f} images/s{truth}"


def _robots(args: argparse.Namespace, threads: int) -> list[ExperimentRobot]:
    if not args.recording:
        return simulated_robots(
            load_scene("building"),
            robot_named(args.robot),
            scale=args.scale,
            seed=args.seed,
            stops=args.stops,
            threads=threads,
        )
    robots = [recorded_robot(folder, stops=args.stops) for folder in args.recording]
    names = [robot.name for robot in robots]
    if len(set(names)) < len(names):
        raise BadInputError("bad_name", f"each recording's folder names its robot, so they must differ; got {names}")
    return robots


def _about(args: argparse.Namespace) -> Json:
    """Parameters for the report."""
    if args.recording:
        return {"source": "recordings", "stops": args.stops}
    return {
        "source": "simulated: building, path experiment",
        "robot": f"{args.robot}: {robot_named(args.robot).about}",
        "scale": args.scale,
        "seed": args.seed,
        "stops": args.stops,
    }


def _count(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"expected a whole number from 1, got {text!r}")
    return int(text)


def _centimetres(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < 1000:
        raise argparse.ArgumentTypeError(f"a voxel edge is a number of centimetres such as 4, got {text!r}")
    return value


def _parser() -> argparse.ArgumentParser:
    options = parser("cairn experiment", __doc__)
    options.add_argument(
        "--output", type=Path, default=Path("experiment"), metavar="DIR", help="new or empty (experiment)"
    )
    options.add_argument(
        "--resolutions",
        type=_centimetres,
        nargs="+",
        default=[8.0, 4.0, 2.0],
        metavar="CM",
        help="voxel edges in centimetres (8 4 2)",
    )
    options.add_argument("--recording", type=Path, nargs="+", metavar="DIR", help="map these instead, a robot each")
    options.add_argument("--stops", type=_count, metavar="N", help="only the first N of each robot (all)")
    options.add_argument("--robot", default="orpheus", choices=list(ROBOTS), help="simulated on both paths (orpheus)")
    options.add_argument(
        "--scale",
        type=float,
        default=0.25,
        help="of colour and thermal images; two colour pixels see 2 cm at 3 m (0.25)",
    )
    options.add_argument("--seed", type=int, default=1, help="of all noise (1)")
    options.add_argument("--threads", type=_count, metavar="N", help="that render and map (all cores)")
    options.add_argument(
        "--ceiling", type=float, default=0.9, metavar="METRES", help="where the picture cuts the map (0.9)"
    )
    return options
