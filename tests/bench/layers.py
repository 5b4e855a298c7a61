"""Layers: what the program's room for several of them costs a map that has one, next to the plain path, by turns.

plain    the cell code, snapshot and file of one grid, and a map in a store without layers
layered  the same map and cells by the code that knows of layers, and in a store of a map with all its layers
"""

import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
from tests.bench.pushing import Bodies, Diff
from tests.fixtures.map.layers import layer_commit
from tests.fixtures.map.made import surface_evidence
from tests.fixtures.server.store_contract import new_of

from cairn_map.codec.cell_code import encode_cell
from cairn_map.codec.layer_code import encode_layer_cell
from cairn_map.epochs.cell_history import CellHistory
from cairn_map.epochs.epoch import BASE
from cairn_map.epochs.history_map import HistoryMap
from cairn_map.epochs.layer import EVIDENCE, LAYERS_MAX, MapLayer
from cairn_map.evidence.grid import Geometry, cell_key
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_map.queries.layers.layered_snapshot import LayeredSnapshot
from cairn_map.queries.map_snapshot import snapshot_of
from cairn_server.folding.cell_cache import CellCache
from cairn_server.folding.folding import fold_pending
from cairn_server.store.sqlite.store import SqliteStore
from cairn_server.store.store_rows import MapRow, NewCommit

Row = tuple[str, str, str]
GEOMETRY = Geometry(depth=6)
CELLS = [cell_key((i, 0, 0)) for i in range(4)]


def layer_rows(smoke: bool) -> Iterator[Row]:
    """Rows of the bench."""
    turns = 5 if smoke else 40
    evidence = {key: surface_evidence(n, GEOMETRY) for n, key in enumerate(CELLS)}
    layer = MapLayer(geometry=GEOMETRY)
    histories = {key: CellHistory({BASE: each}) for key, each in evidence.items()}
    plain = [encode_cell(key, each, GEOMETRY).data for key, each in evidence.items()]
    layered = [encode_layer_cell(key, each, layer).data for key, each in histories.items()]
    yield "bytes of a map's cells, one layer : plain", f"{sum(map(len, layered)) / sum(map(len, plain)):.3f}", "ratio"
    yield from _ratio(
        "encode 4 cells of 64^3",
        lambda: [encode_cell(key, each, GEOMETRY) for key, each in evidence.items()],
        lambda: [encode_layer_cell(key, each, layer) for key, each in histories.items()],
        turns,
    )
    whole = HistoryMap(layer)
    whole.merge(evidence)
    alone, points = snapshot_of(whole), np.random.default_rng(1).uniform(0, 10, (100_000, 3))
    together = LayeredSnapshot({EVIDENCE: alone})
    ways = np.random.default_rng(2).normal(size=(2_000, 3))
    origin = [1.3, 1.3, 1.3]
    for what, ask in (
        ("states of 100 000 points", lambda each: each.state_at(points)),
        ("2 000 rays", lambda each: each.cast_rays([origin], ways, max_range_m=10.0)),
        ("occupied voxels", lambda each: each.occupied_in()),
    ):
        yield from _ratio(what, lambda ask=ask: ask(alone), lambda ask=ask: ask(together), turns)
    yield from _store_rows([{key: each} for key, each in evidence.items()], commits=20 if smoke else 250)


def _ratio(what: str, plain: Callable[[], object], layered: Callable[[], object], turns: int) -> Iterator[Row]:
    """Best times of both, by turns: other work on the machine only ever adds to one."""
    best = [float("inf")] * 2
    for _ in range(turns):
        for n, work in enumerate((plain, layered)):
            start_s = time.process_time()
            work()
            best[n] = min(best[n], time.process_time() - start_s)
    yield f"{what}, plain", f"{1e3 * best[0]:.2f}", "ms"
    yield f"{what}, one layer : plain", f"{best[1] / best[0]:.2f}", "ratio"


def _store_rows(diffs: list[Diff], commits: int) -> Iterator[Row]:
    """Push and fold into a map without layers, and into one with all that it may have, in turn."""
    bodies = Bodies(diffs, GEOMETRY)
    best = {(what, has_layers): float("inf") for what in ("push", "fold") for has_layers in (False, True)}
    sizes = {}
    with tempfile.TemporaryDirectory() as folder, closing(SqliteStore(Path(folder))) as store:
        for turn in range(3):
            for has_layers in (False, True):
                row, _ = store.create_map(f"map-{turn}-{has_layers:d}", GEOMETRY, SensorModel())
                for n in range((LAYERS_MAX - 1) * has_layers):
                    store.append(row, new_of(layer_commit(n, f"layer_{n}", of=GEOMETRY)))
                fold_pending(store, row, CellCache(GEOMETRY), limit=64)
                made = [bodies.commit("mole", n) for n in range(commits)]
                for what, spent_s in zip(("push", "fold"), _push_and_fold_s(store, row, made), strict=True):
                    best[what, has_layers] = min(best[what, has_layers], spent_s)
                with store.snapshot(row) as snapshot:
                    sizes[has_layers] = snapshot.totals().size_bytes
    for what in ("push", "fold"):
        plain_s, layered_s = best[what, False] / commits, best[what, True] / commits
        yield f"{what} a commit, map without layers", f"{1e3 * plain_s:.2f}", "ms"
        yield f"{what} a commit, map with {LAYERS_MAX} layers : without", f"{layered_s / plain_s:.2f}", "ratio"
    yield "bytes of the folded cells, with layers : without", f"{sizes[True] / sizes[False]:.3f}", "ratio"


def _push_and_fold_s(store: SqliteStore, row: MapRow, made: list[NewCommit]) -> tuple[float, float]:
    """Processor time of both, seconds."""
    start_s = time.process_time()
    for commit in made:
        store.append(row, commit)
    pushed_s, cache = time.process_time(), CellCache(GEOMETRY)
    while fold_pending(store, row, cache, limit=64):
        pass
    return pushed_s - start_s, time.process_time() - pushed_s
