"""A map that lies in a folder, to be asked without a server: cells as `cairn map export --cells` writes them, or a
robot's own state.
"""

from dataclasses import dataclass
from pathlib import Path

from cairn_client.folders.local_ages import ages_of
from cairn_client.folders.state_folder import is_state_folder, opened_replica
from cairn_client.replica.map_model import stored_model
from cairn_client.replica.replica_store import FILE_NAME
from cairn_map.errors import BadInputError
from cairn_map.evidence.evidence_map import EvidenceMap
from cairn_map.files.cell_folder import MAP_FILE, read_cells, read_head
from cairn_map.queries.map_snapshot import MapSnapshot, snapshot_of
from cairn_map.render.map_picture import Ages


@dataclass(frozen=True, slots=True, eq=False)
class FolderMap:
    """A map that lies in a folder."""

    snapshot: MapSnapshot
    ages: Ages | None
    """Of what a robot measured itself; None: cells say nothing about when."""


def snapshot_of_folder(folder: Path) -> MapSnapshot:
    """The map in a folder, under its own sensor model; raises as `map_of_folder`."""
    return map_of_folder(folder).snapshot


def map_of_folder(folder: Path) -> FolderMap:
    """The map in a folder, under its own sensor model, and how old it is where that is known.

    Raises:
        BadInputError: kind `no_map_folder`: it holds neither cells nor a robot's state.
        ConflictError: a robot has its state open.
        DamagedDataError: a cell or the state is not sound.
    """
    if is_state_folder(folder):
        with opened_replica(folder) as replica:
            return FolderMap(replica.snapshot(stored_model(replica.store)), ages_of(replica))
    if (folder / MAP_FILE).is_file():
        head = read_head(folder)
        whole = EvidenceMap(head.geometry)
        for cell in read_cells(folder, head.geometry):
            whole.replace(cell.key, cell.evidence)
        return FolderMap(snapshot_of(whole, head.sensor_model), None)
    raise BadInputError(
        "no_map_folder",
        f"{folder} holds no map: neither {MAP_FILE} and cells (`cairn map export URL --cells DIR`) nor a robot's "
        f"{FILE_NAME} (`cairn robot pull --map URL --state DIR`)",
    )
