"""Peers beside us in the same run: OctoMap's time, and the same map in other forms.

Bonxai and wavemap are in no package registry and so are not run here. Measured earlier on this kind of machine, on the
same points at 4 cm: 2.9 and 2.4 M points/s, where OctoMap, as its defaults are, had 109 k points/s.

The forms hold different things: ours every sum exactly; OctoMap one log-odds and one mean colour a voxel, neither
intensity nor temperature; the dense ones means in 8 B a voxel (log-odds, colour, amplitude, temperature), unknown as 0.
"""

import importlib
import statistics
import struct
import tempfile
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import zstandard
from tests.bench import octomap
from tests.bench.timing import cpu_s

from cairn_calib.rig.rig import Rig
from cairn_fusion.mapping.integrate import Integrator, integrate_scans
from cairn_fusion.recording.scan import Scan
from cairn_map.codec.cell_code import Profile, encode_cell
from cairn_map.codec.octree.cell_head import decode_head
from cairn_map.evidence.channels import COLOUR, INTENSITY, TEMPERATURE
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.grid import CellKey, Geometry, geometry_for
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_map.evidence.voxels import Voxels, joined_voxels, voxels_of_evidence
from cairn_sim.robots.record import Plan, scans_of, shots_of
from cairn_sim.robots.robots import ROBOTS
from cairn_sim.scene.scene_file import load_scene

Row = tuple[str, str, str]
Diff = dict[CellKey, Evidence]
STREAM = struct.Struct("<BBII")
"""Head of a stream in a cell (FORMAT.md): number, coding, raw and stored length."""
DENSE = np.dtype([("log_odds", "<i2"), ("rgb", "u1", 3), ("amplitude", "u1"), ("temperature", "<u2")])


def peer_rows(smoke: bool) -> Iterator[Row]:
    """One line each: one measurement of the building with the full head, colour at a quarter of its size."""
    robot = ROBOTS["orpheus"]
    plan = Plan(
        scene=load_scene("building"), robot=robot, path="labs", truth="none", scale=0.25, first_stop=8, last_stop=9
    )
    rig = robot.rig_of(plan.scale)
    shots = shots_of(plan)[: 2 if smoke else None]
    scans = [scan for _, scan, _ in scans_of(plan, shots, rig)]
    why = octomap.missing()
    if why:
        yield "OctoMap", "skipped", why
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        points = octomap.write_scans(folder / "scans", scans, rig)
        driver = None if why else octomap.compiled_driver(folder)
        for edge_m in (0.08,) if smoke else (0.04, 0.02):
            yield from _time_rows(scans, rig, points, edge_m, driver=driver, path=folder / "scans")
        yield from _size_rows(scans, rig, 0.08 if smoke else 0.04, driver=driver, folder=folder)


def _time_rows(
    scans: Sequence[Scan], rig: Rig, points: int, edge_m: float, *, driver: Path | None, path: Path
) -> Iterator[Row]:
    bare = geometry_for(voxel_edge_m=edge_m, channels=())
    coloured = geometry_for(voxel_edge_m=edge_m, channels=(COLOUR, TEMPERATURE))
    repeats = 5 if edge_m > 0.03 else 2
    bare_s, coloured_s = (
        cpu_s(lambda geometry=geometry: integrate_scans(scans, rig, geometry, integrator=Integrator(), threads=1), n)  # type: ignore[misc]
        for geometry, n in ((bare, repeats), (coloured, repeats))
    )
    yield f"integrate {len(scans)} scans, {points} points, {edge_m * 100:g} cm", "", ""
    yield "  occupancy alone", f"{1e3 * bare_s:.0f}", f"ms CPU = {points / bare_s / 1e3:.0f} k points/s"
    yield (
        "  with colour and temperature",
        f"{1e3 * coloured_s:.0f}",
        f"ms CPU = {points / coloured_s / 1e3:.0f} k points/s",
    )
    if driver is not None:
        runs = [octomap.insert_scans(driver, path, voxel_edge_m=edge_m).cpu_s for _ in range(3 if edge_m > 0.03 else 1)]
        peer_s = statistics.median(runs)
        yield (
            "  OctoMap, occupancy alone",
            f"{1e3 * peer_s:.0f}",
            f"ms CPU = {points / peer_s / 1e3:.0f} k points/s: {peer_s / bare_s:.2g} x our time, "
            f"{peer_s / coloured_s:.2g} x that with colour and temperature",
        )


