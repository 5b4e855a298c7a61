"""Evidence, geometries and commits made for tests: seeded, small, ugly on purpose."""

import numpy as np
from hypothesis import strategies as st
from tests import naive

from cairn_map.codec.cell_code import encode_cell
from cairn_map.commits.commit import Commit, CommitMeta, ScanPose, make_commit
from cairn_map.commits.cursor import Cursor
from cairn_map.evidence.channels import COLOUR, INTENSITY, TEMPERATURE, Channel, ChannelKind
from cairn_map.evidence.evidence import Evidence, packed_evidence
from cairn_map.evidence.fingerprint import fingerprint
from cairn_map.evidence.grid import CellKey, Geometry, cell_key
from cairn_map.wire.frames import CellFrame, Frame, FrameKind
from cairn_map.wire.messages import Done, More, ReplyHeader

DOSE = Channel(kind=ChannelKind.SCALAR, name="dose", unit="µSv/h", step=0.01, zero=-1.5)
SMALL = Geometry(voxel_edge_um=50_000, depth=3, channels=(COLOUR, INTENSITY, TEMPERATURE, DOSE))
"""One brick a cell, every kind of channel."""
MIDDLE = Geometry(voxel_edge_um=80_000, depth=5)
PLAIN = Geometry(voxel_edge_um=50_000, depth=3, channels=())
GEOMETRIES = (SMALL, MIDDLE, PLAIN)
ROBOT = "mole.0123456789abcdef"
KEY = cell_key((-1, 0, 2))


