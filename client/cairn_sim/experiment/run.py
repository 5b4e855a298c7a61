"""The paper's experiment (VI.C): two robots, 54 measurements, one map at several resolutions, and its figures.

    map_all          scans, taken once -> commits on every map            `experiment_mapping`
    measure_cells    sizes, times, how full, and the map's folder         `experiment_cells`
    TruthGrid        what of it is true                                   `experiment_truth`
    write_report     after every resolution, so that what is finished is kept

Nothing half-written is left behind, whenever it is interrupted.
"""

import json
import os
import platform
import time
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

from cairn_map.errors import BadInputError
from cairn_map.evidence.grid import Geometry
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_map.progress import with_progress
from cairn_sim.experiment.cells import measure_cells
from cairn_sim.experiment.figures import (
    CellFigures,
    Json,
    ResolutionFigures,
    RunFigures,
    TruthFigures,
    paper_geometry,
)
from cairn_sim.experiment.mapping import GrowingMap, map_all
from cairn_sim.experiment.plan import PlanView
from cairn_sim.experiment.report import report_page
from cairn_sim.experiment.robots import ExperimentRobot
from cairn_sim.experiment.truth import TruthGrid

PICTURE_VOXEL_M = 0.04
"""The picture is of the finest map that is not finer: more would not be seen on a page."""
LIBRARIES = ("cairn-robotics", "numpy", "numba", "zstandard")


@dataclass(frozen=True, slots=True, kw_only=True)
class ExperimentSettings:
    """Settings of an experiment, without its robots."""

    voxel_edges_m: Sequence[float]
    threads: int
    ceiling_m: float
    """Height at which the picture cuts the map, metres."""
    about: Json
    """Parameters for the report."""


def run_experiment(robots: Sequence[ExperimentRobot], folder: Path, settings: ExperimentSettings) -> RunFigures:
    """Drive, map, measure; the report is in `folder`, which is new or empty, and grows with each resolution.

    Raises:
        BadInputError: the folder holds something, the robots saw nothing, or a measurement does not fit a commit.
    """
    edges_m = sorted(set(settings.voxel_edges_m), reverse=True)
    maps = [GrowingMap(paper_geometry(edge_m)) for edge_m in edges_m]
    _check_folder(folder)
    started = datetime.now(UTC)
    taken_s = _drive(robots, maps, settings.threads)
    about = {**settings.about, **_machine(settings.threads), "started": started.isoformat(timespec="seconds")}
    about |= {"robots": {robot.name: {"stops": len(robot.stops), "scans": robot.scan_count} for robot in robots}}
    about |= {"taking_scans_s": taken_s}
    run = RunFigures(about=about, asked=[f"{edge_m * 100:g} cm" for edge_m in edges_m])
    plan: PlanView | None = None
    start_s = time.perf_counter()
    for growing in maps:
        fresh = PlanView(growing.geometry, settings.ceiling_m)
        run.resolutions.append(_measured(growing, robots, folder, fresh))
        growing.map.clear()  # the finest is the largest, and comes last
        if plan is None or growing.geometry.voxel_edge_m >= PICTURE_VOXEL_M:
            plan = fresh
        run.about["measuring_s"] = time.perf_counter() - start_s
        write_report(folder, run, plan, robots)
    return run


def _drive(robots: Sequence[ExperimentRobot], maps: Sequence[GrowingMap], threads: int) -> float:
    """Map everything; the seconds that taking the scans took."""
    stops = sum(len(robot.stops) for robot in robots)
    steps = with_progress(map_all(robots, maps, threads=threads), "measurements", total=stops)
    taken_s = sum(seconds for _, _, seconds in steps)
    if not all(len(growing.map) for growing in maps):
        raise BadInputError("empty_map", "no scan gave evidence: is the range in metres, and under 10 m?")
    return taken_s


def _measured(
    growing: GrowingMap, robots: Sequence[ExperimentRobot], folder: Path, plan: PlanView
) -> ResolutionFigures:
    """The figures of one finished map; its cells are in the folder, and in the plan."""
    geometry, model = growing.geometry, SensorModel()
    grid = _truth_grid(growing, robots)
    title = f"{geometry.voxel_edge_m * 100:g} cm"
    memory_bytes = growing.map.size_bytes
    cells: list[CellFigures] = []
    with closing(measure_cells(growing.map, folder / map_folder_name(geometry), model=model)) as steps:
        for key, evidence, figures in with_progress(steps, f"cells of {title}", total=len(growing.map)):
            cells.append(figures)
            plan.add(key, evidence, model)
            if grid is not None:
                grid.compare(key, evidence, model)
    truth: TruthFigures | None = grid.figures() if grid is not None else None
    return ResolutionFigures(
        voxel_edge_m=geometry.voxel_edge_m,
        side=geometry.side,
        map_memory_bytes=memory_bytes,
        measurements=growing.measurements,
        cells=cells,
        truth=truth,
    )


def _truth_grid(growing: GrowingMap, robots: Sequence[ExperimentRobot]) -> TruthGrid | None:
    """Truth of the map's cells; None if a robot's truth is unknown, or of another scene."""
    scenes = {robot.truth.scene.name if robot.truth else None for robot in robots}
    if None in scenes or len(scenes) > 1:
        return None
    grid = TruthGrid(robots, growing.geometry, list(growing.map))
    for _ in with_progress(grid.look(), f"truth at {growing.geometry.voxel_edge_m * 100:g} cm", total=len(grid)):
        pass
    return grid


def map_folder_name(geometry: Geometry) -> str:
    """Name of the folder of a map's cells in the experiment's folder: `map-4cm`."""
    return f"map-{geometry.voxel_edge_m * 100:g}cm"


def write_report(folder: Path, run: RunFigures, plan: PlanView, robots: Sequence[ExperimentRobot]) -> None:
    """`report.json` and `report.html`; a reader never sees half of one."""
    folder.mkdir(parents=True, exist_ok=True)
    stops = [(robot.name, robot.stops) for robot in robots]
    _write(folder / "report.json", json.dumps(run.to_json(), indent=1, allow_nan=False) + "\n")
    _write(folder / "report.html", report_page(run, plan, stops))


def _write(path: Path, text: str) -> None:
    fresh = path.with_name(path.name + ".new")
    try:
        fresh.write_text(text, encoding="utf-8")
        fresh.replace(path)
    finally:
        fresh.unlink(missing_ok=True)


def _check_folder(folder: Path) -> None:
    """Refuse before the drive what would fail after it."""
    try:
        if folder.exists() and any(folder.iterdir()):
            raise BadInputError("not_empty", f"{folder} holds something already; choose another --output")
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as exc:
        raise BadInputError("bad_output", f"cannot write into {folder}: {exc.strerror}") from exc


def _machine(threads: int) -> Json:
    return {
        "versions": {name: version(name) for name in LIBRARIES} | {"python": platform.python_version()},
        "machine": f"{platform.system()} {platform.machine()}, {_processor()}, {os.cpu_count()} cores",
        "threads": threads,
    }


def _processor() -> str:
    """The processor's name, where the system tells it."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or "unknown processor"
