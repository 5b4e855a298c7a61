"""Figures of the whole slice, measured in one run on this machine.

    $ python -m tests.bench            # `make bench`
    $ python -m tests.bench --smoke    # a few repeats only, to see that it still runs
    $ python -m tests.bench --smoke server    # that part alone, about 10 s

Times are medians of process CPU time for kernels, of wall time for what crosses a socket. The scene is the
simulated room at 4 cm; where CAIRN_TEST_DATA is set, real recordings are replayed too.
"""

import argparse
import os
import re
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from tests.bench.amending import amending_rows
from tests.bench.calibration import calibration_rows
from tests.bench.classes import class_rows
from tests.bench.coding import coding_rows
from tests.bench.console import console_rows
from tests.bench.epochs import epoch_rows
from tests.bench.hot_spots import hot_spot_rows
from tests.bench.imports import import_rows
from tests.bench.integration import integration_rows
from tests.bench.large_map import large_map_rows
from tests.bench.layers import layer_rows
from tests.bench.level import level_rows
from tests.bench.links import link_rows
from tests.bench.live_mapping import live_mapping_rows
from tests.bench.many_maps import many_map_rows
from tests.bench.marks import mark_rows
from tests.bench.overlay import overlay_rows
from tests.bench.peers import peer_rows
from tests.bench.publishing import publishing_rows
from tests.bench.queries import query_rows
from tests.bench.readings import reading_rows
from tests.bench.rounds import round_rows
from tests.bench.scale import scale_rows
from tests.bench.server import server_rows
from tests.bench.simulation import simulation_rows
from tests.bench.start import start_rows
from tests.bench.surfaces import surface_rows
from tests.bench.telepresence import telepresence_rows

from cairn_client.http.api import MapApi
from cairn_client.robot.robot import Robot
from cairn_fusion.importers import open_source
from cairn_fusion.mapping.grouping import Grouping, OpenGroup
from cairn_fusion.mapping.measurement import Measurement
from cairn_fusion.recording.recording import ScanSource
from cairn_fusion.recording.scan import Scan
from cairn_map.codec.cell_code import decode_canonical_cell, encode_cell
from cairn_map.commits.commit import CommitMeta, make_commit
from cairn_map.evidence.brick_cell import brick_cell
from cairn_map.evidence.channels import COLOUR, TEMPERATURE, Channel
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.evidence_map import EvidenceMap
from cairn_map.evidence.fingerprint import fingerprint
from cairn_map.evidence.grid import CellKey, Geometry, geometry_for
from cairn_map.wire.messages import CreateMap, Register
from cairn_sim.robots.heads import full_head
from cairn_sim.robots.record import Plan, record, scans_of, shots_of
from cairn_sim.robots.robots import ROBOTS
from cairn_sim.scene.scene_file import load_scene, shipped_text

Row = tuple[str, str, str]
NAME_WIDTH = 66


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser("python -m tests.bench", description=__doc__)
    parser.add_argument("--smoke", action="store_true", help="few repeats")
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"of {', '.join(PARTS)}; all without any")
    args = parser.parse_args()
    if unknown := set(args.parts) - PARTS.keys():
        parser.error(f"there is no part {', '.join(sorted(unknown))}; there are {', '.join(PARTS)}")
    for part in args.parts or PARTS:
        start_s = time.perf_counter()
        for name, value, unit in PARTS[part](args.smoke):
            sys.stdout.write(f"{name:<{NAME_WIDTH}}  {value:>12}  {unit}\n")
            sys.stdout.flush()
        sys.stdout.write(f"  ({part} took {time.perf_counter() - start_s:.0f} s)\n")


def _room_rows(smoke: bool) -> Iterator[Row]:
    scans = _room_scans(stop_count=2 if smoke else 8, yaws=4 if smoke else 12)
    yield from _kernel_rows(scans, repeats=3 if smoke else 15)
    yield from _server_rows(scans, pushes=20 if smoke else 300)


def _room_scans(*, stop_count: int, yaws: int) -> list[list[Scan]]:
    """Scans by stop: the full head at a quarter of its colour and thermal resolution, three tilts."""
    robot = replace(ROBOTS["orpheus"], scans=(yaws, 3))
    plan = Plan(
        scene=load_scene("small-room"), robot=robot, path="west", scale=0.25, truth="none", last_stop=stop_count
    )
    scans = [scan for _, scan, _ in scans_of(plan, shots_of(plan), robot.rig_of(plan.scale))]
    count = robot.scans_per_stop
    return [scans[n : n + count] for n in range(0, len(scans), count)]