def _size_rows(scans: Sequence[Scan], rig: Rig, edge_m: float, *, driver: Path | None, folder: Path) -> Iterator[Row]:
    geometry = geometry_for(voxel_edge_m=edge_m)
    diff = integrate_scans(scans, rig, geometry, integrator=Integrator())
    known = sum(len(evidence) for evidence in diff.values())
    sampled = sum(len(evidence.sampled) for evidence in diff.values())
    cells = [encode_cell(key, evidence, geometry).data for key, evidence in diff.items()]
    ours = sum(len(data) for data in cells)
    yield f"that map in bytes, {edge_m * 100:g} cm", f"{known}", f"known voxels, {sampled} with samples"
    yield "  ours, exact, profile fast", f"{ours}", "B"
    small = sum(len(encode_cell(key, evidence, geometry, profile=Profile.SMALL).data) for key, evidence in diff.items())
    yield "  ours, exact, profile small", f"{small}", _against(ours, small)
    tight = sum(len(_zstd(raw, 19)) for data in cells for raw in _raw_streams(data))
    yield "  ours, exact, the fast streams under zstd-19", f"{tight}", _against(ours, tight)
    voxels = {
        key: voxels_of_evidence(key, evidence, geometry, SensorModel(), occupied_only=False)
        for key, evidence in diff.items()
    }
    if driver is not None:
        yield from _octree_rows(joined_voxels(list(voxels.values())), edge_m, ours, driver=driver, folder=folder)
    dense = [_dense(diff[key], voxels[key], geometry) for key in diff]
    for level in (3, 19):
        size = sum(len(_zstd(data, level)) for data in dense)
        yield f"  dense 8 B voxels, means, zstd-{level}", f"{size}", _against(ours, size)
    try:
        blosc2 = importlib.import_module("blosc2")
    except ImportError:
        yield "  dense 8 B voxels, blosc2", "skipped", "no blosc2 (pip install -e '.[bench]')"
        return
    options = {"typesize": DENSE.itemsize, "codec": blosc2.Codec.ZSTD, "clevel": 9}
    size = sum(len(blosc2.compress2(data, **options)) for data in dense)
    yield "  dense 8 B voxels, means, blosc2 (zstd-9, shuffled)", f"{size}", _against(ours, size)


def _octree_rows(voxels: Voxels, edge_m: float, ours: int, *, driver: Path, folder: Path) -> Iterator[Row]:
    reading = voxels.readings[COLOUR.name]
    coloured = reading.weight > 0
    octomap.write_colours(
        folder / "colours", voxels.centres_m[coloured], np.rint(reading.mean[coloured]).astype(np.uint8)
    )
    octomap.colour_tree(driver, folder / "scans", folder / "colours", folder / "tree.ot", voxel_edge_m=edge_m)
    tree = (folder / "tree.ot").read_bytes()
    for name, size in (
        ("as written", len(tree)),
        ("zip-6", len(zlib.compress(tree, 6))),
        ("zstd-19", len(_zstd(tree, 19))),
    ):
        yield f"  OctoMap's ColorOcTree, .ot, {name}", f"{size}", _against(ours, size)


def _dense(evidence: Evidence, voxels: Voxels, geometry: Geometry) -> bytes:
    """All voxels of a cell in Morton order, lossy: what a plain array of the map would hold."""
    array = np.zeros(8**geometry.depth, DENSE)
    rows = np.zeros(len(evidence), DENSE)
    rows["log_odds"] = np.rint(1000 * np.log(voxels.probability / (1 - voxels.probability)))
    rows["rgb"] = np.nan_to_num(np.rint(voxels.readings[COLOUR.name].mean))
    rows["amplitude"] = np.nan_to_num(voxels.readings[INTENSITY.name].mean) / 256
    rows["temperature"] = np.nan_to_num(np.rint(voxels.readings[TEMPERATURE.name].mean / TEMPERATURE.step))
    array[evidence.voxels] = rows
    return array.tobytes()


def _raw_streams(cell: bytes) -> Iterator[bytes]:
    _, head = decode_head(cell)
    at = len(head)
    while at < len(cell):
        _, coding, raw_bytes, stored_bytes = STREAM.unpack_from(cell, at)
        body = cell[at + STREAM.size : at + STREAM.size + stored_bytes]
        yield zstandard.ZstdDecompressor().decompress(body, max_output_size=raw_bytes) if coding else body
        at += STREAM.size + stored_bytes


def _zstd(data: bytes, level: int) -> bytes:
    return zstandard.ZstdCompressor(level=level).compress(data)


def _against(ours: int, size: int) -> str:
    return f"B = {size / ours:.2f} x ours, fast"
