"""Mirrors, as far as a map can tell: beams that went on behind a surface which others saw from elsewhere.

    camera ----> wall that somebody mapped ---- 1 m or more ----> "surface": what the mirror on the wall shows

One rig's own images do not tell, neither mirrors nor glass. In the simulator's building light through a pane returns
with an amplitude, for its range and slant, that ordinary surfaces have too (area under the ROC 0.62; of mirrors 0.74);
steps in depth that a thermal camera does not see are as common elsewhere (along a row 85 % behind glass, 94 % in
mirrors, 83 % of all others); two colour cameras agree with the range, because all their light goes the same way; and
a thing behind glass that reads as cold as the pane may just as well have cooled down. Nor does where a beam ends tell:
floors, ceilings and walls of the next room lie where the mirror shows those of this one.

What a map tells (8 cm, 5 mm to 3 cm of noise; with poses off by 2 cm and 0.5 degrees alike): where it is by robots
that saw the wall from behind, 77 % of the mirror's pixels are labelled on 10 looks into it, and no other. On 44
ordinary scans of the building, few of which show a mirror, 79 % are, and 0.35 % of all other pixels, which then are as
many: 47 % of the labels are right. Of a map that has all that the mirror shows, too, 27 % are labelled, because that
took the wall out. What was mapped and is gone now is labelled, too, until a map has that. Panes nobody maps are not
found. Too little, and too often wrong, for evidence: a label BEYOND is for the eye alone.
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
"""Probability of what a beam went through: less is grazed, or was seen to be gone."""
THROUGH_M = 1.0
"""A beam that goes on for less behind a surface of the map only grazed it, or the pose is a little off."""
NEAR_M = 0.3
"""What is nearer to the camera may be the robot itself."""
ROWS_MAX = 240
"""Of finer images every second pixel is looked at, or fewer: what is looked for is larger."""
WINDOW_PX = 9
SHARE = 0.8
"""Of the pixels with a range in a window around one, that say the same: a mirror is larger than a fleck."""


def mirror_pixels(scan: Scan, rig: Rig, snapshot: MapSnapshot, *, renderer: MapRenderer | None = None) -> Flags:
    """(H, W) whether a pixel of the scan's range camera shows what is round a mirror, as far as a map can tell.

    Args:
        scan: with the pose `T_map_rig` in the map's frame.
        rig: its rig.
        snapshot: the map, of what was seen from elsewhere too.
        renderer: keeps what it worked out between scans.

    Raises:
        BadInputError: an image does not fit its camera.
    """
    mounted, renderer = rig[scan.range_camera], renderer or MapRenderer()
    range_m = np.asarray(mounted.true_ranges(scan.range_m, scan.amplitude), np.float32)
    known = np.isfinite(range_m)
    if not known.any():
        return known
    T, step = scan.T_map_rig @ mounted.transform, max(1, range_m.shape[0] // ROWS_MAX)
    sight, looked_m = sight_of(mounted.camera).every(step), middles(range_m, step)
    asked = np.isfinite(looked_m)
    start_m = np.where(asked, np.float32(NEAR_M), np.float32(np.nan))
    end_m = np.maximum(looked_m - np.float32(THROUGH_M), 0)
    reach_m = max(float(range_m[known].max()), 2 * NEAR_M)
    met = renderer.nearest(snapshot, sight, T, range_max_m=reach_m, between_m=(start_m, end_m))
    through = met.hit & (renderer.probability(snapshot, met) >= SURE)
    window = (WINDOW_PX // step | 1,) * 2
    around, seen = (np.asarray(cv2.blur(each.astype(np.float32), window)) for each in (through, asked))
    found = through & asked & (around > SHARE * seen)
    height, width = known.shape
    return np.asarray(found.repeat(step, axis=0).repeat(step, axis=1)[:height, :width] & known)
