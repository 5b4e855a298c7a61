"""Scans until a map knows that a wall has gone, next to OctoMap on the same images; and what their order does.

A panel of 1.6 m stands 2.2 m before a camera that does not move. It is seen in 200 scans, two a second, and then it is
gone. OctoMap clamps after each scan: the wall is free after nine scans that look through it. Ours clamps where an epoch
ends, so it takes as many scans of the next epoch; those left of the epoch in which the wall went come on top.
"""

import math
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
from tests.bench import octomap
from tests.fixtures.sim.passes import row_of

from cairn_calib.rig.poses import look_at
from cairn_calib.rig.rig import Rig
from cairn_fusion.mapping.integrate import Integrator, integrate_scan
from cairn_fusion.recording.scan import Scan
from cairn_map.epochs.cell_history import cell_history
from cairn_map.epochs.epoch import Epoch
from cairn_map.epochs.layer import MapLayer
from cairn_map.epochs.present import present
from cairn_map.evidence.brick_cell import BrickCell
from cairn_map.evidence.evidence import Evidence, packed_evidence
from cairn_map.evidence.grid import CellKey, centres_of_voxels, geometry_for, split_voxels
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_sim.evaluation.truth_grid import box_of_metres, solid_masks
from cairn_sim.render.render import render_scan
from cairn_sim.render.sensors import Noise
from cairn_sim.robots.heads import RANGE_CAMERA, tof_head
from cairn_sim.scene.scene import Scene, scene_of
from cairn_sim.scene.solids import Box, Solid, placed
from cairn_sim.scene.surfaces import Material, Surface

Row = tuple[str, str, str]
States = npt.NDArray[np.int8]
EPOCH_S = 120
SCAN_S = 0.5
BEGIN_S = 1_760_000_040.0
"""Begin of an epoch of 120 s, in which the wall goes, or at whose begin."""
LEADS_S = (0, 30, 60, 90)
"""Time from the begin of the epoch until the wall goes."""
GREY = Surface(Material())
PANEL = Solid("panel", Box((0.06, 1.6, 1.6)), GREY, placed((2.2, 0.03, 0.02), (0.0, math.radians(3), math.radians(17))))
ROOM = (
    Solid("wall", Box((0.2, 6.0, 4.0)), GREY, placed((4.1, 0.0, 0.0), (0.0, math.radians(2), math.radians(5)))),
    Solid("floor", Box((6.0, 6.0, 0.2)), GREY, placed((2.0, 0.0, -1.43), (math.radians(1), 0.0, 0.0))),
)
T_MAP_RIG = look_at((0.013, 0.021, 0.017), (3.0, 0.1, 0.05))


@dataclass(frozen=True, slots=True, eq=False)
class Vanishing:
    """Images of the panel, then of the room without it; and the panel's voxels."""

    rig: Rig
    walls: Sequence[Scan]
    frees: Sequence[Scan]
    layer: MapLayer
    voxels: npt.NDArray[np.int64]
    """(N, 3) those that hold some of the panel."""

    @property
    def scans(self) -> list[Scan]:
        """All, in the order of their numbers."""
        return [*self.walls, *self.frees]

    @property
    def places_m(self) -> npt.NDArray[np.float64]:
        """(N, 3) centres of the voxels."""
        return centres_of_voxels(self.voxels, self.layer.geometry)

    def times_s(self, lead_s: float) -> list[float]:
        """Time of each scan if the wall goes so many seconds after the epoch's begin."""
        return [BEGIN_S + lead_s + SCAN_S * (n - len(self.walls)) for n in range(len(self.scans))]


def vanishing(*, walls: int, frees: int, voxel_edge_m: float = 0.04, rig: Rig | None = None) -> Vanishing:
    """So many scans with the panel, and then without it."""
    head = rig or tof_head()
    geometry = geometry_for(voxel_edge_m=voxel_edge_m, channels=())
    box = box_of_metres((1.7, -1.2, -1.2), (2.7, 1.2, 1.2), voxel_edge_um=geometry.voxel_edge_um)
    voxels = np.argwhere(solid_masks(scene_of([PANEL]), box) != 0) + np.array(box.low)
    full, empty = scene_of([PANEL, *ROOM]), scene_of(ROOM)
    images = [_scan(full, head, n) for n in range(walls)] + [_scan(empty, head, n + walls) for n in range(frees)]
    return Vanishing(head, images[:walls], images[walls:], MapLayer(geometry=geometry, epoch_s=EPOCH_S), voxels)


def evidence_of(given: Vanishing) -> list[dict[CellKey, Evidence]]:
    """Evidence of each scan in the panel's voxels."""
    geometry = given.layer.geometry
    keys, places = split_voxels(given.voxels, geometry)
    found = []
    for scan in given.scans:
        diff = integrate_scan(scan, given.rig, geometry, integrator=Integrator())
        parts = {}
        for key, evidence in diff.items():
            mine = np.isin(evidence.voxels, places[keys == key])
            samples = np.zeros((int(mine.sum()), 0), np.int64)
            parts[key] = packed_evidence(evidence.voxels[mine], evidence.counts[mine], samples, geometry)
        found.append({key: part for key, part in parts.items() if len(part)})
    return found


