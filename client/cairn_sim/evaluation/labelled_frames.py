"""Hot things on real frames against hand labels: MM5, whose depth, colour and thermal its authors registered.

Each label says which pixels of the colour image show a hot cup. Compared are the hot pixels of the thermal image as the
set has it, and as `fuse` carries it to the colour image through range; both by intersection over union with the label.
The set's cameras are one raster, so that the two can only differ where range says that nothing is to be painted.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cairn_calib.rig.rig import Rig
from cairn_fusion.image_fusion.cross_view import CrossView
from cairn_fusion.importers import open_source
from cairn_fusion.recording.images import read_colour
from cairn_fusion.recording.scan import Scan
from cairn_fusion.view.telepresence import fuse
from cairn_map.arrays import Flags
from cairn_sim.evaluation.overlay_scores import intersection_over_union

HOT_CUP = 13
"""Of `label_mapping.json`."""
HOT_SHARE = 0.5
"""A pixel is hot from half the way up from the frame's median to the label's hottest; ambient is 13 deg C, cups 75."""
HOT_AT_LEAST_K = 5.0
"""Above the median: a label whose thing has cooled down says nothing."""
AROUND_PX = 40
"""How far from the label hot pixels belong to it; other hot things have labels of their own."""


@dataclass(frozen=True, slots=True, eq=False)
class LabelledFrame:
    """One frame with a hot cup."""

    frame: str
    scan: Scan
    rig: Rig
    fused: CrossView
    label: Flags
    given_iou: float
    """Of the set's own registration."""
    fused_iou: float


def labelled_frames(folder: Path) -> Iterator[LabelledFrame]:
    """The frames of an MM5 folder that show a hot cup.

    Raises:
        BadInputError: it is no such folder, or an image is damaged.
    """
    source = open_source(folder)
    names = sorted(path.name.partition(".")[0] for path in (folder / "frames" / "A").glob("*.label.png"))
    frames = {name: index for index, name in enumerate(names)}
    for name, index in frames.items():
        label = read_colour(folder / "frames" / "A" / f"{name}.label.png")[..., 0] == HOT_CUP
        if not label.any():
            continue
        scan = source.scan(index)
        kelvin = scan.thermal["thermal"]
        ambient, hottest = float(np.nanmedian(kelvin)), float(np.nanmax(kelvin[label]))
        if hottest - ambient < HOT_AT_LEAST_K:
            continue
        from_k = ambient + HOT_SHARE * (hottest - ambient)
        fused, near = fuse(scan, source.rig, "colour"), _around(label)
        given = near & (kelvin > from_k)
        ours = near & fused.ok & (fused.values[..., 0] > from_k)
        ious = (intersection_over_union(each, label) for each in (given, ours))
        yield LabelledFrame(name, scan, source.rig, fused, label, *ious)


def _around(label: Flags) -> Flags:
    """(H, W) the label's box, wider by `AROUND_PX`."""
    rows, columns = np.flatnonzero(label.any(axis=1)), np.flatnonzero(label.any(axis=0))
    near = np.zeros_like(label)
    top, left = max(rows[0] - AROUND_PX, 0), max(columns[0] - AROUND_PX, 0)
    near[top : rows[-1] + AROUND_PX + 1, left : columns[-1] + AROUND_PX + 1] = True
    return near
