"""Maps to ask without a robot: on a server, in a folder of cells (`cairn map export --cells`), in a robot's state."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from cairn_client.folders.needed_cells import Needs, needed_cells
from cairn_client.folders.state_folder import is_state_folder, opened_replica
from cairn_client.http.api import MapApi
from cairn_client.http.http_link import cells_with_evidence, download_cell
from cairn_client.http.map_url import split_map_url
from cairn_client.replica.replica import Replica
from cairn_client.replica.replica_store import FILE_NAME
from cairn_map.codec.cell_code import coding_of, decode_cell
from cairn_map.codec.cell_reading import EVIDENCE_BYTES_MAX
from cairn_map.codec.layer_code import row_bodies
from cairn_map.epochs.epoch import BASE, begin_s
from cairn_map.epochs.history_map import HistoryMap
from cairn_map.epochs.layer import EVIDENCE
from cairn_map.epochs.map_reading import BlockTimes
from cairn_map.errors import BadInputError, NotFoundError
from cairn_map.evidence.grid import CellKey, cell_of_key
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_map.files.cell_folder import MAP_FILE, cell_path, read_cells, read_head
from cairn_map.machine_memory import standard_limit_bytes
from cairn_map.queries.layers.layered_snapshot import LayeredSnapshot
from cairn_map.queries.map_snapshot import MapSnapshot, snapshot_at, snapshot_of
from cairn_map.render.map_picture import Ages
from cairn_map.wire.messages import MapInfo


@dataclass(frozen=True, slots=True, eq=False)
class FolderMap:
    """A map that lies in a folder."""

    snapshot: MapSnapshot
    ages: Ages | None
    """Ages of all that has a time in a map with epochs; else of what the robot measured itself, None of mere cells."""


def open_map(
    place: Path | str, *, token: str | None = None, memory_bytes_max: int | None = None, at_s: float | None = None
) -> MapSnapshot:
    """A map as a snapshot to ask, from a server or a folder, without a robot.

        open_map("http://base:8750/maps/lab").probability_at([[1.0, 2.0, 0.4]])

    From a server every cell is downloaded and checked; `cairn clone URL DIR` keeps a copy that is brought up to date
    by what changed alone.

    Args:
        place: `http://HOST:PORT/maps/NAME`, a folder of cells that `cairn map export --cells` wrote, or the state
            folder of a robot or copy that is not running.
        token: for a server that wants one.
        memory_bytes_max: largest size in memory of a map from a server; None: a quarter of the machine's memory.
        at_s: UTC seconds since 1970: the map as it was then, by time of capture; None: now.

    Raises:
        ConflictError: kind `not_known`: with `at_s`, of a map without epochs.
        BadInputError: kind `no_map_folder`: the folder holds neither cells nor a robot's state; a bad URL; no token.
            Kind `too_large`: the server's map does not fit into the memory limit.
        ConflictError: a robot has its state open.
        DamagedDataError: a cell or the state is not sound.
        NotFoundError: the server has no such map.
        UnreachableError: the server does not answer.
    """
    if isinstance(place, str) and "://" in place:
        return _downloaded_map(place, token, memory_bytes_max or standard_limit_bytes(), at_s)
    return map_of_folder(Path(place), at_s=at_s).snapshot


def open_part(map_url: str, needs: Needs, *, token: str | None = None, at_s: float | None = None) -> MapSnapshot:
    """The cells of a server's map that a question needs; raises as `open_map`."""
    return _downloaded_map(map_url, token, standard_limit_bytes(), at_s, needs)


def open_layers(
    map_url: str, *, token: str | None = None, memory_bytes_max: int | None = None, at_s: float | None = None
) -> LayeredSnapshot:
    """All layers of a server's map as one snapshot, in which the finest that knows a point answers for it.

        open_layers("http://base:8750/maps/lab").probability_at([[1.0, 2.0, 0.4]])

    Args:
        map_url: `http://HOST:PORT/maps/NAME`.
        token: for a server that wants one.
        memory_bytes_max: largest size in memory of all layers together; None: a quarter of the machine's memory.
        at_s: UTC seconds since 1970: the map as it was then, as `open_map`.

    Raises:
        BadInputError: kind `layer_of_map`: the URL is that of a layer, which `open_map` opens.
        CairnError: as `open_map`.
    """
    return layers_part(map_url, None, token=token, memory_bytes_max=memory_bytes_max, at_s=at_s)


def layers_part(
    map_url: str,
    needs: Needs | None,
    *,
    token: str | None = None,
    memory_bytes_max: int | None = None,
    at_s: float | None = None,
) -> LayeredSnapshot:
    """The cells of all layers that a question needs, or (None) all; raises as `open_layers`."""
    server_url, name = split_map_url(map_url)
    with MapApi(server_url, token=token) as api:
        layers = layers_of(api, name)
    share_bytes = (memory_bytes_max or standard_limit_bytes()) // len(layers)
    return LayeredSnapshot(
        {
            layer: _downloaded_map(f"{server_url}/maps/{map_name}", token, share_bytes, at_s, needs)
            for layer, map_name in layers.items()
        }
    )


def layers_of(api: MapApi, name: str) -> dict[str, str]:
    """Name of each layer of a map, and the one that it is asked for by."""
    try:
        return {layer.name: layer.map for layer in api.layers(name)}
    except NotFoundError as exc:
        if exc.kind != "no_route":
            raise
        return {EVIDENCE: name}  # a server of before has maps of one layer


