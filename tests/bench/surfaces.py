"""How true surfaces and free space are next to OctoMap's, on the same images of a room of slanted and thin things."""

import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
from tests.bench import octomap
from tests.fixtures.fusion.slanted_room import (
    DEPTH,
    REGISTERED,
    RGBD,
    depth_scans,
    registered,
    room_truth,
    slanted_room,
    truth_of,
    walk,
)

from cairn_calib.rig.poses import Transform
from cairn_calib.rig.rig import RangeSensing, Rig
from cairn_fusion.mapping.integrate import Integrator, integrate_scans
from cairn_fusion.recording.scan import Scan
from cairn_map.evidence.grid import geometry_for
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_sim.evaluation.scores import FREE, OCCUPIED, Scores, States, map_states, scores_from, scores_of
from cairn_sim.evaluation.truth_grid import Truth, TruthClass, VoxelBox, box_of_cell, truths_of
from cairn_sim.render.render import render_scan
from cairn_sim.render.sensors import Noise
from cairn_sim.robots.heads import RANGE_CAMERA, tof_head
from cairn_sim.robots.record import Plan, scans_of, shots_of
from cairn_sim.robots.robots import ROBOTS
from cairn_sim.scene.scene import Scene
from cairn_sim.scene.scene_file import load_scene

Row = tuple[str, str, str]
KINDS = ("wall/", "slanted/", "thin/")
SCALES = {"near": 1.0, "far": 2.0}


@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """Images of the room, the truth of what they could show, and their rig."""

    title: str
    scene: Scene
    scans: Sequence[Scan]
    rig: Rig
    truth: Truth


def surface_rows(smoke: bool) -> Iterator[Row]:
    """One line each: a depth camera, the same moved into a finer image, the time-of-flight head; then the building."""
    why = octomap.missing()
    if why:
        yield "OctoMap", "skipped", why
    with tempfile.TemporaryDirectory() as name:
        driver = None if why else octomap.compiled_driver(Path(name))
        for trial in _trials(smoke):
            maps = {"cairn": cairn_states(trial)}
            if driver is not None:
                maps["OctoMap"] = octomap_states(trial, driver, Path(name))
            yield from _rows(trial, maps)
        yield from _stop_rows(smoke, driver, Path(name))


def trial_of(title: str, scene: Scene, scans: Sequence[Scan], rig: Rig, *, scale: float, edge_m: float) -> Trial:
    """Images with the truth of the whole room for their poses, in voxels of one size."""
    reach_m = 6.0 if scans[0].range_camera == DEPTH else 10.0
    truth = room_truth(scene, scans, rig, scale=scale, voxel_edge_m=edge_m, max_range_m=reach_m)
    return Trial(title, scene, scans, rig, truth)


def cairn_states(trial: Trial) -> States:
    """(X, Y, Z) states of the truth's voxels in our map, made at once."""
    geometry = geometry_for(voxel_edge_m=trial.truth.box.voxel_edge_m, channels=())
    diff = integrate_scans(trial.scans, trial.rig, geometry, integrator=Integrator())
    return map_states(trial.truth.box, diff, geometry, model=SensorModel())


def octomap_states(trial: Trial, driver: Path, folder: Path) -> States:
    """(X, Y, Z) states of the same voxels in OctoMap's map of the same points."""
    octomap.write_scans(folder / "scans", trial.scans, trial.rig)
    box = trial.truth.box
    found = octomap.voxel_states(driver, folder / "scans", folder / "states", voxel_edge_m=box.voxel_edge_m)
    return _states_in(box, found)


def _trials(smoke: bool) -> Iterator[Trial]:
    for size, scale in SCALES.items():
        scene, poses = slanted_room(scale), walk(scale, 6 if smoke else 50)
        depth, fewer = depth_scans(scene, poses), poses[::2]
        for edge_m in (0.08,) if smoke else (0.04, 0.02):
            title = f"{size}, RGB-D, {len(depth)} images, {edge_m * 100:g} cm"
            yield trial_of(title, scene, depth, RGBD, scale=scale, edge_m=edge_m)
            finer = registered(depth_scans(scene, fewer, rig=REGISTERED))
            title = f"{size}, RGB-D moved into a finer image, {len(finer)} images, {edge_m * 100:g} cm"
            yield trial_of(title, scene, finer, REGISTERED, scale=scale, edge_m=edge_m)
        edge_m = 0.08 if smoke else 0.04
        title = f"{size}, time of flight, {len(poses)} images, {edge_m * 100:g} cm"
        yield trial_of(title, scene, _tof_scans(scene, poses), tof_head(), scale=scale, edge_m=edge_m)


