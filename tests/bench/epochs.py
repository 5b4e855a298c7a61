"""Maps with epochs next to one sum of the same scans: what they forget, keep, report, weigh and take.

    $ python -m tests.bench epochs            # 25 minutes on two cores
    $ python -m tests.bench --smoke epochs

Bytes: nine stops of the head with five cameras in the laboratories at 4 cm are nine passes, each in an epoch of its
own, over the 12 cells that hold most. Rows are coded one by one, so 100 passes weigh what their rows weigh: the nine
repeat.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial

import numpy as np
from tests.bench.following import traffic_rows
from tests.bench.forgetting import forgetting_rows
from tests.bench.moving import change_rows, static_rows
from tests.bench.timing import cpu_s
from tests.fixtures.sim.passes import Cells, Measured, histories, measured, recorded, sums

from cairn_map.codec.cell_code import Profile, coding_of, decode_cell, encode_cell
from cairn_map.codec.history_code import decode_history, encode_history
from cairn_map.codec.layer_code import read_cell, row_coding, write_cell
from cairn_map.codec.view_code import encode_view
from cairn_map.epochs.cell_history import CellHistory, cell_history
from cairn_map.epochs.epoch import BASE, Epoch
from cairn_map.epochs.history_cell import HistoryCell
from cairn_map.epochs.history_map import HistoryMap
from cairn_map.epochs.layer import MapLayer
from cairn_map.epochs.present import present
from cairn_map.evidence.brick_cell import BrickCell
from cairn_map.evidence.channels import COLOUR, TEMPERATURE
from cairn_map.evidence.evidence import Evidence, packed_evidence
from cairn_map.evidence.grid import BRICK_DEPTH, CellKey, Geometry, geometry_for
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_map.evidence.view import FULL_STYLE, Extent
from cairn_sim.robots.record import Plan
from cairn_sim.robots.robots import ROBOTS
from cairn_sim.scene.scene_file import load_scene

Row = tuple[str, str, str]
Step = Callable[[Evidence], None]
CELLS, MANY = 12, 100


def epoch_rows(smoke: bool) -> Iterator[Row]:
    """One line each."""
    yield from forgetting_rows(smoke)
    yield from static_rows(smoke)
    yield from change_rows(smoke)
    yield from pass_rows(smoke)
    yield from traffic_rows(smoke)


def pass_rows(smoke: bool) -> Iterator[Row]:
    """Bytes and times of passes over the same cells."""
    layer = MapLayer(
        geometry=geometry_for(voxel_edge_m=0.08 if smoke else 0.04, channels=(COLOUR, TEMPERATURE)), epoch_s=1
    )
    cells = _busiest(histories(_passes(layer, stops=3 if smoke else 9), layer.geometry), 3 if smoke else CELLS)
    yield from _byte_rows(cells, layer)
    yield from _joiner_rows(cells, layer)
    yield from _time_rows(cells, layer, repeats=2 if smoke else 9)


def _passes(layer: MapLayer, *, stops: int) -> list[Measured]:
    """Stops as passes: one after another, each in its own epoch."""
    plan = Plan(
        scene=load_scene("building"),
        robot=ROBOTS["orpheus"],
        path="labs",
        truth="none",
        scale=0.25,
        last_stop=stops,
    )
    bare = MapLayer(geometry=layer.geometry)
    return [Measured(commit.stop, Epoch(n), commit.diff) for n, commit in enumerate(measured(recorded(plan), bare))]


def _busiest(cells: Cells, count: int) -> Cells:
    kept = sorted(cells, key=lambda key: -sum(len(row) for row in cells[key].rows.values()))[:count]
    return {key: cells[key] for key in sorted(kept)}


def _byte_rows(cells: Cells, layer: MapLayer) -> Iterator[Row]:
    passes = max(len(history) for history in cells.values())
    rows = sum(len(history) for history in cells.values())
    yield f"{passes} passes over {len(cells)} cells, {_edge(layer)}, colour and temperature", f"{rows}", "rows"
    one_sum = sums(cells, layer.geometry)
    for profile in Profile:
        whole = _bytes(cells, layer, profile)
        single = _sum_bytes(one_sum, layer.geometry, profile)
        by_epoch = {
            epoch: sum(
                len(encode_cell(key, history.rows[epoch], layer.geometry, profile=profile).data)
                for key, history in cells.items()
                if epoch in history.rows
            )
            for epoch in sorted({epoch for history in cells.values() for epoch in history})
        }
        mean = sum(by_epoch.values()) / len(by_epoch)
        yield f"  {profile}: one sum", f"{single / 1e6:.2f}", "MB"
        yield (
            f"  {profile}: every pass",
            f"{whole / 1e6:.2f}",
            f"MB = {whole / single:.2f} x one sum; a pass {mean / 1e6:.2f} MB",
        )
        many = _repeated(cells, MANY)
        size, many_sum = _bytes(many, layer, profile), _sum_bytes(sums(many, layer.geometry), layer.geometry, profile)
        yield (
            f"  {profile}: {MANY} passes, the {passes} repeated",
            f"{size / 1e6:.1f}",
            f"MB = {size / many_sum:.1f} x one sum of {many_sum / 1e6:.2f} MB",
        )


def _joiner_rows(cells: Cells, layer: MapLayer) -> Iterator[Row]:
    """Bytes until who joins sees all cells as they are now: their views, before any row (rule S6)."""
    first = min(epoch for history in cells.values() for epoch in history)
    alone = {key: cell_history({first: history.rows[first]}) for key, history in cells.items() if first in history.rows}
    passes = len({epoch for history in cells.values() for epoch in history})
    for text, seen in (
        ("1 pass", alone),
        (f"{MANY} passes, the same place", _repeated(alone, MANY)),
        (f"{passes} passes", cells),
        (f"{MANY} passes, the {passes} repeated", _repeated(cells, MANY)),
    ):
        views = sum(_view_bytes(key, history, layer) for key, history in seen.items() if len(history))
        rows = _bytes(seen, layer, Profile.FAST)
        yield (
            f"  until who joins sees the present of {text}",
            f"{views / 1e6:.3f}",
            f"MB; all rows, fast {rows / 1e6:.2f}",
        )


def _view_bytes(key: CellKey, history: CellHistory, layer: MapLayer) -> int:
    read = present(history, layer.geometry, SensorModel()).evidence
    return len(encode_view(key, read, layer.geometry, SensorModel(), style=replace(FULL_STYLE, extent=Extent.KNOWN)))


def _repeated(cells: Cells, count: int) -> Cells:
    """So many passes, those there are over and over."""
    epochs = sorted({epoch for history in cells.values() for epoch in history})
    return {
        key: cell_history({Epoch(n): row for n in range(count) if (row := history.rows.get(epochs[n % len(epochs)]))})
        for key, history in cells.items()
    }


def _time_rows(cells: Cells, layer: MapLayer, *, repeats: int) -> Iterator[Row]:
    """Of the cell that holds most."""
    geometry, bare, model = layer.geometry, MapLayer(geometry=layer.geometry), SensorModel()
    key, history = max(cells.items(), key=lambda item: len(item[1].total(geometry)))
    one_sum = cell_history({BASE: history.total(geometry)})
    evidence, newest = one_sum.rows[BASE], history.rows[max(history)]
    title = f"the fullest of these cells: {len(evidence)} known voxels, {len(history)} rows"
    yield title, "", "ms CPU, with epochs and in one sum"
    data, sum_data = encode_history(key, history, layer).data, encode_cell(key, evidence, geometry).data
    brick, brick_sum = _brick(history, geometry), _brick(one_sum, geometry)
    rows, cell = HistoryCell(key, layer, row_coding(layer)), BrickCell(geometry)
    cell.merge(evidence)
    for epoch, row in history.rows.items():
        rows.merge(epoch, row)
    write_cell(rows)
    rows.rest()
    last = max(history)
    works = {
        "read it": (lambda: present(history, geometry, model), lambda: model.log_odds(evidence.counts)),
        "read its fullest brick": (
            lambda: present(brick, geometry, model),
            lambda: present(brick_sum, geometry, model),
        ),
        "encode it, fast": (lambda: encode_history(key, history, layer), lambda: encode_cell(key, evidence, geometry)),
        "decode it": (lambda: decode_history(data), lambda: decode_cell(sum_data)),
        "merge a commit and take it out again": (
            lambda: _there_and_back(partial(rows.merge, last), partial(rows.unmerge, last), newest),
            lambda: _there_and_back(cell.merge, cell.unmerge, newest),
        ),
        "fold a commit: read, merge, write": (
            lambda: _folded(data, key, layer, last, newest),
            lambda: _folded(sum_data, key, bare, BASE, newest),
        ),
    }
    for name, (with_epochs, without) in works.items():
        own, other = cpu_s(with_epochs, repeats), cpu_s(without, repeats)
        yield f"  {name}", f"{1e3 * own:.3f}", f"ms; one sum {1e3 * other:.3f} ms"
    yield from _memory_rows(cells, layer)


def _memory_rows(cells: Cells, layer: MapLayer) -> Iterator[Row]:
    """Memory of a robot's map that got the passes one after another, and is read."""
    geometry, passes = layer.geometry, sorted({epoch for history in cells.values() for epoch in history})
    maps = [HistoryMap(each, coding=coding_of(geometry)) for each in (layer, MapLayer(geometry=geometry))]
    for epoch in passes:
        diff = {key: history.rows[epoch] for key, history in cells.items() if epoch in history.rows}
        maps[0].merge(diff, epoch=epoch)
        maps[1].merge(diff)
    for each in maps:
        each.frozen_cells(SensorModel())
    for text, rests in (("growing", 0), ("at rest", 2)):
        for _ in range(rests):
            maps[0].rest()
        held, one_sum = (each.size_bytes + each.reading_bytes for each in maps)
        yield (
            f"memory of a map of these passes, read, {text}",
            f"{held / 1e6:.1f}",
            f"MB = {held / one_sum:.2f} x one sum of {one_sum / 1e6:.1f} MB",
        )