def map_of_folder(folder: Path, *, at_s: float | None = None) -> FolderMap:
    """The map in a folder, under its own sensor model, now or at a time, and how old it is where that is known.

    Raises:
        BadInputError: kind `no_map_folder`: it holds neither cells nor a robot's state.
        ConflictError: a robot has its state open.
        DamagedDataError: a cell or the state is not sound.
    """
    if is_state_folder(folder):
        with opened_replica(folder) as replica:
            return FolderMap(replica.snapshot(at_s=at_s), row_ages(replica.view, at_s) or ages_of(replica))
    if (folder / MAP_FILE).is_file():
        head = read_head(folder)
        whole = HistoryMap(head.layer, coding=coding_of(head.geometry))
        for cell in read_cells(folder, head.layer):
            size_bytes = cell_path(folder, cell_of_key(cell.key)).stat().st_size
            whole.replace(cell.key, cell.history, came_bytes=size_bytes)
        return FolderMap(_snapshot(whole, head.sensor_model, at_s), row_ages(whole, at_s))
    raise BadInputError(
        "no_map_folder",
        f"{folder} holds no map: neither {MAP_FILE} and cells (`cairn map export URL --cells DIR`) nor a robot's "
        f"{FILE_NAME} (`cairn clone URL DIR`, `cairn robot sync DIR --map URL`)",
    )


def _downloaded_map(
    map_url: str, token: str | None, memory_bytes_max: int, at_s: float | None, needs: Needs | None = None
) -> MapSnapshot:
    server_url, name = split_map_url(map_url)
    with MapApi(server_url, token=token) as api:
        info = api.map_info(name)
        whole = HistoryMap(info.layer, coding=coding_of(info.geometry))
        keys = cells_with_evidence(api, name)
        for key in keys if needs is None else needed_cells(keys, needs, info.geometry):
            download_into(whole, api, info, key, memory_bytes_max=memory_bytes_max)
    return _snapshot(whole, info.sensor_model, at_s)


def download_into(whole: HistoryMap, api: MapApi, info: MapInfo, key: CellKey, *, memory_bytes_max: int) -> None:
    """Replace a cell of a map in memory by the server's.

    Raises:
        BadInputError: kind `too_large`: the map would take more memory than that.
        CairnError: as `download_cell`.
    """
    # What is left bounds the cell before it is decoded: few bytes may stand for much evidence.
    left_bytes = memory_bytes_max - whole.size_bytes
    try:
        bytes_max = min(left_bytes, EVIDENCE_BYTES_MAX)
        body, decoded = download_cell(api, info.name, key, info.layer, evidence_bytes_max=bytes_max)
    except BadInputError as exc:
        if exc.kind == "too_large" and left_bytes < EVIDENCE_BYTES_MAX:
            raise _too_large(info.name, memory_bytes_max) from exc
        raise
    whole.replace(key, decoded.history, bodies=row_bodies(body, key, info.layer), came_bytes=len(body))
    if whole.size_bytes > memory_bytes_max:
        raise _too_large(info.name, memory_bytes_max)


def _snapshot(whole: HistoryMap, model: SensorModel, at_s: float | None) -> MapSnapshot:
    return snapshot_of(whole, model) if at_s is None else snapshot_at(whole, model, at_s)


def _too_large(name: str, memory_bytes_max: int) -> BadInputError:
    return BadInputError(
        "too_large",
        f"map {name} takes more than {memory_bytes_max} bytes in memory (memory_bytes_max): give it more, or save a "
        "part of it with `cairn map export --box --npz FILE`",
    )


def row_ages(whole: HistoryMap, at_s: float | None) -> Ages | None:
    """Ages in a map with epochs, to the length of one, as of a time; with None as of the begin of the newest epoch.

    None of a map without epochs, and where no evidence has a time.
    """
    epoch_s, newest = whole.layer.epoch_s, max(whole.epochs, default=BASE)
    if epoch_s is None or newest == BASE:
        return None
    if at_s is None:
        return Ages(BlockTimes(whole), now=begin_s(newest, epoch_s))
    return Ages(BlockTimes(whole, at=whole.layer.epoch_at(at_s)), now=at_s)


def ages_of(replica: Replica) -> Ages | None:
    """Ages of a robot's own map: the time of each block's last measurement, UTC seconds, and the newest of them as now.

    None where no commit that is kept states a time. What was taken out, or amended, does not count.

    Raises:
        DamagedDataError: a commit at rest is not sound.
    """
    blocks = 8 ** (replica.geometry.depth - 2)
    changes: dict[CellKey, npt.NDArray[np.float64]] = {}
    newest_s = -math.inf
    for commit_id in replica.unreplaced_commits():
        commit = replica.kept_commit(commit_id)
        if commit is None or commit.meta.captured_s is None:
            continue
        captured_s = commit.meta.captured_s[1]
        newest_s = max(newest_s, captured_s)
        for key, data in commit.cells.items():
            touched = np.unique(decode_cell(data).evidence.voxels >> np.uint32(6))
            known = changes.setdefault(key, np.full(blocks, np.nan))
            known[touched] = np.fmax(known[touched], captured_s)
    return Ages(changes, now=newest_s) if changes else None
