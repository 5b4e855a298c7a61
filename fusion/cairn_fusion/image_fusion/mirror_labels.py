"""Mirror labels: beams that went on behind a surface of the map, which other robots saw from elsewhere.

    camera ----> wall on the map ---- 1 m or more ----> "surface": the reflection in the mirror on the wall

A range pixel is labelled if a certain surface of the map cuts its beam a metre or more before its end, and most range
pixels around it are cut too.

Measured, at 8 cm and 5 mm to 3 cm of noise, with poses exact or off by 2 cm and 0.5 degrees alike:

- Map by robots that saw the wall from behind: 77 % of the mirror's pixels are labelled on 10 views of it, no others.
- 44 ordinary scans of the simulated building, of which few show a mirror: 79 % of the mirrors' pixels, and 0.35 % of
  all other pixels, which then are as many: 47 % of the labels are right.
- Map that contains the reflections too, which took the wall out: 27 % of the mirrors' pixels.

A thing that was mapped and is gone now is labelled too, until the map knows; panes that are on no map are not found. So
the labels are for viewing alone: too few, and too often wrong, for evidence.

One rig's own images show neither mirrors nor glass. In the simulated building light through a pane returns with an
amplitude, for its range and slant, that ordinary surfaces have too (area under the ROC 0.62; mirrors 0.74). Steps in
depth that a thermal camera does not see are as common elsewhere (along a row 85 % behind glass, 94 % in mirrors, 83 %
of all others). Two colour cameras agree with the range, because all their light takes the same path. A thing behind
glass that reads as cold as the pane may have cooled down. The end of a beam does not tell either: floors, ceilings and
walls of the next room lie where the mirror shows those of this one.
"""

import cv2
import numpy as np

from cairn_calib.rig.rig import Rig
from cairn_fusion.image_fusion.surface import sight_of
from cairn_fusion.recording.scan import Scan
from cairn_map.arrays import Flags
from cairn_map.queries.map_snapshot import MapSnapshot
from cairn_map.render.camera_rays import middles
from cairn_map.render.map_render import MapRenderer

SURE = 0.7
"""Least probability of the surface that a beam went through: a lower one is grazed, or was seen to be gone."""
THROUGH_M = 1.0
"""Least length of a beam behind a surface of the map: a shorter one only grazed it, or the pose is a little off."""
NEAR_M = 0.3
"""Least distance of the surface from the camera: a nearer one may be the robot itself."""
ROWS_MAX = 240
"""Rows up to which every pixel is tested; of finer images every second, or fewer: mirrors are larger."""
WINDOW_PX = 9
"""Edge of the window in which labels must agree, range pixels."""
SHARE = 0.8
"""Least share of labelled pixels among those with a range in a window: a mirror is larger than a speck."""


def mirror_pixels(scan: Scan, rig: Rig, snapshot: MapSnapshot, *, renderer: MapRenderer | None = None) -> Flags:
    """(H, W) true for pixels of the scan's range camera that show a reflection, as far as a map proves it.

    Args:
        scan: with the pose `T_map_rig` in the map's frame.
        rig: its rig.
        snapshot: the map, with surfaces seen from other places.
        renderer: keeps its tables from scan to scan.

    Raises:
        BadInputError: an image does not fit its camera.
    """
    mounted, renderer = rig[scan.range_camera], renderer or MapRenderer()
    range_m = np.asarray(mounted.true_ranges(scan.range_m, scan.amplitude), np.float32)
    known = np.isfinite(range_m)
    if not known.any():
        return known
    # Stage 1: the part of each beam that a surface of the map may not cut, from near the camera to 1 m before its end.
    T, step = scan.T_map_rig @ mounted.transform, max(1, range_m.shape[0] // ROWS_MAX)
    sight, looked_m = sight_of(mounted.camera).every(step), middles(range_m, step)
    asked = np.isfinite(looked_m)
    start_m = np.where(asked, np.float32(NEAR_M), np.float32(np.nan))
    end_m = np.maximum(looked_m - np.float32(THROUGH_M), 0)
    # Stage 2: the first surface of the map in that part, if it is certain enough.
    reach_m = max(float(range_m[known].max()), 2 * NEAR_M)
    met = renderer.nearest(snapshot, sight, T, range_max_m=reach_m, between_m=(start_m, end_m))
    through = met.hit & (renderer.probability(snapshot, met) >= SURE)
    # Stage 3: only where most of the pixels around agree; then at full resolution.
    window = (WINDOW_PX // step | 1,) * 2
    around, seen = (np.asarray(cv2.blur(each.astype(np.float32), window)) for each in (through, asked))
    found = through & asked & (around > SHARE * seen)
    height, width = known.shape
    return np.asarray(found.repeat(step, axis=0).repeat(step, axis=1)[:height, :width] & known)