def random_evidence(seed: int, geometry: Geometry, *, voxels: int = 40, air: int = 3) -> Evidence:
    """Evidence as a robot makes it: some voxels with samples, and cubes of equal misses that collapse."""
    rng = np.random.default_rng(seed)
    top = 8**geometry.depth
    places = rng.integers(0, top, voxels)
    for _ in range(air):
        size = 8 ** int(rng.integers(1, geometry.depth))
        places = np.concatenate([places, rng.integers(0, top // size) * size + np.arange(size)])
    places = np.unique(places)
    counts = np.zeros((len(places), 2), np.int64)
    counts[:, 1] = 1
    seen = rng.random(len(places)) < 0.1
    counts[seen] = rng.integers(0, 5, (int(seen.sum()), 2))
    samples = np.zeros((len(places), geometry.plane_count), np.int64)
    for channel in geometry.channels:
        rows = np.nonzero(seen & (rng.random(len(places)) < 0.6))[0]
        weights = rng.integers(1, 4, len(rows))
        values = rng.integers(0, 300, (len(rows), channel.value_count))
        columns = [values[:, n] * weights for n in range(channel.value_count)]
        if "square_sum" in channel.planes:
            columns.append(values[:, 0] ** 2 * weights + rng.integers(0, 9, len(rows)))
        samples[rows, geometry.planes_of(channel.name)] = np.stack([*columns, weights], axis=1)
    return packed_evidence(places.astype(np.uint32), counts, samples, geometry)


def surface_evidence(seed: int, geometry: Geometry) -> Evidence:
    """Evidence as scans of a wall make it: a smooth sheet, smooth colours, noise on both, seen-through air before it.

    Counts fall off to one side; the air's misses are alike in large parts, so that it collapses; some of the sheet
    has no samples, and some of its voxels were missed.
    """
    rng = np.random.default_rng(seed)
    side = 2**geometry.depth
    x, y = np.meshgrid(np.arange(side), np.arange(side), indexing="ij")
    tilt = rng.uniform(-0.3, 0.3, 2)
    height = side * rng.uniform(0.4, 0.6) + tilt[0] * (x - side / 2) + tilt[1] * (y - side / 2)
    height = np.clip(np.rint(height + side / 16 * np.sin(x * 6 / side)), 0, side - 1).astype(np.int64)
    z = np.arange(side)[None, None, :]
    air, wall = z < height[..., None], (z == height[..., None]) & (rng.random((side, side, 1)) < 0.95)
    xyz = np.stack(np.nonzero(air | wall), axis=1)
    hit = wall[tuple(xyz.T)]
    near = 1 + xyz[:, 0] * 4 // side
    hits = np.where(hit, near + rng.poisson(1, len(xyz)), 0)
    counts = np.stack([hits, np.where(hit, rng.poisson(0.3, len(xyz)), near + (rng.random(len(xyz)) < 0.02))], axis=1)
    samples = np.zeros((len(xyz), geometry.plane_count), np.int64)
    for channel in geometry.channels:
        rows = np.nonzero(hit & (xyz[:, 1] < side * 0.8))[0]
        weights = np.maximum(counts[rows, 0] - (rng.random(len(rows)) < 0.1), 1)
        shades = 60 + rng.uniform(0, 3, channel.value_count) * (xyz[rows, :1] + 2 * xyz[rows, 1:2]) * 16 / side
        noise = rng.normal(0, 2, (len(rows), channel.value_count))
        sums = np.maximum(np.rint(shades * weights[:, None] + noise * np.sqrt(weights)[:, None]), 0).astype(np.int64)
        columns = list(sums.T)
        if "square_sum" in channel.planes:
            columns.append(sums[:, 0] ** 2 // weights + weights * rng.integers(1, 9, len(rows)))
        samples[rows, geometry.planes_of(channel.name)] = np.stack([*columns, weights], axis=1)
    places = np.array([naive.interleave(*voxel) for voxel in xyz.tolist()], np.uint32)
    return packed_evidence(places, counts, samples, geometry)


def voxels_below(evidence: Evidence, place: int) -> Evidence:
    """What of it lies before a place."""
    V = int(np.searchsorted(evidence.voxels, place))
    S = int(np.searchsorted(evidence.sampled, V))
    return Evidence(evidence.voxels[:V], evidence.counts[:V], evidence.sampled[:S], evidence.samples[:S])


@st.composite
def any_evidence(draw: st.DrawFn, geometry: Geometry, low: int = 0, high: int = 1 << 62) -> Evidence:
    """Few voxels with numbers of any size."""
    top = 8**geometry.depth
    places = draw(st.lists(st.integers(0, top - 1), unique=True, max_size=12))
    runs = draw(st.lists(st.integers(0, top // 8 - 1), max_size=2))
    count = st.integers(max(low, -(2**31) + 1), min(high, 2**31 - 1))
    number = st.one_of(st.just(0), st.integers(max(low, -5), 300), st.integers(low, high))
    voxels = {place: (draw(count), draw(count)) for place in places}
    voxels |= {8 * run + n: (0, 7) for run in runs for n in range(8)}
    samples = np.zeros((len(voxels), geometry.plane_count), np.int64)
    for row in draw(st.lists(st.integers(0, len(voxels) - 1), max_size=4)) if voxels else []:
        samples[row] = [draw(number) for _ in range(geometry.plane_count)]
    counts = np.array(list(voxels.values()), np.int64).reshape(-1, 2)
    return packed_evidence(np.array(list(voxels), np.uint32), counts, samples, geometry)


def as_dict(evidence: Evidence) -> naive.Evidence:
    """Packed evidence in the form of the slow twins."""
    planes = evidence.samples.shape[1]
    rows = dict(zip(evidence.sampled.tolist(), (tuple(row) for row in evidence.samples.tolist()), strict=True))
    return {
        place: (hits, misses, rows.get(n, (0,) * planes))
        for n, (place, (hits, misses)) in enumerate(
            zip(evidence.voxels.tolist(), evidence.counts.tolist(), strict=True)
        )
    }


def header_of(geometry: Geometry, cell: tuple[int, int, int]) -> dict[str, object]:
    """What `naive.encode_cell` wants to know."""
    channels = [(naive.CODES[c.kind], c.name, c.unit, c.step, c.zero) for c in geometry.channels]
    return {"depth": geometry.depth, "voxel_edge_um": geometry.voxel_edge_um, "cell": cell, "channels": channels}


def made_meta(geometry: Geometry, n: int = 0, **fields: object) -> CommitMeta:
    """Meta of the n-th commit of one robot."""
    pose = ScanPose(time_s=1.5e9, t_map_rig=(1.0, 2.0, 0.4), q_map_rig=(0.0, 0.0, 0.0, 1.0), sigma_m=0.01)
    given = {"id": f"{ROBOT}.{n}", "geometry": geometry.digest().hex(), "captured_s": (1.5e9, 1.5e9), "scans": (pose,)}
    return CommitMeta.model_validate(given | fields)


def made_commit(seed: int = 0, geometry: Geometry = SMALL, **fields: object) -> Commit:
    """A commit of two cells."""
    diff = {
        cell_key((0, 0, 0)): random_evidence(seed, geometry, voxels=20, air=1),
        KEY: random_evidence(seed + 1, geometry, voxels=20, air=1),
    }
    return make_commit(made_meta(geometry, **fields), diff, geometry)


def made_cursor(seq: int = 7) -> Cursor:
    """A cursor of a made-up log."""
    return Cursor(bytes(range(16)), seq, bytes(range(100, 116)))


def made_frames(geometry: Geometry = SMALL) -> list[Frame]:
    """One frame of every kind."""
    start, to = made_cursor(3), made_cursor(9)
    evidence = random_evidence(5, geometry, voxels=12, air=1)
    payload = encode_cell(KEY, evidence, geometry).data

    def cell_frame(kind: FrameKind, key: CellKey = KEY, **fields: object) -> CellFrame:
        given = {"from_cursor": start, "to_cursor": to, "fingerprint": fingerprint(evidence, key), **fields}
        return CellFrame(kind=kind, cell=key, **given)  # type: ignore[arg-type]

    return [
        ReplyHeader(
            to=str(to), vector={ROBOT: [[0, 4], [6, 9]]}, stable={}, tip=(9, "0" * 64), retracts=[f"{ROBOT}.2"]
        ),
        cell_frame(FrameKind.DELTA, payload=payload, own_excluded=True),
        cell_frame(FrameKind.STATE, payload=payload, blocks=np.array([0, 3, 7], np.uint32)),
        cell_frame(FrameKind.FULL, payload=payload, from_cursor=None),
        cell_frame(FrameKind.RESET),
        Done(to=str(to), rest=fingerprint(evidence, KEY).hex()),
        More(to=str(to)),
    ]
