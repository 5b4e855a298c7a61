"""Evaluation of fusion in the simulator: images against `fusion_truth`, and the temperatures of a map.

Images are scored in several ways from the same depth, so that each row says what one step is worth:

    both cameras       as an operator sees it: what the first does not see, the second may
    one camera         with occlusion handled
    nothing hides      painted without a z-test
    not calibrated     by the data sheets' fields of view alone, as in Fig. 24 of the paper
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cairn_calib.rig.rig import Rig, Spectrum
from cairn_fusion.image_fusion.cross_view import CrossView, cross_view
from cairn_fusion.image_fusion.surface import drawn_surface, surface_of
from cairn_fusion.importers import open_source
from cairn_fusion.mapping.integrate import Integrator, integrate_scans
from cairn_fusion.recording.images import read_colour
from cairn_fusion.recording.scan import Scan
from cairn_fusion.view.telepresence import fuse, source_order, view_depth
from cairn_map.arrays import Flags
from cairn_map.evidence.evidence_map import EvidenceMap
from cairn_map.evidence.grid import geometry_for
from cairn_sim.evaluation.fusion_pictures import uncalibrated
from cairn_sim.evaluation.fusion_scores import FusionScores, fusion_scores
from cairn_sim.evaluation.fusion_truth import FusionTruth, fusion_truth
from cairn_sim.evaluation.overlay_scores import intersection_over_union
from cairn_sim.evaluation.temperature_scores import TemperatureScores, is_body, is_pipe, temperature_scores
from cairn_sim.robots.record import Plan, scans_of, shots_of
from cairn_sim.scene.scene import Scene

HOT_CUP = 13
"""Number of the class in `label_mapping.json`."""
HOT_SHARE = 0.5
"""A pixel is hot from half the way up from the frame's median to the label's hottest; ambient is 13 deg C, cups 75."""
HOT_AT_LEAST_K = 5.0
"""Above the median: a label whose thing has cooled down says nothing."""
AROUND_PX = 40
"""Distance from the label within which hot pixels belong to it; other hot things have labels of their own."""

WAYS = ("both cameras", "one camera", "nothing hides", "not calibrated")
MAPPINGS: Mapping[str, Integrator] = {
    "as cairn maps": Integrator(),
    "edges painted": Integrator(temperature_step_k=math.inf),
    "nothing hides": Integrator(temperature_step_k=math.inf, hidden_behind_m=math.inf),
}


@dataclass(frozen=True, slots=True, eq=False)
class ScoredView:
    """One camera of one scan."""

    scan: Scan
    fused: CrossView
    truth: FusionTruth
    scores: Mapping[str, FusionScores]
    """By way."""


def plan_scans(plan: Plan, rig: Rig, *, step: int) -> Iterator[Scan]:
    """Every `step`-th scan of a plan, as its sensors see it, with true poses."""
    shots = [shot for shot in shots_of(plan) if shot.scan % step == step // 2]
    for _, scan, _ in scans_of(plan, shots, rig):
        yield scan


def scored_view(scene: Scene, rig: Rig, scan: Scan, camera: str) -> ScoredView:
    """A camera's fused image and its scores, in all ways."""
    unit = "K" if rig[camera].spectrum is Spectrum.COLOUR else "of 255"
    images = source_order(scan, rig, camera)
    now = scene.at(scan.time_s)
    truth = fusion_truth(now, rig, camera, list(images), T_map_rig=scan.T_map_rig, range_camera=scan.range_camera)
    surface = surface_of(scan, rig)
    drawn = {name: drawn_surface(surface, rig, name) for name in (camera, *images)}
    depth = view_depth(scan, rig, camera, drawn[camera])
    first = dict(list(images.items())[:1])
    fused = {
        WAYS[0]: cross_view(depth, rig, images, drawn=drawn, range_camera=scan.range_camera),
        WAYS[1]: cross_view(depth, rig, first, drawn=drawn, range_camera=scan.range_camera),
        WAYS[2]: cross_view(depth, rig, first, drawn={}, range_camera=scan.range_camera),
        WAYS[3]: fuse(scan, uncalibrated(rig), camera),
    }
    scores = {way: fusion_scores(each, truth, unit=unit) for way, each in fused.items()}
    return ScoredView(scan, fused[WAYS[0]], truth, scores)


def mapped_scores(
    scene: Scene, rig: Rig, stops: Sequence[Sequence[Scan]], *, voxel_edge_m: float
) -> dict[str, dict[str, TemperatureScores]]:
    """Scores of a map's temperatures by way of mapping: bodies, pipes, behind glass, in mirrors, everything else."""
    geometry = geometry_for(voxel_edge_m=voxel_edge_m)
    eyes_m = [scans[0].T_map_rig[:3, 3] for scans in stops]
    found = {}
    for name, integrator in MAPPINGS.items():
        total = EvidenceMap(geometry)
        for scans in stops:
            total.merge(integrate_scans(scans, rig, geometry, integrator=integrator))
        groups = {"bodies": is_body, "pipes": is_pipe}
        found[name] = temperature_scores(scene, total.packed(), geometry, groups=groups, eyes_m=eyes_m)
    return found


@dataclass(frozen=True, slots=True, eq=False)
class LabelledFrame:
    """One frame with a hot cup."""

    frame: str
    scan: Scan
    rig: Rig
    fused: CrossView
    label: Flags
    given_iou: float
    """Intersection over union of the data set's own registration."""
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
