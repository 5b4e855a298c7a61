"""Memory of one cell at work: never more than the room that is taken for it, whatever it holds."""

import subprocess
import sys

import pytest

from cairn_map.errors import BadInputError
from cairn_map.evidence.grid import Geometry, geometry_for
from cairn_server.cell_room import changed_bytes, check_geometry, compared_bytes, decoded_bytes, voxels_of_cell
from cairn_server.memory_shares import LIMIT_MIN_BYTES, memory_shares

MEASURED = """
import math
import sys
from types import SimpleNamespace
import numpy as np
from cairn_map.codec.cell_code import decode_cell, encode_cell
from cairn_map.evidence.blocks import blocks_of
from cairn_map.evidence.brick_cell import BrickCell
from cairn_map.evidence.cell_order import hottest_k
from cairn_map.evidence.evidence import packed_evidence
from cairn_map.evidence.fingerprint import fingerprint
from cairn_map.epochs.layer import MapLayer
from cairn_map.evidence.grid import Geometry, cell_key
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_server.folding.cells_at_rest import decode_rows
from cairn_server.cell_room import DECODING
from cairn_map.commits.cursor import ENTRY_FOLD
from cairn_map.epochs.epoch import BASE
from cairn_server.views import retract_preview

geometry = Geometry.model_validate_json(sys.argv[1])
key, rng = cell_key((0, 0, 0)), np.random.default_rng(1)


def full(count):
    # No two voxels alike: nothing collapses, and every number takes its bytes.
    counts, samples = rng.integers(1, 60, (count, 2)), rng.integers(1, 1000, (count, geometry.plane_count))
    return packed_evidence(np.arange(count, dtype=np.uint32), counts, samples, geometry)


def peak_bytes():
    with open("/proc/self/status") as file:
        return next(1024 * int(line.split()[1]) for line in file if line.startswith("VmHWM"))


def change(data):
    cell = BrickCell(geometry)
    cell.merge(decode_cell(data).evidence)
    diff = decode_cell(data).evidence
    cell.merge(diff)
    blocks_of(diff)
    del diff
    packed = cell.packed()
    encode_cell(key, packed, geometry)
    fingerprint(packed, key), hottest_k(packed, geometry)


class OneCommit:
    # Snapshot of a cell of which a commit saw each voxel, and others more.
    def __init__(self, count):
        ones = np.ones((count, 2), np.int64), np.ones((count, geometry.plane_count), np.int64)
        self.body = encode_cell(key, packed_evidence(np.arange(count, dtype=np.uint32), *ones, geometry), geometry).data

    def diff(self, commit, key):
        return self.body

    def contributions(self, key, *, after_seq):
        return [SimpleNamespace(commit="one", kind=ENTRY_FOLD, epoch=BASE)]


def compare(data):
    retract_preview.sound_cell = lambda *_: SimpleNamespace(voxels=1, body=data)
    retract_preview.stored_history = lambda stored, layer: decode_rows(key, stored.body, layer).history
    row = SimpleNamespace(geometry=geometry, layer=MapLayer(geometry=geometry), sensor_model=SensorModel())
    bound = retract_preview._Bound(math.inf)
    retract_preview._changes_of(ONE[data is small], key, row, frozenset(["one"]), SimpleNamespace(healed=[]), bound)


small, data = encode_cell(key, full(64), geometry).data, sys.stdin.buffer.read()
if not data:
    sys.stdout.buffer.write(encode_cell(key, full(8**geometry.depth), geometry).data)
    sys.exit()
DECODING.limit_bytes = 1 << 40
change(small)
for work in (decode_cell, change, compare):
    if work is compare:
        ONE = OneCommit(8**geometry.depth), OneCommit(64)
        compare(small)
    with open("/proc/self/clear_refs", "w") as file:
        file.write("5")
    before = peak_bytes()
    work(data)
    print(peak_bytes() - before)
"""


def run(geometry: Geometry, data: bytes) -> bytes:
    command = [sys.executable, "-c", MEASURED, geometry.model_dump_json()]
    return subprocess.run(command, input=data, capture_output=True, check=True).stdout


@pytest.mark.processes
@pytest.mark.parametrize("geometry", [Geometry(), Geometry(channels=())], ids=["standard", "occupancy"])
def test_a_full_cell_takes_no_more_than_its_room(geometry: Geometry) -> None:
    decoded, changed, compared = map(int, run(geometry, run(geometry, b"")).split())
    voxels = voxels_of_cell(geometry)
    assert 0.5 < decoded / decoded_bytes(geometry, voxels) <= 1
    assert 0.5 < changed / changed_bytes(geometry, voxels) <= 1
    assert 0.5 < compared / compared_bytes(geometry, voxels) <= 1


@pytest.mark.parametrize("edge_m", [0.001, 0.01, 0.02, 0.04, 0.05, 0.08, 0.2, 1.0])
def test_every_standard_grid_fits_the_smallest_server(edge_m: float) -> None:
    shares = memory_shares(LIMIT_MIN_BYTES)
    for count in range(17):
        channels = Geometry.model_validate({"channels": [{"kind": "colour", "name": f"c{n}"} for n in range(count)]})
        check_geometry(geometry_for(voxel_edge_m=edge_m, channels=channels.channels), shares)


@pytest.mark.parametrize("geometry", [Geometry(depth=8), Geometry(depth=8, channels=())])
def test_larger_cells_are_refused_with_the_memory_that_would_do(
    geometry: Geometry, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cairn_server.memory_shares.memory_bytes", lambda: 1 << 44)
    with pytest.raises(BadInputError, match=r"choose smaller cells \(depth 7.*set memory_bytes to") as refused:
        check_geometry(geometry, memory_shares(LIMIT_MIN_BYTES))
    named_bytes = int(refused.value.message.split("memory_bytes to ")[1].split()[0])
    check_geometry(geometry, memory_shares(named_bytes))
    with pytest.raises(BadInputError):
        check_geometry(geometry, memory_shares(named_bytes - 1_000_000))
