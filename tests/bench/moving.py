"""Maps with epochs of buildings that move and that do not, against the truth and against one sum of the same scans.

The moving building: a door opens after an hour, a guard comes and goes, a crate comes and goes. Four stops of
laboratory 1, 36 scans each, every 15 minutes; each comparison asks what changed in an hour. The poses that the robot
believes are off by a normal error along each axis, one for each visit of a stop. The static building is visited
likewise.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from tests.bench.surfaces import Trial, trial_of
from tests.fixtures.fusion.slanted_room import RGBD, depth_scans, slanted_room, truth_of, walk
from tests.fixtures.sim.change_scores import ChangeScores, change_scores
from tests.fixtures.sim.passes import (
    Cells,
    Measured,
    Recorded,
    histories,
    measured,
    present_states,
    recorded,
    sums,
    with_errors,
)

from cairn_fusion.mapping.integrate import Integrator, integrate_scans
from cairn_map.epochs.changes import map_changes
from cairn_map.epochs.epoch import Epoch, epoch_of
from cairn_map.epochs.layer import MapLayer
from cairn_map.evidence.grid import Geometry, geometry_for
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_sim.evaluation.scores import Scores, scores_from
from cairn_sim.evaluation.truth_grid import Truth, box_of_cell, truths_of
from cairn_sim.robots.heads import RANGE_CAMERA
from cairn_sim.robots.record import Plan
from cairn_sim.robots.robots import ROBOTS
from cairn_sim.robots.trajectories import PoseErrors, believed
from cairn_sim.scene.movements import CLOCK_START_S
from cairn_sim.scene.scene_file import load_scene

Row = tuple[str, str, str]
EPOCH_S = 120
ROUND_S = 900.0
AFTER_ROUND_S = 150.0
"""Time after the begin of a round at which its four stops are done, and nothing has changed since."""
HOUR_S = 3600.0
PER_STOP = 6
"""Images of a stop in the room of thin things."""
KINDS = ("wall/", "slanted/", "thin/", "thin/board", "thin/leg")
GUARD_LOW_M, GUARD_HIGH_M = np.array([13.2, 3.9, -1.2]), np.array([14.2, 4.9, 0.8])
"""Box of the guard, who stands in laboratory 1 from 900 to 1800 s."""


def rounds_of(scene: str, rounds: int, *, stops: int = 4, path: str = "labs") -> Recorded:
    """Scans of the first stops of a path, visited again every 15 minutes."""
    robot = ROBOTS["tof"]
    plan = Plan(scene=load_scene(scene), robot=robot, path=path, truth="none", rounds=rounds, lasts_s=ROUND_S * rounds)
    return recorded(replace(plan, last_stop=stops))


def standing_layer(voxel_edge_m: float) -> MapLayer:
    """A layer of counts alone."""
    return MapLayer(geometry=geometry_for(voxel_edge_m=voxel_edge_m, channels=()), epoch_s=EPOCH_S)


def change_rows(smoke: bool) -> Iterator[Row]:
    """One line each: changes found and made up in the moving building, and what a static one seems to change."""
    layer = standing_layer(0.08 if smoke else 0.04)
    # Two stops and three rounds after the first one are the least in which the door and the crate are seen to change.
    rounds, lasts_s = (4, 3 * ROUND_S) if smoke else (10, HOUR_S)
    given = rounds_of("moving-building", rounds, stops=2 if smoke else 4)
    yield f"changes of the moving building, {len(given.scans)} scans, {rounds} rounds of 15 minutes", "", ""
    for sigma_m in (0.01,) if smoke else (0.0, 0.01, 0.02):
        cells = histories(measured(with_errors(given, PoseErrors(sigma_m=sigma_m)), layer), layer.geometry)
        total, guard, hours = ChangeScores(), 0, range(rounds - round(lasts_s / ROUND_S))
        for first in hours:
            after_s = first * ROUND_S + AFTER_ROUND_S
            scores, of_guard = hour_scores(cells, given, layer.geometry, after_s, lasts_s=lasts_s)
            # A guard who is there at the begin of the hour is a change of it.
            total, guard = total + scores, guard + (0 if first == 1 else of_guard)
        span, per_span = f"{len(hours)} times {lasts_s / 60:g} minutes", total.false / len(hours)
        yield f"  pose error {sigma_m * 100:g} cm, {span}", f"{per_span:.1f}", f"false each; {total}"
        yield "    where a guard came and went meanwhile", f"{guard}", "voxels reported"
    yield from _static_change_rows(smoke, layer)


def hour_scores(
    cells: Cells, given: Recorded, geometry: Geometry, after_s: float, *, lasts_s: float = HOUR_S
) -> tuple[ChangeScores, int]:
    """Scores of the changes of one hour, that begins some seconds after the scene's start; and those at the guard."""
    since_s, until_s = CLOCK_START_S + after_s, CLOCK_START_S + after_s + lasts_s
    since, until = (epoch_of(time_s, EPOCH_S) for time_s in (since_s, until_s))
    mine = {key: history.until(until) for key, history in cells.items()}
    changes = map_changes(mine, geometry, SensorModel(), since=since)
    still_s = settled_s(given, until_s)
    scores = change_scores(
        changes,
        mine,
        given.plan.scene,
        geometry,
        since_s=since_s,
        until_s=until_s,
        since=since,
        settled=epoch_of(still_s, EPOCH_S),
        camera=given.rig[RANGE_CAMERA].camera,
        looks=[look for look in given.looks if since_s - ROUND_S < look[0] <= since_s or still_s <= look[0] <= until_s],
    )
    centres_m = (np.concatenate([changes.appeared, changes.gone, changes.moved]) + 0.5) * geometry.voxel_edge_m
    at_guard = ((centres_m > GUARD_LOW_M) & (centres_m < GUARD_HIGH_M)).all(axis=1)
    return scores, int(np.count_nonzero(at_guard))


