"""How small evidence becomes in both profiles, and how fast: a robot's measurement, and the map of its path.

Beside both stand the raw streams under zstd at its level 19, which knows bytes alone, and what no coder can do without:
the noise of the sensors. Dense-equivalent rates count 8 bytes for each voxel of the cells, known or not, over process
CPU time; the digest's SHA-256, which a reader may leave away, is stated on its own and subtracted.
"""

import functools
import hashlib
import math
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import zstandard
from tests.bench.timing import cpu_s, wall_s

from cairn_fusion.mapping.integrate import Integrator, integrate_scans
from cairn_map.codec.cell_code import Profile, decode_cell, encode_cell, encode_cells
from cairn_map.codec.cell_reading import cell_reader
from cairn_map.codec.octree.cell_content import CHILD_MASKS, HITS, LEAF_MASKS, MISSES
from cairn_map.codec.octree.channel_streams import stream_of_channel
from cairn_map.evidence.channels import Channel, ChannelKind
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.evidence_map import EvidenceMap
from cairn_map.evidence.grid import CellKey, Geometry
from cairn_sim.robots.record import Plan, scans_of, shots_of
from cairn_sim.robots.robots import ROBOTS
from cairn_sim.scene.scene_file import load_scene

Row = tuple[str, str, str]
Diff = dict[CellKey, Evidence]
Ints = npt.NDArray[np.int64]
DENSE_VOXEL_BYTES = 8
TOPOLOGY_AND_COUNTS = (CHILD_MASKS, LEAF_MASKS, HITS, MISSES)


def coding_rows(smoke: bool) -> Iterator[Row]:
    """One line each."""
    geometry = Geometry()
    plan = Plan(
        scene=load_scene("building"),
        robot=ROBOTS["orpheus"],
        path="experiment",
        scale=0.25,
        truth="none",
        last_stop=1 if smoke else 12,
    )
    diffs = _diffs(plan, geometry)
    total = EvidenceMap(geometry)
    for diff in diffs:
        total.merge(diff)
    yield from _set_rows("a measurement of five cameras, 4 cm", diffs[0], geometry, repeats=1 if smoke else 5)
    if not smoke:
        yield from _set_rows(f"the map of {len(diffs)} of them", total.packed(), geometry, repeats=3)
    again = _diffs(replace(plan, seed=plan.seed + 1, last_stop=1), geometry)
    yield from _noise_rows(diffs[0], again[0], geometry)


def _diffs(plan: Plan, geometry: Geometry) -> list[Diff]:
    """Evidence of each stop."""
    rig, stop, diffs = plan.robot.rig_of(plan.scale), [], []
    for shot, scan, _ in scans_of(plan, shots_of(plan), rig):
        stop.append(scan)
        if shot.ends_stop:
            diffs.append(integrate_scans(stop, rig, geometry, integrator=Integrator()))
            stop = []
    return diffs


def _set_rows(name: str, cells: Diff, geometry: Geometry, *, repeats: int) -> Iterator[Row]:
    """Rates and sizes of some cells."""
    voxels, sampled = sum(map(len, cells.values())), sum(len(part.sampled) for part in cells.values())
    yield name, f"{len(cells)}", f"cells, {voxels} voxels, {sampled} with samples"
    fast, small = (_encoded(cells, geometry, profile) for profile in Profile)
    raw = [{n: s.raw() for n, s in cell_reader(data).stored.items()} for data in fast]
    digest_s = cpu_s(lambda: [hashlib.sha256(stream).digest() for cell in raw for stream in cell.values()], repeats)
    dense = len(cells) * DENSE_VOXEL_BYTES * 8**geometry.depth
    yield "  digest, in each time below", f"{1e3 * digest_s:.1f}", "ms CPU, subtracted from the rates"
    for profile, coded in ((Profile.FAST, fast), (Profile.SMALL, small)):
        works: dict[str, Callable[[], object]] = {
            "encode": functools.partial(_encoded, cells, geometry, profile),
            # One after the other, as a server adds them up: each is gone before the next.
            "decode": functools.partial(_decoded_voxels, coded),
        }
        for what, work in works.items():
            seconds = cpu_s(work, repeats)
            rate = dense / (seconds - digest_s) / 1e9
            yield f"  {what}, {profile}", f"{1e3 * seconds:.0f}", f"ms CPU = {rate:.2f} GB/s dense-equivalent"
    for profile in Profile:
        one_s, two_s = (
            wall_s(functools.partial(encode_cells, cells, geometry, profile=profile, threads=threads), repeats)
            for threads in (1, 2)
        )
        yield f"  encode on 2 threads, {profile}", f"{1e3 * two_s:.0f}", f"ms wall, {one_s / two_s:.2f} x as fast"
    yield from _size_rows(fast, small, raw, cells, geometry, dense)