def _kernel_rows(scans: list[list[Scan]], *, repeats: int) -> Iterator[Row]:
    geometry, rig = Geometry(), full_head(scale=0.25)
    measurement = Measurement(rig, geometry)
    measurement.add(scans[0][0])
    per_scan_s = [_cpu_s(lambda scan=scan: measurement.add(scan)) for stop in scans for scan in stop]  # type: ignore[misc]
    tof = [
        Scan(time_s=s.time_s, T_map_rig=s.T_map_rig, range_camera=s.range_camera, range_m=s.range_m) for s in scans[0]
    ]
    tof_s = [_cpu_s(lambda scan=scan: Measurement(rig, geometry).add(scan)) for scan in tof]  # type: ignore[misc]
    yield "integrate one scan, 5 cameras, 4 cm", f"{1e3 * statistics.median(per_scan_s):.1f}", "ms"
    yield "integrate one scan, ToF alone, 4 cm", f"{1e3 * statistics.median(tof_s):.1f}", "ms"
    diffs = []
    for stop in scans:
        one = Measurement(rig, geometry)
        for scan in stop:
            one.add(scan)
        diffs.append(one.diff())
    key, evidence = max(diffs[0].items(), key=lambda item: len(item[1]))
    data = encode_cell(key, evidence, geometry).data
    voxels = len(evidence)
    yield "fullest cell of a measurement", f"{voxels}", "known voxels"
    for name, work in (
        ("decode and check canonical", lambda: decode_canonical_cell(data)),
        ("merge it into a cell", lambda: brick_cell(geometry, [evidence])),
        ("fingerprint it", lambda: fingerprint(evidence, key)),
    ):
        seconds = statistics.median(_cpu_s(work) for _ in range(repeats))
        yield f"  {name}", f"{1e3 * seconds:.1f}", f"ms = {voxels / seconds / 1e6:.0f} Mvoxel/s"
    commits = [
        make_commit(CommitMeta(id=f"bench.{'0' * 16}.{n}", geometry=geometry.digest().hex()), diff, geometry)
        for n, diff in enumerate(diffs)
    ]
    sizes = [len(commit.data) for commit in commits]
    yield f"bytes pushed per measurement ({len(scans[0])} scans)", f"{statistics.median(sizes):.0f}", "B"
    total = EvidenceMap(geometry)
    for diff in diffs:
        total.merge(diff)
    known = sum(len(e) for e in total.packed().values())
    name, size_bytes = f"memory of a map of {len(diffs)} measurements", total.size_bytes
    yield name, f"{size_bytes / 1e6:.1f}", f"MB = {size_bytes / known:.1f} B a known voxel"
    yield from _merge_rows(total, diffs[-1], repeats=repeats)


def _merge_rows(total: EvidenceMap, diff: Mapping[CellKey, Evidence], *, repeats: int) -> Iterator[Row]:
    """How fast a measurement is taken out of the map that holds it, and put in again."""
    seconds = [(_cpu_s(lambda: total.unmerge(diff)), _cpu_s(lambda: total.merge(diff))) for _ in range(repeats)]
    known = sum(len(evidence) for evidence in diff.values())
    bricks = sum(evidence.brick_count for evidence in diff.values())
    for name, times in zip(("take a measurement out of it", "merge it again"), zip(*seconds, strict=True), strict=True):
        median_s = statistics.median(times)
        known_rate, slot_rate = known / median_s / 1e6, 512 * bricks / median_s / 1e6
        yield (
            f"  {name}",
            f"{1e3 * median_s:.1f}",
            f"ms = {known_rate:.0f} M known voxels/s, {slot_rate:.0f} M of its bricks",
        )


def _server_rows(scans: list[list[Scan]], *, pushes: int) -> Iterator[Row]:
    geometry, rig = Geometry(), full_head(scale=0.25)
    one = Measurement(rig, geometry)
    for scan in scans[0]:
        one.add(scan)
    diff = one.diff()
    with tempfile.TemporaryDirectory() as folder, _server(Path(folder)) as url:
        api = MapApi(url)
        api.create_map("bench", CreateMap(geometry=geometry))
        api.register("bench", Register(robot="bench", incarnation="0" * 16))
        seconds: list[float] = []
        for n in range(pushes + 3):
            scan_poses = tuple(one.poses)
            meta = CommitMeta(id=f"bench.{'0' * 16}.{n}", geometry=geometry.digest().hex(), scans=scan_poses)
            commit = make_commit(meta, diff, geometry)
            start = time.perf_counter()
            api.push("bench", commit)
            seconds.append(time.perf_counter() - start)
        seconds = sorted(seconds[3:])
        yield f"push {len(commit.data)} B over loopback, p50", f"{1e3 * statistics.median(seconds):.1f}", "ms"
        yield "  p99", f"{1e3 * seconds[int(0.99 * (len(seconds) - 1))]:.1f}", "ms"
        start = time.perf_counter()
        while api.cell_index("bench").header.pending:
            time.sleep(0.02)
        yield "  then folded after", f"{time.perf_counter() - start:.2f}", "s"