def settled_s(given: Recorded, until_s: float) -> float:
    """Time of the last keyframe before a time, but for what goes to and fro for ever."""
    times_s = [
        CLOCK_START_S + keyframe.time_s
        for each in given.plan.scene.moving
        if each.movement.repeat_s is None
        for keyframe in each.movement.keyframes
    ]
    return max(time_s for time_s in times_s if time_s <= until_s)


def _static_change_rows(smoke: bool, layer: MapLayer) -> Iterator[Row]:
    rounds = 3 if smoke else 5
    given = rounds_of("building", rounds, stops=1 if smoke else 4)
    yield (
        f"changes of the building that stands still, {len(given.scans)} scans in an hour, cut after each epoch",
        "",
        "",
    )
    for sigma_m in (0.01,) if smoke else (0.0, 0.01, 0.02):
        cells = histories(measured(with_errors(given, PoseErrors(sigma_m=sigma_m)), layer), layer.geometry)
        found = cut_anywhere(cells, layer.geometry)
        worst, moved = max(sum(counts[:2]) for counts in found), max(counts[2] for counts in found)
        yield (
            f"  pose error {sigma_m * 100:g} cm",
            f"{worst}",
            f"voxels at the worst of {len(found)} cuts; moved {moved}",
        )


def cut_anywhere(cells: Cells, geometry: Geometry) -> list[tuple[int, int, int]]:
    """Voxels that seem to have appeared, gone and moved since each of the epochs but the last."""
    epochs = sorted({epoch for history in cells.values() for epoch in history})
    found = []
    for since in epochs[:-1]:
        changes = map_changes(cells, geometry, SensorModel(), since=Epoch(since))
        found.append((len(changes.appeared), len(changes.gone), len(changes.moved)))
    return found


