"""Scores of a map's temperatures: voxels of bodies and pipes against the radiation of their surfaces.

    truth     what a thermal camera reads of the surfaces in a voxel: from the coldest to the warmest of them
    error     how far the voxel's mean is from that

A voxel is 'on' a solid whose surface is nearest to its centre, and passes through it. Edges are among them. Range
cameras look through glass that thermal cameras see: what stood behind some is counted once more, by itself; and so is
what stands where a mirror shows something to them, as in the next room.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from cairn_map.arrays import Flags, Floats, Int32s
from cairn_map.evidence.channels import ChannelKind
from cairn_map.evidence.evidence_map import Diff
from cairn_map.evidence.grid import Geometry, voxels_in_cell
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_sim.evaluation.fusion_truth import HIDDEN_M
from cairn_sim.render.rays import POINTS_OF_BUNDLE, cast_directions
from cairn_sim.render.sensors import ThermalSensor
from cairn_sim.scene.distance_kernels import nearest_solids
from cairn_sim.scene.scene import Scene
from cairn_sim.scene.solid_kernels import second_at

BODIES = ("person", "technician", "operator", "chemist", "casualty", "fire fighter")
PIPES = ("pipe", "riser")
BEHIND_GLASS = "behind glass"
IN_MIRROR = "in a mirror"
OTHERS = "all the others"
MIRROR_EDGES = 4.0
"""By how many of its edges a voxel may be off from what a mirror shows: range noise, and slanted surfaces."""
SAMPLES = 3
"""Places along a voxel's edge at which its surfaces are looked for."""


@dataclass(frozen=True, slots=True, eq=False)
class TemperatureScores:
    """Temperature errors of the mapped voxels on some solids."""

    errors_k: Floats
    """(N,) of those with a temperature."""
    without: int
    """Occupied, and without a temperature."""

    @property
    def median_k(self) -> float:
        """NaN for none."""
        return float(np.median(self.errors_k)) if len(self.errors_k) else math.nan

    @property
    def p95_k(self) -> float:
        """95th percentile of the errors, kelvin; NaN without voxels."""
        return float(np.quantile(self.errors_k, 0.95)) if len(self.errors_k) else math.nan

    @property
    def known(self) -> float:
        """Share of the voxels that have a temperature."""
        total = len(self.errors_k) + self.without
        return len(self.errors_k) / total if total else math.nan


def is_body(name: str) -> bool:
    """True for the name of a person's solid."""
    return name.split("/")[0].startswith(BODIES) or "person" in name.split("/")[0]


def is_pipe(name: str) -> bool:
    """True for the name of a pipe."""
    return any(word in name for word in PIPES)


def temperature_scores(
    scene: Scene,
    diff: Diff,
    geometry: Geometry,
    *,
    groups: Mapping[str, Callable[[str], bool]],
    eyes_m: Sequence[Floats] = (),
) -> dict[str, TemperatureScores]:
    """The scores of all occupied voxels on solids of each group, and of all groups as `all`.

    With places to look from, of those among them that some of these see through glass, of those where some see
    something in a mirror, and of the others, too.

    Args:
        scene: that was mapped.
        diff: the map's evidence by cell, `EvidenceMap.packed()`.
        geometry: of the map; it has a temperature channel.
        groups: which names of solids are in which; at most one each.
        eyes_m: (3,) each, map frame: where range was measured from.
    """
    names = list(groups)
    member = np.array([[chosen(solid.name) for solid in scene.solids] for chosen in groups.values()])
    anyone: Flags = np.logical_or.reduce(member)
    centres, kelvin = _occupied(diff, geometry)
    nearest = scene.nearest_solid(centres)
    on = anyone[nearest]
    centres, kelvin, nearest = centres[on], kelvin[on], nearest[on]
    low, high = _surface_temperatures(scene, centres, geometry.voxel_edge_m, anyone)
    error = np.maximum(np.maximum(low - kelvin, kelvin - high), 0.0)
    chosen = {name: member[n][nearest] for n, name in enumerate(names)} | {"all": np.ones(len(nearest), bool)}
    if eyes_m:
        behind = np.logical_or.reduce([_behind_glass(scene, centres, eye_m) for eye_m in eyes_m])
        shown = [_in_mirror(scene, centres, eye_m, geometry.voxel_edge_m) for eye_m in eyes_m]
        mirrored = np.logical_or.reduce(shown) & ~behind
        chosen |= {BEHIND_GLASS: behind, IN_MIRROR: mirrored, OTHERS: ~behind & ~mirrored}
    through, known = np.isfinite(low), np.isfinite(kelvin)
    return {
        name: TemperatureScores(errors_k=error[of & through & known], without=int((of & through & ~known).sum()))
        for name, of in chosen.items()
    }


