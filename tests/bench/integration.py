"""How fast a ToF measurement of the building becomes evidence, and how true the evidence is."""

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import numpy.typing as npt
from tests.bench.level import street_sweep
from tests.bench.timing import cpu_s, wall_s

from cairn_calib.rig.rig import RangeSensing, Rig
from cairn_fusion.mapping.integrate import Integrator, Method, integrate_scans
from cairn_fusion.mapping.measurement import Measurement
from cairn_fusion.recording.recording import Recording, open_recording
from cairn_fusion.recording.recording_writer import RecordingWriter
from cairn_fusion.recording.scan import Scan
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.evidence_map import EvidenceMap
from cairn_map.evidence.grid import CellKey, Geometry, geometry_for
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_sim.evaluation.scores import FREE, Scores, map_states, scores_of
from cairn_sim.evaluation.truth_grid import Truth, box_of_cell, truths_of
from cairn_sim.render.sensors import RangeSensor
from cairn_sim.robots.heads import RANGE_CAMERA
from cairn_sim.robots.record import Plan, scans_of, shots_of
from cairn_sim.robots.robots import ROBOTS
from cairn_sim.scene.scene_file import load_scene

Row = tuple[str, str, str]
Diff = dict[CellKey, Evidence]
FIVE_MM = RangeSensor(
    sigma_min_m=0.005, sigma_m=0.0050001, sigma_max_m=0.005001, amplitude_min=0.0, amplitude_sigma=0.0
)
"""5 mm at every range, and no return too weak: the noise of the prototype that the figures compare with."""
SHARES = ("below 1/8", "below 1/2", "below 1", "all")


def integration_rows(smoke: bool) -> Iterator[Row]:
    """One line each."""
    robot, scene = ROBOTS["tof"], load_scene("building")
    plan = Plan(scene=scene, robot=robot, path="labs", truth="none", first_stop=8, last_stop=9)
    scans = [scan for _, scan, _ in scans_of(plan, shots_of(plan), robot.rig_of(1.0))]
    rays = sum(int((scan.range_m > 0).sum()) for scan in scans)
    rig = robot.rig_of(1.0)

    def work(geometry: Geometry, method: Method, threads: int) -> Callable[[], Diff]:
        limits = Integrator(method=method)
        return lambda: integrate_scans(scans, rig, geometry, integrator=limits, threads=threads)

    for edge_m in (0.08, 0.04) if smoke else (0.08, 0.04, 0.02):
        geometry = geometry_for(voxel_edge_m=edge_m)
        carve_s = cpu_s(work(geometry, Method.CARVE, 1), 2 if smoke else 7)
        name = f"integrate {len(scans)} ToF images, {edge_m * 100:g} cm, 1 thread"
        yield name, f"{1e3 * carve_s:.0f}", f"ms CPU = {rays / carve_s / 1e6:.1f} M rays/s"
        if not smoke:
            cast_s = cpu_s(work(geometry, Method.CAST, 1), 1 if edge_m < 0.04 else 3)
            yield "  ray by ray", f"{1e3 * cast_s:.0f}", f"ms CPU, {cast_s / carve_s:.1f} x as long"
            one_s, two_s = (wall_s(work(geometry, Method.CARVE, n), 5) for n in (1, 2))
            yield "  2 threads", f"{1e3 * two_s:.0f}", f"ms wall, {one_s / two_s:.2f} x as fast"
    yield from _sweep_rows(smoke)
    yield from _rgbd_rows(smoke)
    if not smoke:
        yield from _all_cameras_rows(plan)
        yield from _truth_rows(plan, scans)
        yield from _path_rows(plan)


def _all_cameras_rows(plan: Plan) -> Iterator[Row]:
    """The same stop with two colour and two thermal cameras beside the ToF camera."""
    full = replace(plan, robot=ROBOTS["orpheus"])
    rig, geometry = full.robot.rig_of(0.25), geometry_for(voxel_edge_m=0.04)
    scans = [scan for _, scan, _ in scans_of(full, shots_of(full), rig)]
    integrator = Integrator()
    seconds = cpu_s(lambda: integrate_scans(scans, rig, geometry, integrator=integrator, threads=1), 5)
    yield f"integrate {len(scans)} scans of all cameras, 4 cm, 1 thread", f"{1e3 * seconds:.0f}", "ms CPU"


def _truth_rows(plan: Plan, standard: list[Scan]) -> Iterator[Row]:
    geometry, rig = geometry_for(voxel_edge_m=0.04), plan.robot.rig_of(1.0)
    quiet = replace(plan, robot=replace(plan.robot, sensors={RANGE_CAMERA: FIVE_MM}))
    five_mm = [scan for _, scan, _ in scans_of(quiet, shots_of(quiet), rig)]
    diffs = {
        f"  {noise}, {method}": integrate_scans(scans, rig, geometry, integrator=Integrator(method=method))
        for noise, scans in (("sigma 5 mm", five_mm), ("standard noise", standard))
        for method in (Method.CARVE, Method.CAST)
    }
    keys = sorted(set().union(*diffs.values()))
    boxes = [box_of_cell(key, geometry) for key in keys]
    poses = [scan.T_map_rig @ rig[RANGE_CAMERA].transform for scan in standard]
    truths = truths_of(plan.scene, boxes, camera=rig[RANGE_CAMERA].camera, T_map_cameras=poses, fineness=3)
    yield "evidence of that measurement against the truth, 4 cm", f"{len(keys)}", "cells"
    for name, diff in diffs.items():
        scores: list[Scores] = [scores_of(truth, diff, geometry) for truth in truths]
        yield name, "", str(sum(scores[1:], scores[0]))