def _recording_rows(smoke: bool) -> Iterator[Row]:
    with tempfile.TemporaryDirectory() as folder:
        name = "a simulated camera carried at 0.4 m/s, 30 images/s"
        yield from _replay_rows(name, _carried(Path(folder), smoke), 0.04, (COLOUR,), smoke)
    root = os.environ.get("CAIRN_TEST_DATA")
    if not root:
        return
    for name, channels in (("apc_shelf_rgbd", (COLOUR,)), ("mm5_rgbdt", (COLOUR, TEMPERATURE))):
        source = open_source(Path(root) / name)
        yield from _replay_rows(name, source, 0.01, channels, smoke)


def _carried(folder: Path, smoke: bool) -> ScanSource:
    """A hand-held RGB-D camera on its way through the laboratories: 500 images of 320 x 240 pixels."""
    plan = Plan(
        scene=load_scene("building"),
        robot=ROBOTS["handheld"],
        path="labs",
        truth="none",
        scale=0.5,
        speed_m_s=0.4,
        rate_hz=30.0,
        last_stop=3 if smoke else 500,
    )
    for _ in record(plan, folder / "carried", scene_text=shipped_text("building")):
        pass
    return open_source(folder / "carried")


def _replay_rows(
    name: str, source: ScanSource, voxel_m: float, channels: tuple[Channel, ...], smoke: bool
) -> Iterator[Row]:
    geometry = geometry_for(voxel_edge_m=voxel_m, channels=channels)
    count = 3 if smoke else len(source)
    seconds, size_bytes = _replayed(source, geometry, count, Grouping(scans_max=1))
    yield f"replay {name}, {voxel_m * 100:g} cm", f"{count / seconds:.1f}", "images/s, read, mapped, pushed"
    yield "  bytes pushed per measurement (1 image)", f"{size_bytes / count:.0f}", "B"
    grouping = Grouping() if source.has_times else Grouping(seconds_max=None)
    seconds, size_bytes = _replayed(source, geometry, count, grouping)
    yield "  bytes pushed per 1000 images, standard groups", f"{size_bytes / count / 1000:.2f}", "MB"


def _replayed(source: ScanSource, geometry: Geometry, count: int, grouping: Grouping) -> tuple[float, int]:
    """Seconds to read, map and push some scans of a source, and the bytes pushed."""
    group = OpenGroup(grouping)
    with tempfile.TemporaryDirectory() as folder, _server(Path(folder) / "server") as url:
        MapApi(url).create_map("bench", CreateMap(geometry=geometry))
        with Robot(source.rig, f"{url}/maps/bench", directory=Path(folder) / "robot", name="bench") as robot:
            robot.sync()
            start = time.perf_counter()
            for index in range(count):
                scan = source.scan(index)
                if group.ends_before(scan.time_s, scan.T_map_rig):
                    robot.commit()
                robot.observe(scan)
            robot.commit()
            robot.sync()
            return time.perf_counter() - start, robot.traffic.up_bytes


def _size_rows(smoke: bool) -> Iterator[Row]:
    root = Path(__file__).parents[2]
    for folder in sorted(root.glob("*/cairn_*")):
        count = sum(len(path.read_text().splitlines()) for path in folder.glob("*.py"))
        yield f"lines in {folder.relative_to(root)}", f"{count}", ""


@contextmanager
def _server(folder: Path) -> Iterator[str]:
    command = [sys.executable, "-m", "cairn_client.main", "serve", "--data", str(folder), "--port", "0"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    try:
        line = process.stdout.readline() if process.stdout else ""
        found = re.search(r"http://\S+:\d+", line)
        if found is None:
            raise RuntimeError("the server did not start")
        yield found.group(0)
    finally:
        process.terminate()
        process.wait(timeout=60)
        if process.stdout:
            process.stdout.close()


def _cpu_s(work: Callable[[], object]) -> float:
    start = time.process_time()
    work()
    return time.process_time() - start


PARTS: dict[str, Callable[[bool], Iterator[Row]]] = {
    "room": _room_rows,
    "amending": amending_rows,
    "live": live_mapping_rows,
    "calibration": calibration_rows,
    "classes": class_rows,
    "coding": coding_rows,
    "console": console_rows,
    "epochs": epoch_rows,
    "hot_spots": hot_spot_rows,
    "imports": import_rows,
    "integration": integration_rows,
    "level": level_rows,
    "links": link_rows,
    "layers": layer_rows,
    "marks": mark_rows,
    "overlay": overlay_rows,
    "peers": peer_rows,
    "publishing": publishing_rows,
    "queries": query_rows,
    "readings": reading_rows,
    "rounds": round_rows,
    "scale": scale_rows,
    "server": server_rows,
    "large-map": large_map_rows,
    "many-maps": many_map_rows,
    "simulation": simulation_rows,
    "start": start_rows,
    "surfaces": surface_rows,
    "telepresence": telepresence_rows,
    "recordings": _recording_rows,
    "sizes": _size_rows,
}
"""Each gives its lines, few repeats if told so."""


if __name__ == "__main__":
    main()
