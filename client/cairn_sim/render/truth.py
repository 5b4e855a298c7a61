"""The truth behind each pixel of an image: how far, of what, how warm, and which other cameras see it.

range_m         (H, W) float64   metres along the pixel's centre ray to the first surface, glass and mirrors too; inf
solid           (H, W) int16     number of the solid there in the scene; -1 for none
temperature_k   (H, W) float32   of that surface, true and not apparent; NaN for none
way             (H, W) uint8     how visible and near infrared light goes on from there: 0 it does not, bit 0 through
                                 glass, bit 1 round a mirror; 0 for a thermal camera, which sees the pane
visible         (H, W) uint32    bit n: the rig's camera number n sees that surface point; its own bit always
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from cairn_calib.rig.poses import Transform, transform_points
from cairn_calib.rig.rig import Rig
from cairn_sim.render.rays import visible_from
from cairn_sim.render.render import view_of
from cairn_sim.scene.scene import Scene


@dataclass(frozen=True, slots=True, eq=False)
class CameraTruth:
    """The truth behind one image; the arrays of the module's picture."""

    range_m: npt.NDArray[np.float64]
    solid: npt.NDArray[np.int16]
    temperature_k: npt.NDArray[np.float32]
    way: npt.NDArray[np.uint8]
    visible: npt.NDArray[np.uint32]

    def write(self, path: Path) -> None:
        """A compressed NPZ file with an array of each name, the same bytes for the same truth."""
        np.savez_compressed(
            path,
            range_m=self.range_m,
            solid=self.solid,
            temperature_k=self.temperature_k,
            way=self.way,
            visible=self.visible,
        )


def camera_truth(scene: Scene, rig: Rig, camera: str, *, T_map_rig: Transform) -> CameraTruth:
    """The truth behind the image of one camera of a rig at its true pose.

    Raises:
        BadInputError: no such camera, or it stands inside a solid.
    """
    view = view_of(scene, rig, camera, T_map_rig=T_map_rig)
    hits, shape = view.hits, view.shape
    with np.errstate(invalid="ignore"):  # a ray that meets nothing has no point
        points = transform_points(
            view.T_map_camera, view.camera.rays() * np.where(hits.solid < 0, np.nan, hits.range_m).reshape(*shape, 1)
        )
    visible = np.zeros(shape, np.uint32)
    for n, name in enumerate(rig.cameras):
        seen = (
            visible_from(scene, points, rig, name, T_map_rig=T_map_rig) if name != camera else ~np.isnan(points[..., 0])
        )
        visible |= seen.astype(np.uint32) << np.uint32(n)
    return CameraTruth(
        range_m=hits.range_m.reshape(shape),
        solid=hits.solid.astype(np.int16).reshape(shape),
        temperature_k=scene.temperature_k_at(points, hits.solid.reshape(shape)).astype(np.float32),
        way=hits.way.reshape(shape),
        visible=visible,
    )
