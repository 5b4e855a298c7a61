"""The finished map against the truth: which cells, from where, and their scores.

The truth is looked at from every `POSE_STEP`-th pose of the range cameras, and compared in as many cells as fit
`VOXELS_MAX`, evenly chosen among those that the map has: all of them at 8 and 4 cm, 16 at 2 cm.
"""

from collections.abc import Iterator, Sequence

import numpy as np

from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.grid import CellKey, Geometry
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_sim.evaluation.scores import Scores, scores_of
from cairn_sim.evaluation.truth_grid import box_of_cell, seen_marks, solid_masks, truth_from
from cairn_sim.experiment.figures import TruthFigures
from cairn_sim.experiment.robots import ExperimentRobot

POSE_STEP = 5
"""Step between the scans used for the truth: every fifth of a stop's 36 looks everywhere; a scan costs 50 ms."""
FINENESS = 2
"""Rays along a pixel's edge."""
VOXELS_MAX = 1 << 28
"""Voxels of all boxes compared at once; a byte each."""
POSES_AT_ONCE = 16


class TruthGrid:
    """Truth of the cells that cameras could have seen, and the scores of those cells, one by one."""

    def __init__(self, robots: Sequence[ExperimentRobot], geometry: Geometry, keys: Sequence[CellKey]) -> None:
        """Args: robots: each with a truth, all in one scene. keys: cells of the map, rising."""
        self._geometry = geometry
        room = max(1, VOXELS_MAX // geometry.side**3)
        chosen = np.unique(np.linspace(0, len(keys) - 1, min(room, len(keys))).round().astype(int))
        self._rims = {keys[n]: box_of_cell(keys[n], geometry).grown(1) for n in chosen}
        self._marks = {key: np.zeros(rim.shape, np.uint8) for key, rim in self._rims.items()}
        self._views = [
            (robot, truth, poses[at : at + POSES_AT_ONCE])
            for robot in robots
            if (truth := robot.truth) is not None
            for poses in [truth.T_map_cameras[::POSE_STEP]]
            for at in range(0, len(poses), POSES_AT_ONCE)
        ]
        self._scene = self._views[0][1].scene
        self._scores = Scores()

    def __len__(self) -> int:
        """Steps of `look`."""
        return len(self._views)

    def look(self) -> Iterator[None]:
        """Cast the rays, a few poses a step."""
        rims = list(self._rims.values())
        for robot, truth, poses in self._views:
            camera = robot.rig[robot.range_camera].camera
            marks = seen_marks(truth.scene, rims, camera=camera, T_map_cameras=poses, fineness=FINENESS)
            for total, seen in zip(self._marks.values(), marks, strict=True):
                np.maximum(total, seen, out=total)
            yield

    def compare(self, key: CellKey, evidence: Evidence, model: SensorModel) -> None:
        """Add a cell's scores, if it is one of the chosen."""
        if key in self._rims:
            truth = truth_from(
                box_of_cell(key, self._geometry), solid_masks(self._scene, self._rims[key]), self._marks.pop(key)
            )
            self._scores += scores_of(truth, {key: evidence}, self._geometry, model=model)

    def figures(self) -> TruthFigures:
        """Figures of all cells scored so far."""
        poses = sum(len(poses) for _, _, poses in self._views)
        return TruthFigures(cells=len(self._rims), poses=poses, scores=self._scores)
