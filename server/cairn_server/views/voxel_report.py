"""Report on one voxel: its numbers, and the commits that they are made of.

    cell at rest  -->  hits, misses, means        exact
    diffs of the cell's newest log entries  -->  who saw the voxel, how often, when

Retracted commits are left out, as if they had never come.
"""

import re

import numpy as np

from cairn_map.commits.ids import CommitId
from cairn_map.errors import BadInputError, NotFoundError
from cairn_map.evidence.channels import Channel
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.grid import CellKey, Geometry, cell_key, centres_of_voxels, split_voxels, voxels_of_points
from cairn_map.evidence.voxels import Reading, measured_or_none, voxels_of_evidence
from cairn_map.wire.messages import LogEntry
from cairn_map.wire.voxel_messages import ChannelReading, VoxelAnswer, VoxelCommit
from cairn_server.cell_room import DECODING, voxels_of
from cairn_server.folding.cells import Cells
from cairn_server.folding.cells_at_rest import decode_stored, sound_cell
from cairn_server.store.store import Snapshot, Store
from cairn_server.store.store_rows import MapRow
from cairn_server.views.readings import past_reading, stored_reading, was_captured

ENTRIES_MAX = 32
"""Most of the cell's newest log entries that are decoded, some 10 ms each."""
VOXEL = re.compile(r"(0|-?[1-9]\d{0,9}),(0|-?[1-9]\d{0,9}),(0|-?[1-9]\d{0,9})")


POINT = re.compile(r",".join([r"(-?[0-9]{1,9}(?:\.[0-9]{1,15})?)"] * 3))


def voxel_at(geometry: Geometry, text: str) -> str:
    """The voxel `i,j,k` that a point `x,y,z` in metres lies in.

    Raises:
        BadInputError: kind `bad_point`; `cell_range`: it lies beyond the numbered space.
    """
    found = POINT.fullmatch(text)
    if found is None:
        raise BadInputError("bad_point", f"a point is x,y,z in metres, as decimals, got {text[:60]!r}")
    voxel = voxels_of_points(np.array([float(word) for word in found.groups()]), geometry)[0]
    return ",".join(map(str, voxel.tolist()))


def asked_voxel(store: Store, cells: Cells, row: MapRow, text: str, *, at_s: float | None = None) -> VoxelAnswer:
    """Report on the voxel `i,j,k` of the map's lattice (FORMAT.md 2), now or as it was at a time.

    Raises:
        BadInputError: kind `bad_cell` or `cell_range`: no voxel is numbered so.
        ConflictError: kind `not_known`: evidence of that time is not kept apart any more.
        NotFoundError: kind `no_cell`: its cell was never seen.
    """
    found = VOXEL.fullmatch(text)
    if found is None:
        raise BadInputError("bad_cell", f"a voxel is i,j,k in decimal, got {text[:40]!r}")
    voxel = int(found[1]), int(found[2]), int(found[3])
    depth = row.geometry.depth
    cell = voxel[0] >> depth, voxel[1] >> depth, voxel[2] >> depth
    key = cell_key(cell)
    place = int(split_voxels(np.array([voxel]), row.geometry)[1][0])
    with cells.reading(row) as faults, store.snapshot(row) as snapshot:
        stored = sound_cell(snapshot, key, row.layer, faults.healed)
        if stored is None:
            raise NotFoundError("no_cell", f"no robot has seen cell {','.join(map(str, cell))} of map {row.name}")
        commits, more = _commits(snapshot, key, place, row, at_s)
        cursor = snapshot.head
        with DECODING.of_cell(row.geometry, stored.voxels):
            evidence = stored_reading(stored, row) if at_s is None else past_reading(snapshot, stored, row, at_s)
            seen = _only(evidence, place)
    voxels = voxels_of_evidence(key, seen, row.geometry, row.sensor_model, occupied_only=False)
    x, y, z = centres_of_voxels(np.array([voxel]), row.geometry)[0].tolist()
    return VoxelAnswer(
        voxel=voxel,
        cell=cell,
        centre_m=(x, y, z),
        hits=int(seen.counts[:, 0].sum()),
        misses=int(seen.counts[:, 1].sum()),
        probability=float(voxels.probability[0]) if len(seen) and seen.counts.any() else None,
        channels=_readings(voxels.readings, row.geometry),
        lm=stored.lm,
        cursor=str(cursor),
        commits=commits,
        more=more,
        gone=stored.gone_seq > 0,
    )


def _only(evidence: Evidence, place: int) -> Evidence:
    """Evidence of one voxel alone, empty if it has none."""
    at = int(np.searchsorted(evidence.voxels, place))
    rows = np.array([at]) if at < len(evidence) and evidence.voxels[at] == place else np.empty(0, np.int64)
    keep = np.zeros(len(evidence), np.bool_)
    keep[rows] = True
    return evidence.where(keep)


def _readings(readings: dict[str, Reading], geometry: Geometry) -> list[ChannelReading]:
    return [_reading(readings[channel.name], channel) for channel in geometry.channels]


def _reading(reading: Reading, channel: Channel) -> ChannelReading:
    weight = int(reading.weight.sum())
    return ChannelReading(
        name=channel.name,
        kind=channel.kind,
        unit=channel.unit,
        weight=weight,
        mean=[float(value) for value in reading.mean.ravel()] if weight else [],
        sigma=float(reading.sigma[0]) if weight and reading.sigma is not None else None,
        measured_s=measured_or_none(reading, 0) if weight else None,
        class_name=reading.name_at(0) if weight else None,
        unsure=bool(reading.unsure[0]) if weight and reading.unsure is not None else None,
    )


def _commits(
    snapshot: Snapshot, key: CellKey, place: int, row: MapRow, at_s: float | None
) -> tuple[list[VoxelCommit], bool]:
    """Commits that saw a voxel, up to a time, the newest first; and True if the cell has older ones."""
    found = snapshot.contributions(key, after_seq=0, newest=ENTRIES_MAX + 1)
    is_more = len(found) > ENTRIES_MAX
    if at_s is not None:
        found = [entry for entry in found if was_captured(snapshot, entry, row, at_s)]
    counts: dict[CommitId, tuple[int, int]] = {}
    for contribution in found[-ENTRIES_MAX:]:
        body = snapshot.diff(contribution.commit, key)
        if body is not None:
            with DECODING.of_cell(row.geometry, voxels_of(body)):
                hits, misses = _only(decode_stored(key, body).evidence, place).counts.sum(axis=0).tolist()
            sign = 1 if contribution.kind == b"+" else -1
            before = counts.get(contribution.commit, (0, 0))
            counts[contribution.commit] = (before[0] + sign * hits, before[1] + sign * misses)
    seqs = {contribution.commit: contribution.seq for contribution in found}
    told = sorted((seqs[commit], counted) for commit, counted in counts.items() if any(n > 0 for n in counted))
    commits = [_commit(_entry(snapshot, seq), *counted) for seq, counted in reversed(told)]
    return commits, is_more


def _entry(snapshot: Snapshot, seq: int) -> LogEntry:
    (entry,) = snapshot.log(after_seq=seq - 1, limit=1)
    return entry


def _commit(entry: LogEntry, hits: int, misses: int) -> VoxelCommit:
    return VoxelCommit(id=entry.id, hits=hits, misses=misses, captured_s=entry.captured_s)