def _path_rows(plan: Plan) -> Iterator[Row]:
    """All laboratories: 26 measurements, 936 scans, occupancy alone; with and without what glass and mirrors show."""
    geometry = geometry_for(voxel_edge_m=0.04, channels=())
    maps: dict[str, Diff] = {}
    ways: list[npt.NDArray[np.bool_]] = []
    whole = replace(plan, first_stop=0, last_stop=None, truth="range")
    for noise, sensors, rig in (
        ("sigma 5 mm", {RANGE_CAMERA: FIVE_MM}, _rig_with(plan, sigma_m=((0.0, 0.005),))),
        ("standard noise", {}, plan.robot.rig_of(1.0)),
    ):
        path = replace(whole, robot=replace(plan.robot, sensors=sensors), truth="none" if ways else "range")
        scans, direct = [], []
        for n, (_, scan, truths) in enumerate(scans_of(path, shots_of(path), rig)):
            if truths:
                ways.append(truths[RANGE_CAMERA].way > 0)
            scans.append(scan)
            direct.append(replace(scan, range_m=np.where(ways[n], np.float32(np.nan), scan.range_m)))
        start = time.perf_counter()
        maps[noise] = _map_of(scans, plan.robot.scans_per_stop, rig, geometry)
        yield (
            f"map {len(scans)} scans of the laboratories, 4 cm, {noise}",
            f"{time.perf_counter() - start:.1f}",
            "s wall",
        )
        maps[f"{noise}, no glass, no mirror"] = _map_of(direct, plan.robot.scans_per_stop, rig, geometry)
    poses = [shot.T_map_rig for shot in shots_of(whole)][::2]
    boxes = [box_of_cell(key, geometry) for key in sorted(set().union(*maps.values()))]
    camera = plan.robot.rig_of(1.0)[RANGE_CAMERA].camera
    found = truths_of(plan.scene, boxes, camera=camera, T_map_cameras=poses, fineness=2)
    for name, diff in maps.items():
        scores = [scores_of(truth, diff, geometry) for truth in found]
        yield f"  {name}, against the truth", "", str(sum(scores[1:], scores[0]))
        counts = sum((_free_by_share(truth, diff, geometry) for truth in found), np.zeros(4, np.int64))
        yield "    false free by share of solid", "", ", ".join(f"{k} {n}" for k, n in zip(SHARES, counts, strict=True))


def _rig_with(plan: Plan, **sensing: object) -> Rig:
    rig = plan.robot.rig_of(1.0)
    tof = rig[RANGE_CAMERA].model_copy(update={"sensing": RangeSensing.model_validate(sensing)})
    return rig.model_copy(update={"cameras": {**rig.cameras, RANGE_CAMERA: tof}})


def _map_of(scans: list[Scan], size: int, rig: Rig, geometry: Geometry) -> Diff:
    total = EvidenceMap(geometry)
    for stop in (scans[n : n + size] for n in range(0, len(scans), size)):
        total.merge(integrate_scans(stop, rig, geometry, integrator=Integrator()))
    return total.packed()


def _free_by_share(truth: Truth, diff: Diff, geometry: Geometry) -> npt.NDArray[np.int64]:
    """(4,) voxels called free that touch a solid, by how much of them is solid: the bounds of `SHARES`."""
    free = map_states(truth.box, diff, geometry, model=SensorModel()) == FREE
    return np.histogram(truth.solid_samples[free], [1, 8, 32, 64, 65])[0]


def _sweep_rows(smoke: bool) -> Iterator[Row]:
    rig, sweeps = street_sweep()
    geometry, limits = geometry_for(voxel_edge_m=0.2, channels=()), Integrator(max_range_m=80.0)
    for name, scan in sweeps.items():
        seconds = cpu_s(partial(integrate_scans, [scan], rig, geometry, integrator=limits), 1 if smoke else 7)
        yield f"sweep of 64 beams, {scan.range_m.size} points, 80 m, 20 cm, {name}", f"{1e3 * seconds:.1f}", "ms CPU"


def _rgbd_rows(smoke: bool) -> Iterator[Row]:
    """RGB-D of 640 x 480 pixels from a hand-held camera, decoded from PNG and JPEG and mapped in one measurement."""
    plan = Plan(scene=load_scene("small-room"), robot=ROBOTS["handheld"], path="west", scale=0.5, truth="none")
    rig, count = plan.robot.rig_of(plan.scale), 2 if smoke else 12
    with TemporaryDirectory() as folder:
        with RecordingWriter(Path(folder) / "hand", rig, name="hand") as writer:
            for _, scan, _ in scans_of(plan, shots_of(plan)[:count], rig):
                writer.add(scan)
        source = open_recording(Path(folder) / "hand")
        height, width = source.scan(0).range_m.shape
        for edge_m in (0.04,) if smoke else (0.04, 0.02):
            measurement_s = cpu_s(
                lambda edge_m=edge_m: _mapped(source, geometry_for(voxel_edge_m=edge_m)), 1 if smoke else 3
            )
            yield (
                f"RGB-D {width} x {height} with colour, read and mapped, {edge_m * 100:g} cm",
                f"{len(source) / measurement_s:.1f}",
                "frames/s CPU",
            )


def _mapped(source: Recording, geometry: Geometry) -> Diff:
    measurement = Measurement(source.rig, geometry)
    for scan in source:
        measurement.add(scan)
    return measurement.diff()