def _there_and_back(merge: Step, unmerge: Step, evidence: Evidence) -> None:
    merge(evidence)
    unmerge(evidence)


def _folded(data: bytes, key: CellKey, layer: MapLayer, epoch: Epoch, evidence: Evidence) -> bytes:
    cell = read_cell(data, key, layer)
    cell.merge(epoch, evidence)
    return write_cell(cell).data


def _brick(history: CellHistory, geometry: Geometry) -> CellHistory:
    """The rows of the brick that has most known voxels, of those that all rows have."""
    shift = np.uint32(3 * BRICK_DEPTH)
    bricks = np.concatenate([row.voxels >> shift for row in history.rows.values()])
    brick = np.bincount(bricks).argmax()
    parts = {}
    for epoch, row in history.rows.items():
        mine = (row.voxels >> shift) == brick
        samples = np.zeros((len(row), geometry.plane_count), np.int64)
        samples[row.sampled] = row.samples
        parts[epoch] = packed_evidence(row.voxels[mine], row.counts[mine], samples[mine], geometry)
    return cell_history(parts)


def _bytes(cells: Cells, layer: MapLayer, profile: Profile) -> int:
    return sum(len(encode_history(key, history, layer, profile=profile).data) for key, history in cells.items())


def _sum_bytes(cells: Cells, geometry: Geometry, profile: Profile) -> int:
    return sum(
        len(encode_cell(key, history.rows[BASE], geometry, profile=profile).data) for key, history in cells.items()
    )


def _edge(layer: MapLayer) -> str:
    return f"{layer.geometry.voxel_edge_m * 100:g} cm"