def _stop_rows(smoke: bool, driver: Path | None, folder: Path) -> Iterator[Row]:
    """Two measurements of the building, 72 images at the standard noise, with two sigmas in the rig."""
    robot, edge_m = ROBOTS["tof"], 0.08 if smoke else 0.04
    rig, geometry = robot.rig_of(1.0), geometry_for(voxel_edge_m=edge_m, channels=())
    plan = Plan(scene=load_scene("building"), robot=robot, path="labs", truth="none")
    stops = [replace(plan, first_stop=n, last_stop=n + 1) for n in (4, 20)]
    scans = [scan for stop in stops for _, scan, _ in scans_of(stop, shots_of(stop), rig)]
    tof = rig[RANGE_CAMERA]
    stated = tof.model_copy(update={"sensing": RangeSensing(sigma_m=((0.0, 0.01),))})
    rigs = {"usual sigma": rig, "sigma 1 cm stated": rig.model_copy(update={"cameras": {RANGE_CAMERA: stated}})}
    diffs = {name: integrate_scans(scans, of, geometry, integrator=Integrator()) for name, of in rigs.items()}
    boxes = [box_of_cell(key, geometry) for key in sorted(set().union(*diffs.values()))]
    poses = [scan.T_map_rig @ tof.transform for scan in scans]
    truths = truths_of(plan.scene, boxes, camera=tof.camera, T_map_cameras=poses, fineness=2 if smoke else 4)
    yield f"two stops of the laboratories, {len(scans)} images, {edge_m * 100:g} cm", "", ""
    for name, diff in diffs.items():
        yield _total(f"  cairn, {name}", [scores_of(truth, diff, geometry) for truth in truths])
    if driver is not None:
        octomap.write_scans(folder / "scans", scans, rig)
        found = octomap.voxel_states(driver, folder / "scans", folder / "states", voxel_edge_m=edge_m)
        yield _total("  OctoMap", [scores_from(truth, _states_in(truth.box, found)) for truth in truths])


def _total(name: str, scores: Sequence[Scores]) -> Row:
    total = sum(scores[1:], scores[0])
    return name, f"{total.map_occupied}", f"occupied; {total}; carved {total.carved:.3%}"


def _tof_scans(scene: Scene, poses: Sequence[Transform]) -> list[Scan]:
    rig, noise = tof_head(), Noise(seed=3)
    return [
        render_scan(
            scene, rig, T_map_rig=T, range_camera=RANGE_CAMERA, time_s=float(n), noise=noise, number=n, threads=1
        )
        for n, T in enumerate(poses)
    ]


def _rows(trial: Trial, maps: Mapping[str, States]) -> Iterator[Row]:
    yield trial.title, "", ""
    for name, states in maps.items():
        scores = scores_from(trial.truth, states)
        wrong = f"free called occupied {scores.free_occupied / scores.free:.2%}"
        yield f"  {name}, against the truth", f"{scores.map_occupied}", f"occupied; {scores}; {wrong}"
        kinds = {kind: scores_from(truth_of(trial.truth, trial.scene, kind), states) for kind in KINDS}
        parts = ", ".join(f"{kind} {kinds[kind].recall:.1%}, {kinds[kind].carved:.2%}" for kind in KINDS)
        yield "    recall and carved of each kind", "", parts
    if len(maps) == 2:
        ours, theirs = maps["cairn"] == OCCUPIED, maps["OctoMap"] == FREE
        apart = ours & theirs
        surface = apart & ((trial.truth.classes == TruthClass.SURFACE) | (trial.truth.solid_samples > 0))
        near = apart & trial.truth.near_solid & ~surface
        shares = [int(np.count_nonzero(flags)) / max(1, int(np.count_nonzero(apart))) for flags in (surface, near)]
        share = np.count_nonzero(apart) / max(1, np.count_nonzero(ours))
        yield (
            "  occupied here and free there",
            f"{share:.1%}",
            f"of our occupied; of these are surface or hold solid {shares[0]:.0%}, next to it {shares[1]:.0%}",
        )


def _states_in(box: VoxelBox, found: npt.NDArray[np.int32]) -> States:
    """(X, Y, Z) states of a box's voxels, from (N, 4) of `octomap.voxel_states`."""
    states = np.zeros(box.shape, np.int8)
    at = found[:, :3] - np.array(box.low)
    inside = ((at >= 0) & (at < box.shape)).all(axis=1)
    states[tuple(at[inside].T)] = found[inside, 3]
    return states