def states_after_each(
    diffs: Sequence[dict[CellKey, Evidence]], times_s: Sequence[float], given: Vanishing, layer: MapLayer
) -> States:
    """(scans, N) states of the panel's voxels after each commit of one scan, in the order in which they are given."""
    model, geometry = SensorModel(), layer.geometry
    keys, places = split_voxels(given.voxels, geometry)
    rows: dict[CellKey, dict[Epoch, BrickCell]] = {CellKey(int(key)): {} for key in np.unique(keys)}
    states = np.zeros((len(diffs), len(given.voxels)), np.int8)
    for n, (diff, time_s) in enumerate(zip(diffs, times_s, strict=True)):
        for key, evidence in diff.items():
            rows[key].setdefault(row_of(time_s, layer), BrickCell(geometry)).merge(evidence)
        for key, mine in rows.items():
            history = cell_history({epoch: cell.packed() for epoch, cell in mine.items()})
            reading, here = present(history, geometry, model), np.nonzero(keys == key)[0]
            at = np.minimum(np.searchsorted(reading.voxels, places[here]), max(len(reading) - 1, 0))
            known = reading.voxels[at] == places[here] if len(reading) else np.zeros(len(here), np.bool_)
            states[n, here[known]] = np.sign(reading.log_odds[at[known]])
    return states


def scans_until(states: States, share: float, *, walls: int) -> int | None:
    """Scans without the wall after which at most this share of the voxels that were occupied before still is."""
    stood = states[walls - 1] == 1
    shares = (states[walls:, stood] == 1).mean(axis=1)
    reached = np.nonzero(shares <= share)[0]
    return int(reached[0]) + 1 if len(reached) else None


def forgetting_rows(smoke: bool) -> Iterator[Row]:
    """One line each."""
    walls, frees = (60, 40) if smoke else (200, 260)
    given = vanishing(walls=walls, frees=frees, voxel_edge_m=0.08 if smoke else 0.04)
    diffs, one_sum = evidence_of(given), MapLayer(geometry=given.layer.geometry)
    title = f"a panel seen in {walls} scans, then gone: {len(given.voxels)} voxels"
    yield title, "", "scans without it until half, 95 %, 99 % of its voxels are free"
    for lead_s in (0, 15) if smoke else LEADS_S:
        states = states_after_each(diffs, given.times_s(lead_s), given, given.layer)
        left = round((EPOCH_S - lead_s) / SCAN_S) if lead_s else 0
        note = f"; scans left of that epoch: {left}" if lead_s else ""
        yield f"  epochs of {EPOCH_S} s, gone after {lead_s} s of one", *_counts(states, walls, note)
    yield "  one sum", *_counts(states_after_each(diffs, given.times_s(0), given, one_sum), walls, "")
    yield from _order_rows(given, diffs, smoke)


def _order_rows(given: Vanishing, diffs: Sequence[dict[CellKey, Evidence]], smoke: bool) -> Iterator[Row]:
    """OctoMap in the order recorded, and both in others."""
    walls, times_s, edge_m = len(given.walls), given.times_s(0), given.layer.geometry.voxel_edge_m
    # No more scans than both need: OctoMap takes 0.3 s for each.
    count = walls + (20 if smoke else 60)
    recorded, rng = list(range(count)), np.random.default_rng(1)
    late = [*range(walls, walls + 30), *range(60)]
    orders = {"recorded": recorded, "shuffled": rng.permutation(count).tolist(), "60 old ones after 30 new": late}
    ours = {
        name: states_after_each([diffs[n] for n in order], [times_s[n] for n in order], given, given.layer)
        for name, order in orders.items()
    }
    stood = ours["recorded"][walls - 1] == 1
    why = octomap.missing()
    if why:
        yield "  OctoMap", "skipped", why
    theirs: dict[str, States] = {}
    if not why:
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            driver = octomap.compiled_driver(folder, octomap.PROBES)
            for title, order in orders.items():
                octomap.write_scans(folder / "scans", [given.scans[n] for n in order], given.rig)
                theirs[title] = octomap.states_after_each(
                    driver, folder / "scans", folder, given.places_m, voxel_edge_m=edge_m
                )
        yield "  OctoMap, in the order recorded", *_counts(theirs["recorded"], walls, "")
        stood &= theirs["recorded"][walls - 1] == 1
    for title, states in ours.items():
        parts = [f"ours {(states[-1, stood] == 1).mean():.1%}"]
        parts += [f"OctoMap {(theirs[title][-1, stood] == 1).mean():.1%}"] if title in theirs else []
        yield f"  the panel still there at the end, {title}", "", ", ".join(parts)


def _counts(states: States, walls: int, note: str) -> tuple[str, str]:
    found = [scans_until(states, share, walls=walls) for share in (0.5, 0.05, 0.01)]
    return " / ".join("never" if n is None else str(n) for n in found), f"scans{note}"


def _scan(scene: Scene, rig: Rig, number: int) -> Scan:
    scan = render_scan(
        scene, rig, T_map_rig=T_MAP_RIG, range_camera=RANGE_CAMERA, time_s=0.0, noise=Noise(seed=5), number=number
    )
    return replace(scan, time_s=float(number))
