"""What the range camera says of each of its own pixels: a range that can be trusted, or why there is none.

    OK          a range within limits
    NO_RANGE    nothing came back, or from beyond the limits
    SATURATED   too much light came back: retroreflecting tape, bare metal face to face
    FLYING      a mixture of a near and a far surface (`flying_kernels`)

What a range cannot tell is not told: behind glass and in mirrors a time-of-flight camera measures where its light went.
Where a map is at hand it may tell (`beyond_labels`).
"""

import numpy as np

from cairn_calib.rig.rig import Rig
from cairn_fusion.mapping.beam_returns import full_pixels
from cairn_fusion.mapping.flying_kernels import flying_pixels
from cairn_fusion.recording.scan import Scan
from cairn_fusion.transfer.transfer import Label
from cairn_map.arrays import Labels

MIN_RANGE_M = 0.1
MAX_RANGE_M = 10.0
FLYING_STEP_M = 0.05
"""As `integrate.Integrator` has them."""
AMPLITUDE_MAX = 65535


def range_labels(
    scan: Scan,
    rig: Rig,
    *,
    min_range_m: float = MIN_RANGE_M,
    max_range_m: float = MAX_RANGE_M,
    flying_step_m: float = FLYING_STEP_M,
) -> Labels:
    """(H, W) uint8 `Label` of each pixel of the scan's range camera: OK, NO_RANGE, SATURATED or FLYING.

    Args:
        scan: its range and, to know saturated pixels, amplitude are looked at.
        rig: with the range camera.
        min_range_m: nearer returns are not believed.
        max_range_m: nor farther ones.
        flying_step_m: how far a flying pixel must be from both its neighbours; infinite: none flies.
    """
    range_m = rig[scan.range_camera].true_ranges(scan.range_m, scan.amplitude)
    labels = np.full(range_m.shape, Label.OK, np.uint8)
    labels[flying_pixels(range_m, flying_step_m)] = Label.FLYING
    # A comparison with NaN is false.
    labels[~((range_m >= min_range_m) & (range_m <= max_range_m))] = Label.NO_RANGE
    labels[full_pixels(scan, rig[scan.range_camera])] = Label.SATURATED
    if scan.amplitude is not None:  # no count is higher: full, whatever the rig says
        labels[scan.amplitude == AMPLITUDE_MAX] = Label.SATURATED
    return labels