def _size_rows(
    fast: list[bytes], small: list[bytes], raw: list[dict[int, bytes]], cells: Diff, geometry: Geometry, dense: int
) -> Iterator[Row]:
    """Bytes in both profiles beside zstd, in all and by group."""

    def row(name: str, numbers: set[int] | None) -> Row:
        packed = sum(_zstd_bytes(cell, numbers) for cell in raw)
        ours = [sum(_stored_bytes(data, numbers) for data in coded) for coded in (fast, small)]
        return (
            f"  {name}: small",
            f"{ours[1]}",
            f"B; fast {ours[0]}, zstd-19 {packed}; small is {ours[1] / packed:.3f} of zstd-19",
        )

    yield "  whole files: small", f"{sum(map(len, small))}", f"B; fast {sum(map(len, fast))}, dense {dense}"
    yield row("all streams", None)
    yield row("topology and counts", set(TOPOLOGY_AND_COUNTS))
    without = _without_values(cells, geometry)
    geometry_without = _weights_alone(geometry)
    slim = [encode_cell(key, part, geometry_without, profile=Profile.SMALL).data for key, part in without.items()]
    # The values there are all zeros; what they still cost is counted.
    ours = sum(_stored_bytes(data, None) for data in slim)
    numbers = {stream_of_channel(c) + n for c in range(len(geometry.channels)) for n in (0, 1)}
    packed = sum(_zstd_bytes(cell, numbers | set(TOPOLOGY_AND_COUNTS)) for cell in raw)
    yield "  with presence and weights: small", f"{ours}", f"B; zstd-19 {packed}; {ours / packed:.3f} of it"
    for c, channel in enumerate(geometry.channels):
        first = stream_of_channel(c)
        yield row(channel.name, set(range(first, first + 1 + len(channel.planes))))


def _weights_alone(geometry: Geometry) -> Geometry:
    """The geometry with as many channels, of one value plane each."""
    channels = tuple(Channel(kind=ChannelKind.SCALAR, name=f"w{c}") for c in range(len(geometry.channels)))
    return Geometry(voxel_edge_um=geometry.voxel_edge_um, depth=geometry.depth, channels=channels)


def _without_values(cells: Diff, geometry: Geometry) -> Diff:
    """The same evidence with no more of the samples than their weights."""
    found: Diff = {}
    for key, evidence in cells.items():
        samples = np.zeros((len(evidence.sampled), 2 * len(geometry.channels)), np.int64)
        for c, channel in enumerate(geometry.channels):
            samples[:, 2 * c + 1] = evidence.samples[:, geometry.planes_of(channel.name)][:, -1]
        found[key] = Evidence(evidence.voxels, evidence.counts, evidence.sampled, samples)
    return found


def _noise_rows(diff: Diff, again: Diff, geometry: Geometry) -> Iterator[Row]:
    """What the noise alone costs: the entropy of a row's sums about what they would be without it.

    Two measurements that differ in the noise's seed alone differ in a voxel's means by d, whose variance is
    s^2 (1 / w + 1 / w'), and its sum's own deviation is s sqrt(w). For a normal d of any deviation the mean of log |d|
    is that of the log deviation less (gamma + ln 2) / 2; so the mean entropy needs no voxels of equal noise. A sum is
    a whole number; with a uniform number below 1 added, its differential entropy is its entropy. It is an estimate,
    not a bound: noise that is not normal has less, and what planes share counts for each.
    """
    rng = np.random.default_rng(1)
    coded = [encode_cell(key, part, geometry, profile=Profile.SMALL).data for key, part in diff.items()]
    for c, channel in enumerate(geometry.channels):
        planes = geometry.planes_of(channel.name)
        a, b = (part[:, planes].astype(np.float64) for part in _common(diff, again))
        both = (a[:, -1] > 0) & (b[:, -1] > 0)
        a, b = a[both], b[both]
        w, v = a[:, -1:], b[:, -1:]
        plain = channel.value_count
        sums = [part[:, :plain] + rng.random((len(part), plain)) for part in (a, b)]
        off = np.abs(sums[0] / w - sums[1] / v) * np.sqrt(w / (1 / w + 1 / v))
        log_deviation = np.log2(off).mean(axis=0) + (np.euler_gamma + math.log(2)) / 2 / math.log(2)
        bits = float((log_deviation + 0.5 * math.log2(2 * math.pi * math.e)).sum())
        first = stream_of_channel(c)
        stored = sum(_stored_bytes(data, set(range(first, first + 1 + len(channel.planes)))) for data in coded)
        rows = sum(int((part.samples[:, planes] != 0).any(axis=1).sum()) for part in diff.values())
        name = f"  noise of {channel.name}'s sums"
        yield name, f"{bits:.1f}", f"bits a row, of {len(a)} rows; all planes as stored: {8 * stored / rows:.1f}"


def _common(a: Diff, b: Diff) -> tuple[Ints, Ints]:
    """(R, P) samples of the voxels that both have samples of."""
    left: list[Ints] = []
    right: list[Ints] = []
    for key in sorted(a.keys() & b.keys()):
        one, other = a[key], b[key]
        places, others = one.voxels[one.sampled], other.voxels[other.sampled]
        left.append(one.samples[np.isin(places, others)])
        right.append(other.samples[np.isin(others, places)])
    return np.concatenate(left), np.concatenate(right)


def _encoded(cells: Diff, geometry: Geometry, profile: Profile) -> list[bytes]:
    return [encode_cell(key, evidence, geometry, profile=profile).data for key, evidence in cells.items()]


def _decoded_voxels(coded: list[bytes]) -> int:
    return sum(len(decode_cell(data).evidence) for data in coded)


def _stored_bytes(data: bytes, numbers: set[int] | None) -> int:
    return sum(len(s.body) for n, s in cell_reader(data).stored.items() if numbers is None or n in numbers)


def _zstd_bytes(raw: dict[int, bytes], numbers: set[int] | None) -> int:
    """Of each stream under zstd-19, or as it is where that is shorter."""
    compressor = zstandard.ZstdCompressor(level=19, write_content_size=False, write_checksum=False)
    wanted = [stream for n, stream in raw.items() if numbers is None or n in numbers]
    return sum(min(len(stream), len(compressor.compress(stream))) for stream in wanted)
