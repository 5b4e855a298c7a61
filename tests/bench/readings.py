"""Readings of a map with epochs next to the sums of one without: what a touched brick costs, queries, and memory.

    $ python -m tests.bench readings

Stops of the small room at 4 cm, each as a pass of an epoch of its own over the same cells, in commits of a few scans.
The newest row is held as sums, all others as bytes. CPU time; a brick is touched if a commit has a voxel of it.
"""

import statistics
import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from tests.bench.timing import cpu_s

from cairn_fusion.mapping.measurement import Measurement
from cairn_map.codec.cell_code import coding_of
from cairn_map.epochs.epoch import Epoch
from cairn_map.epochs.history_map import HistoryMap
from cairn_map.epochs.layer import MapLayer
from cairn_map.epochs.map_reading import MapReading
from cairn_map.epochs.present import present
from cairn_map.evidence.evidence_map import Diff, EvidenceMap
from cairn_map.evidence.grid import Geometry
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_map.queries.map_snapshot import snapshot_of
from cairn_sim.robots.heads import full_head
from cairn_sim.robots.record import Plan, scans_of, shots_of
from cairn_sim.robots.robots import ROBOTS
from cairn_sim.scene.scene_file import load_scene

Row = tuple[str, str, str]
MODEL = SensorModel()
SCANS_A_COMMIT = 6
POINTS = 300_000


def reading_rows(smoke: bool) -> Iterator[Row]:
    """One line each."""
    geometry = Geometry()
    passes = room_passes(geometry, stops=2 if smoke else 9, yaws=4 if smoke else 12)
    rows, sums = HistoryMap(MapLayer(geometry=geometry, epoch_s=120), coding=coding_of(geometry)), EvidenceMap(geometry)
    reading = MapReading(rows)
    per_brick_us: list[float] = []
    first_us: list[float] = []
    for n, commits in enumerate(passes):
        for number, diff in enumerate(commits):
            rows.merge(diff, epoch=Epoch(n))
            sums.merge(diff)
            bricks = sum(evidence.brick_count for evidence in diff.values())
            start_s = time.process_time()
            reading.note(diff, epoch=Epoch(n), sign=1)
            for cell in reading._cells.values():
                cell.cell()
            seconds = time.process_time() - start_s
            if n:
                (per_brick_us if number else first_us).append(1e6 * seconds / bricks)
        if n < len(passes) - 1:
            reading.frozen_cells(MODEL)
    keys = list(rows)
    known = sum(len(sums.evidence(key)) for key in keys)
    yield (
        f"{len(passes)} passes over {len(keys)} cells",
        f"{known}",
        f"known voxels, {sums.size_bytes / 1e6:.1f} MB as one sum",
    )
    yield (
        "  reading of a touched brick, the row grows",
        f"{statistics.median(per_brick_us):.1f}",
        "us CPU, median of commits",
    )
    yield (
        "  the first commit of an epoch",
        f"{statistics.median(first_us):.1f}",
        "us CPU a brick: older rows are decoded",
    )
    histories = [rows.history(key) for key in keys]
    whole_s = cpu_s(lambda: [present(history, geometry, MODEL).evidence for history in histories], 1 if smoke else 3)
    yield "  reading of all cells from decoded rows", f"{1e3 * whole_s / len(keys):.1f}", "ms CPU a cell"
    growing_bytes = rows.size_bytes + reading.size_bytes
    for _ in range(2):
        rows.rest()
    reading.rest()
    for name, size_bytes in (
        ("all cells growing", growing_bytes),
        ("at rest", rows.size_bytes + reading.size_bytes),
    ):
        yield (
            f"  memory of rows and reading, {name}",
            f"{size_bytes / 1e6:.1f}",
            f"MB = {size_bytes / sums.size_bytes:.2f} x the sum's",
        )
    yield from _query_rows(sums, reading, repeats=1 if smoke else 5)


def _query_rows(sums: EvidenceMap, reading: MapReading, *, repeats: int) -> Iterator[Row]:
    snapshots = snapshot_of(sums), snapshot_of(reading)
    centres = snapshots[0].voxels_in().centres_m
    points = np.random.default_rng(1).uniform(centres.min(axis=0), centres.max(axis=0), (POINTS, 3))
    for name, ask in (
        ("log-odds at points", lambda it: it.log_odds_at(points)),
        ("voxels of the map", lambda it: it.voxels_in()),
    ):
        mine, its = (cpu_s(lambda it=it, ask=ask: ask(it), repeats) for it in reversed(snapshots))  # type: ignore[misc]
        yield f"  {name}", f"{1e3 * mine:.1f}", f"ms CPU; of the sum {1e3 * its:.1f}"
    for name, whole in (("sum", sums), ("reading", reading)):
        seconds = cpu_s(lambda whole=whole: snapshot_of(whole), repeats)  # type: ignore[misc]
        yield f"  first snapshot of the {name}", f"{1e3 * seconds:.1f}", "ms CPU"


def room_passes(geometry: Geometry, *, stops: int, yaws: int) -> list[list[Diff]]:
    """Commits by pass."""
    robot = replace(ROBOTS["orpheus"], scans=(yaws, 3))
    plan = Plan(scene=load_scene("small-room"), robot=robot, path="west", scale=0.25, truth="none", last_stop=stops)
    scans = [scan for _, scan, _ in scans_of(plan, shots_of(plan), robot.rig_of(plan.scale))]
    rig, count = full_head(scale=0.25), robot.scans_per_stop
    passes: list[list[Diff]] = []
    for n in range(0, len(scans), count):
        passes.append([])
        for start in range(n, n + count, SCANS_A_COMMIT):
            measurement = Measurement(rig, geometry)
            for scan in scans[start : min(start + SCANS_A_COMMIT, n + count)]:
                measurement.add(scan)
            passes[-1].append(measurement.diff())
    return passes
