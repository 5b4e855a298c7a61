"""Classes: bytes and time of a layer whose list has 64 of them, next to one of 4 and to the same map without.

    $ python -m tests.bench classes

Stops of the small room with the range camera alone at 5 cm, labelled with the truth: the number of the solid in each
pixel, folded into as many classes as the list names. A tenth of the pixels, at random, has another class, as labels
have it. CPU time; the map is the sum of all stops.
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from tests.bench.timing import cpu_s

from cairn_fusion.mapping.integrate import Integrator, integrate_scans
from cairn_fusion.recording.scan import Scan
from cairn_map.codec.cell_code import Profile, decode_cell, encode_cell
from cairn_map.evidence.channels import CLASSES_MAX, Channel, classes_channel
from cairn_map.evidence.evidence_map import EvidenceMap
from cairn_map.evidence.grid import geometry_for
from cairn_map.queries.map_snapshot import MapSnapshot, snapshot_of
from cairn_sim.robots.heads import RANGE_CAMERA
from cairn_sim.robots.record import Plan, scans_of, shots_of
from cairn_sim.robots.robots import ROBOTS
from cairn_sim.scene.scene_file import load_scene

Row = tuple[str, str, str]
EDGE_M = 0.05
WRONG = 0.1
"""Share of the pixels with a wrong label."""
POINTS = 300_000


class LayerCost(NamedTuple):
    """Cost of one layer."""

    integrate_s: float
    """CPU time of one stop."""
    commit_bytes: int
    """Bytes of its cells, profile fast."""
    map_bytes: dict[Profile, int]
    encode_s: float
    decode_s: float
    merge_s: float
    """CPU time of the first stop, into empty cells."""
    memory_bytes: int
    """Bytes of the map in memory while its cells grow."""
    read_s: float
    """CPU time of the classes at `POINTS` points; 0 of a layer without."""
    right: float
    """Share of the voxels that are sure of their class whose class is the truth's."""


def class_rows(smoke: bool) -> Iterator[Row]:
    """One line each."""
    robot = replace(ROBOTS["tof"], scans=(4, 1)) if smoke else ROBOTS["tof"]
    plan = Plan(scene=load_scene("small-room"), robot=robot, path="west", truth="range", last_stop=2 if smoke else None)
    shots = [
        (scan, truths[RANGE_CAMERA].solid) for _, scan, truths in scans_of(plan, shots_of(plan), robot.rig_of(1.0))
    ]
    yield f"small room, {len(shots)} labelled scans, {EDGE_M * 100:g} cm", "", ""
    plain: LayerCost | None = None
    for count in (0, 4, CLASSES_MAX):
        channels = (_listed(count),) if count else ()
        scans = [_labelled(scan, solid, channels[0]) if channels else scan for scan, solid in shots]
        cost = _cost(plan, scans, channels, repeats=1 if smoke else 5)
        plain = plain or cost
        name = f"{count} classes" if count else "no classes"
        for what, value, unit, one, other in (
            ("integrate a stop", f"{1e3 * cost.integrate_s:.0f}", "ms CPU", cost.integrate_s, plain.integrate_s),
            ("  bytes of its cells", f"{cost.commit_bytes / 1e3:.0f}", "kB", cost.commit_bytes, plain.commit_bytes),
            *(
                (f"  bytes of the map, profile {profile}", f"{size / 1e3:.0f}", "kB", size, plain.map_bytes[profile])
                for profile, size in cost.map_bytes.items()
            ),
            ("  encode the map", f"{1e3 * cost.encode_s:.0f}", "ms CPU", cost.encode_s, plain.encode_s),
            ("  decode it", f"{1e3 * cost.decode_s:.0f}", "ms CPU", cost.decode_s, plain.decode_s),
            ("  merge a stop", f"{1e3 * cost.merge_s:.1f}", "ms CPU", cost.merge_s, plain.merge_s),
            ("  memory of the map", f"{cost.memory_bytes / 1e6:.1f}", "MB", cost.memory_bytes, plain.memory_bytes),
        ):
            yield f"{name}: {what}", value, f"{unit}, {one / other:.2f} x no classes" if channels else unit
        if channels:
            yield f"{name}:   classes at {POINTS} points", f"{1e3 * cost.read_s:.0f}", "ms CPU"
            yield f"{name}:   of the sure ones right, {WRONG:.0%} of labels wrong", f"{cost.right:.2%}", ""


def _cost(plan: Plan, scans: list[Scan], channels: tuple[Channel, ...], *, repeats: int) -> LayerCost:
    geometry = geometry_for(voxel_edge_m=EDGE_M, channels=channels)
    rig, size = plan.robot.rig_of(1.0), plan.robot.scans_per_stop
    stops = [scans[n : n + size] for n in range(0, len(scans), size)]
    diffs = [integrate_scans(stop, rig, geometry, integrator=Integrator(), threads=1) for stop in stops]
    total = EvidenceMap(geometry)
    for diff in diffs:
        total.merge(diff)
    cells = total.packed()
    encoded = [encode_cell(key, evidence, geometry).data for key, evidence in cells.items()]
    snapshot = snapshot_of(total)
    centres = snapshot.occupied_in().centres_m
    points = centres[np.random.default_rng(1).integers(0, len(centres), POINTS)]
    return LayerCost(
        integrate_s=cpu_s(
            lambda: integrate_scans(stops[0], rig, geometry, integrator=Integrator(), threads=1), repeats
        ),
        commit_bytes=sum(len(encode_cell(key, evidence, geometry).data) for key, evidence in diffs[0].items()),
        map_bytes={
            profile: sum(
                len(encode_cell(key, evidence, geometry, profile=profile).data) for key, evidence in cells.items()
            )
            for profile in Profile
        },
        encode_s=cpu_s(lambda: [encode_cell(key, evidence, geometry) for key, evidence in cells.items()], repeats),
        decode_s=cpu_s(lambda: [decode_cell(data) for data in encoded], repeats),
        merge_s=cpu_s(lambda: EvidenceMap(geometry).merge(diffs[0]), repeats),
        memory_bytes=total.size_bytes,
        read_s=cpu_s(lambda: snapshot.class_at(points), repeats) if channels else 0.0,
        right=_right(plan, snapshot, channels[0]) if channels else 1.0,
    )


def _right(plan: Plan, snapshot: MapSnapshot, channel: Channel) -> float:
    """Share of the occupied voxels with a sure class that have the class of the solid nearest to their centre."""
    centres = snapshot.occupied_in().centres_m
    found = snapshot.class_at(centres)
    sure = (found.weight > 0) & ~np.asarray(found.unsure, np.bool_)
    truth = plan.scene.nearest_solid(centres[sure]) % (len(channel.classes) - 1)
    return float(np.mean(found.mean[sure] == truth))


def _listed(count: int) -> Channel:
    """A channel of so many classes, `other` among them."""
    return classes_channel(tuple(f"class_{n}" for n in range(count - 1)))


def _labelled(scan: Scan, solid: npt.NDArray[np.int16], channel: Channel) -> Scan:
    """A scan with the classes of its pixels, some of them wrong; where no solid is met, a label says nothing."""
    named = len(channel.classes) - 1
    rng = np.random.default_rng(round(scan.time_s * 1e3) % (1 << 32))
    classes = np.where(rng.random(solid.shape) < WRONG, rng.integers(0, named, solid.shape), solid % named)
    image = np.where(solid < 0, named, classes).astype(np.uint8)
    table: dict[int, str | None] = {n: channel.classes[n] for n in range(named)}
    return replace(scan, labels={scan.range_camera: image}, label_names=table | {named: None})