def static_rows(smoke: bool) -> Iterator[Row]:
    """One line each: surfaces and free space with epochs and in one sum."""
    layer = standing_layer(0.08 if smoke else 0.04)
    given = rounds_of("building", 2 if smoke else 5, stops=1 if smoke else 4)
    truths: list[Truth] = []
    yield f"the building that stands still, {len(given.scans)} scans", "", ""
    for sigma_m in (0.015,) if smoke else (0.005, 0.015, 0.03):
        cells = histories(measured(with_errors(given, PoseErrors(sigma_m=sigma_m)), layer), layer.geometry)
        if not truths:
            boxes = [box_of_cell(key, layer.geometry) for key in cells]
            # Every round goes to the same places.
            poses = [T for _, T in given.looks[: len(given.looks) // given.plan.rounds]]
            camera = given.rig[RANGE_CAMERA].camera
            truths = truths_of(given.plan.scene, boxes, camera=camera, T_map_cameras=poses, fineness=2 if smoke else 3)
        for name, mine in (("epochs", cells), ("one sum", sums(cells, layer.geometry))):
            total = sum((_scores(truth, mine, layer.geometry) for truth in truths), Scores())
            yield f"  pose error {sigma_m * 100:g} cm, {name}", f"{total.recall:.2%}", f"recall; {_detail(total)}"
    yield from _thin_rows(smoke, layer.geometry)


def thin_trial(geometry: Geometry, *, poses: int, rounds: int) -> Trial:
    """A depth camera that goes round a room of slanted and thin things, and the truth of what it could see."""
    scene, way = slanted_room(1.0), walk(1.0, poses)
    scans = depth_scans(scene, way * rounds)
    title = f"a room of slanted and thin things, {len(scans)} images, {PER_STOP} a stop"
    one_round = scans[: len(way)]
    return replace(trial_of(title, scene, one_round, RGBD, scale=1.0, edge_m=geometry.voxel_edge_m), scans=scans)


def thin_cells(trial: Trial, geometry: Geometry, *, sigma_m: float) -> Cells:
    """The map of these images with a pose error for each stop, and an epoch for each."""
    stops = [np.eye(4)] * (len(trial.scans) // PER_STOP)
    commits = []
    for n, offset in enumerate(believed(stops, PoseErrors(sigma_m=sigma_m), np.random.default_rng(3))):
        mine = trial.scans[n * PER_STOP : (n + 1) * PER_STOP]
        moved = [replace(scan, T_map_rig=offset @ scan.T_map_rig) for scan in mine]
        commits.append(Measured(n, Epoch(n), integrate_scans(moved, trial.rig, geometry, integrator=Integrator())))
    return histories(commits, geometry)


def _thin_rows(smoke: bool, geometry: Geometry) -> Iterator[Row]:
    trial = thin_trial(geometry, poses=12 if smoke else 48, rounds=1 if smoke else 3)
    yield trial.title, "", ""
    for sigma_m in (0.015,) if smoke else (0.005, 0.015, 0.03):
        cells = thin_cells(trial, geometry, sigma_m=sigma_m)
        for name, held in (("epochs", cells), ("one sum", sums(cells, geometry))):
            states = present_states(trial.truth.box, held, geometry)
            kinds = ", ".join(
                f"{kind.strip('/')} {scores_from(truth_of(trial.truth, trial.scene, kind), states).recall:.1%}"
                for kind in KINDS
            )
            total = scores_from(trial.truth, states)
            detail = f"recall; {kinds}; {_detail(total)}"
            yield f"  pose error {sigma_m * 100:g} cm, {name}", f"{total.recall:.2%}", detail


def _scores(truth: Truth, cells: Cells, geometry: Geometry) -> Scores:
    return scores_from(truth, present_states(truth.box, cells, geometry))


def _detail(total: Scores) -> str:
    return (
        f"carved {total.carved:.2%}, free found {total.recall_free:.2%}, false free {total.false_free:.3%}, "
        f"precision {total.precision:.2%}"
    )
