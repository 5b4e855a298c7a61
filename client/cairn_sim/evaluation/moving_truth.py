"""The truth in voxels of a scene that moves: at a time, and between two.

    solid_masks(scene.at(time_s), box)      what is there at a time            `truth_grid`
    truths_at                               ... and what of it a camera on its way could have known at that time
    changed_voxels                          what appeared and what went between two times

Times are UTC, as of scans: `CLOCK_START_S` is time 0 of a scene file.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np

from cairn_calib.rig.lidar import AnyCamera
from cairn_calib.rig.poses import Transform
from cairn_calib.rig.rig import TIME_OF_FLIGHT_REACH_M
from cairn_map.arrays import Flags
from cairn_map.errors import BadInputError
from cairn_sim.evaluation.truth_grid import (
    FINENESS,
    Marks,
    Truth,
    VoxelBox,
    near_flags,
    seen_marks,
    solid_masks,
    solid_samples,
    truth_from,
)
from cairn_sim.scene.scene import Scene


@dataclass(frozen=True, slots=True, eq=False)
class ChangedVoxels:
    """Difference of a box's voxels between two times; (X, Y, Z) arrays.

    The numbers of the voxels in the map's grid are `np.argwhere(changed.appeared) + changed.box.low`.
    """

    box: VoxelBox
    samples_before: Marks
    """0 to 64 of the samples in solids, at the earlier time."""
    samples_after: Marks
    near: Flags
    """True where a sample of the voxel, or of one of its 26 neighbours, changed; a change found elsewhere is false."""

    @property
    def appeared(self) -> Flags:
        """Voxels that were empty, and touch a solid now."""
        return np.asarray((self.samples_before == 0) & (self.samples_after > 0))

    @property
    def went(self) -> Flags:
        """Voxels that touched a solid, and are empty now."""
        return np.asarray((self.samples_before > 0) & (self.samples_after == 0))


def changed_voxels(scene: Scene, box: VoxelBox, *, since_s: float, until_s: float) -> ChangedVoxels:
    """Voxels of a box that differ between two times; one that came and went between them does not."""
    rim = box.grown(1)
    before, after = (solid_masks(scene.at(time_s), rim) for time_s in (since_s, until_s))
    inner = (slice(1, -1),) * 3
    return ChangedVoxels(box, solid_samples(before[inner]), solid_samples(after[inner]), near_flags(before != after))


def truths_at(
    scene: Scene,
    boxes: Sequence[VoxelBox],
    *,
    time_s: float,
    camera: AnyCamera,
    T_map_cameras: Sequence[Transform],
    times_s: Sequence[float],
    max_range_m: float = TIME_OF_FLIGHT_REACH_M,
    fineness: int = FINENESS,
) -> list[Truth]:
    """The truth about each box at a time, for a camera that looked at many.

    A look counts for the voxels that have not changed since, and not for later times: what was seen before a crate was
    put there says nothing of the crate. In a scene in which nothing moves it is `truths_of` of the looks until then.

    Args:
        scene: of all times.
        boxes: whose voxels to judge.
        time_s: of the truth, UTC.
        camera: its lens.
        T_map_cameras: poses, each (4, 4).
        times_s: of these looks, UTC, in any order; looks after `time_s` are left out.
        max_range_m: surfaces beyond it are not seen, nor the way there.
        fineness: rays along a pixel's edge.

    Raises:
        BadInputError: a camera stands inside a solid, or the numbers make no sense.
    """
    if len(T_map_cameras) != len(times_s):
        raise BadInputError("bad_view", f"expected a time for each pose, got {len(times_s)} for {len(T_map_cameras)}")
    rims = [box.grown(1) for box in boxes]
    now = scene.at(time_s)
    masks = [solid_masks(now, rim) for rim in rims]
    marks = [np.zeros(rim.shape, np.uint8) for rim in rims]
    looks = sorted(
        ((at_s, T) for at_s, T in zip(times_s, T_map_cameras, strict=True) if at_s <= time_s), key=lambda look: look[0]
    )
    # Looks at one state of the scene are cast together: `at` gives the same object for as long as nothing moves.
    for then, group in groupby(looks, key=lambda look: scene.at(look[0])):
        poses = [T for _, T in group]
        seen = seen_marks(then, rims, camera=camera, T_map_cameras=poses, max_range_m=max_range_m, fineness=fineness)
        for n, rim in enumerate(rims):
            if then is not now:
                seen[n][solid_masks(then, rim) != masks[n]] = 0
            np.maximum(marks[n], seen[n], out=marks[n])
    return [truth_from(box, mask, mark) for box, mask, mark in zip(boxes, masks, marks, strict=True)]