def apparent_k(scene: Scene, points: Floats, solids: Int32s) -> Floats:
    """(N,) what a thermal camera reads of solids' surfaces at (N, 3) points: their own, and what they mirror."""
    sensor, surfaces = ThermalSensor(), scene.surfaces
    second = second_at(np.ascontiguousarray(points), solids, scene.shapes)
    emissivity = surfaces.emissivity[solids, second].astype(np.float64)
    own = sensor.counts_of(surfaces.temperature_k[solids, second].astype(np.float64))
    return sensor.kelvin_of(emissivity * own + (1 - emissivity) * sensor.counts_of(np.array(scene.ambient_k)))


def _occupied(diff: Diff, geometry: Geometry) -> tuple[Floats, Floats]:
    """(N, 3) centres of occupied voxels, metres, and (N,) their temperatures, kelvin; NaN for none."""
    channel = next(each for each in geometry.channels if each.kind is ChannelKind.TEMPERATURE)
    planes = geometry.planes_of(channel.name)
    centres: list[Floats] = [np.empty((0, 3))]
    kelvin: list[Floats] = [np.empty(0)]
    for key, evidence in diff.items():
        occupied = SensorModel().log_odds(evidence.counts) > 0
        sums = np.zeros((len(evidence), 2))
        sums[evidence.sampled] = evidence.samples[:, [planes.start, planes.stop - 1]]
        with np.errstate(invalid="ignore"):
            mean = sums[:, 0] / sums[:, 1] * channel.step + channel.zero
        voxels = voxels_in_cell(evidence.voxels[occupied], key, geometry)
        centres.append(np.asarray((voxels + 0.5) * geometry.voxel_edge_m, dtype=np.float64))
        kelvin.append(np.asarray(mean[occupied], dtype=np.float64))
    return np.concatenate(centres), np.concatenate(kelvin)


def _behind_glass(scene: Scene, centres: Floats, eye_m: Floats) -> Flags:
    """(N,) whether glass, and nothing else, stands between an eye (3,) and (N, 3) centres."""
    T, way = np.eye(4), centres - eye_m
    T[:3, 3] = eye_m
    away_m = np.linalg.norm(way, axis=1)
    through, stopped = (
        cast_directions(scene, way / away_m[:, None], T, bundle=POINTS_OF_BUNDLE, opaque=opaque).straight_m
        for opaque in (False, True)
    )
    nearly_m = away_m - HIDDEN_M
    return np.asarray((stopped < nearly_m) & (through >= nearly_m))


def _in_mirror(scene: Scene, centres: Floats, eye_m: Floats, edge_m: float) -> Flags:
    """(N,) whether a range camera at an eye (3,) puts what a mirror shows into voxels with (N, 3) centres."""
    T, way = np.eye(4), centres - eye_m
    T[:3, 3] = eye_m
    away_m = np.linalg.norm(way, axis=1)
    hits = cast_directions(scene, way / away_m[:, None], T, bundle=POINTS_OF_BUNDLE, opaque=False)
    # The whole way there, round the mirror, is what it measures; of several beams in a voxel this is one.
    return np.asarray((hits.straight_m < away_m - HIDDEN_M) & (np.abs(hits.path_m - away_m) < MIRROR_EDGES * edge_m))


def _surface_temperatures(scene: Scene, centres: Floats, edge_m: float, solids: Flags) -> tuple[Floats, Floats]:
    """(N,) coldest and (N,) warmest of the surfaces in voxels; infinite where none is of a chosen solid."""
    low, high, touched = np.full(len(centres), np.inf), np.full(len(centres), -np.inf), np.zeros(len(centres), bool)
    places_m = ((np.arange(SAMPLES) + 0.5) / SAMPLES - 0.5) * edge_m
    reach_m = edge_m / SAMPLES * math.sqrt(3) / 2
    for offset_m in product(places_m, repeat=3):
        points = centres + np.array(offset_m)
        distance_m, nearest = nearest_solids(points, scene.shapes)
        here = np.abs(distance_m) <= reach_m
        kelvin = apparent_k(scene, points, nearest)
        low, high = np.where(here, np.minimum(low, kelvin), low), np.where(here, np.maximum(high, kelvin), high)
        touched |= here & solids[nearest]
    return np.where(touched, low, np.inf), np.where(touched, high, -np.inf)
