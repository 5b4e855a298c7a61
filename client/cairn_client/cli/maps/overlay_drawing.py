"""A map over an image of a rig's colour camera: for `cairn map render --over` and `cairn telepresence --map`."""

from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from cairn_calib.rig.rig import Rig, Spectrum
from cairn_client.folders.map_folder import FolderMap
from cairn_fusion.image_fusion.mirror_labels import mirror_pixels
from cairn_fusion.image_fusion.surface import live_range, sight_of
from cairn_fusion.recording.scan import Scan
from cairn_fusion.view.overlay import EXACT, Live, Overlay, OverlayMode, OverlayStyle, draw_overlay, with_overlay_legend
from cairn_map.errors import BadInputError
from cairn_map.render.map_render import MapRenderer
from cairn_map.render.pose_spread import PoseSpread

THREADS = 2


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MapOverlay:
    """Draws one map over the images of one rig, scan by scan."""

    rig: Rig
    map: FolderMap
    style: OverlayStyle
    camera: str | None = None
    """Name of the colour camera; None: the first that has an image."""
    spread: PoseSpread = EXACT
    """Uncertainty of `T_map_rig`: [rotation (rad), translation (m)], rig frame."""
    renderer: MapRenderer = field(default_factory=lambda: MapRenderer(threads=THREADS))

    def draw(self, scan: Scan) -> Overlay:
        """The map over one image of a scan; ages count from the scan, if it is later than the map.

        Raises:
            BadInputError: kind `unknown_camera`: the camera took no image then.
        """
        name = self.camera_of(scan)
        mounted, ages = self.rig[name], self.map.ages
        beyond = mirror_pixels(scan, self.rig, self.map.snapshot, renderer=self.renderer)
        live = Live(
            rgb=np.asarray(scan.colour[name]),
            range_m=live_range(scan, self.rig, camera=name, beyond=beyond),
            sight=sight_of(mounted.camera),
            T_map_camera=scan.T_map_rig @ mounted.transform,
            spread=self.spread.seen_from(mounted.transform),
        )
        if ages is not None:
            ages = replace(ages, now=max(ages.now, scan.time_s))
        return draw_overlay(self.renderer, self.map.snapshot, live, self.style, ages)

    def view(self, scan: Scan) -> npt.NDArray[np.uint8]:
        """(H + legend, W, 3) sRGB: the picture of a scan; raises as `draw`."""
        return with_overlay_legend(self.draw(scan).picture, self.style.colours)

    def camera_of(self, scan: Scan) -> str:
        """Camera whose image the map is drawn over.

        Raises:
            BadInputError: kind `unknown_camera`: there is none.
        """
        names = self.rig.of_spectrum(Spectrum.COLOUR)
        name = self.camera or next((name for name in names if name in scan.colour), None)
        if name is None or name not in scan.colour:
            has = ", ".join(scan.colour) or "none"
            raise BadInputError("unknown_camera", f"the scan has no colour image of {name}; it has {has}")
        return name


def about(drawn: Overlay) -> str:
    """Summary of a drawing in a few words, for people."""
    if drawn.withheld is not None:
        return f"withheld, {drawn.withheld}"
    visible, alone = ((drawn.front_modes == mode).mean() for mode in (OverlayMode.VISIBLE, OverlayMode.MAP_ONLY))
    return f"visible {visible:.0%}, see-through {drawn.through.mean():.0%}, map only {alone:.0%}"


def modes_of(drawn: Overlay) -> dict[str, npt.NDArray[np.generic]]:
    """By name: `modes` (H, W) uint8 `overlay.Mode`, and `through` (H, W), whether something is behind what is seen."""
    return {"modes": drawn.modes, "through": drawn.through}
