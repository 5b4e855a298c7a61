"""A map that lies in a folder, to be asked without a server: cells as `cairn map export --cells` writes them, or a
robot's own state.
"""

from pathlib import Path

from cairn_client.map_model import stored_model
from cairn_client.replica import Replica
from cairn_client.replica_store import FILE_NAME, ReplicaStore
from cairn_map.cell_folder import MAP_FILE, read_cells, read_head
from cairn_map.errors import BadInputError
from cairn_map.evidence_map import EvidenceMap
from cairn_map.grid import Geometry
from cairn_map.ids import robot_name
from cairn_map.map_snapshot import MapSnapshot, snapshot_of


def snapshot_of_folder(folder: Path) -> MapSnapshot:
    """The map in a folder, under its own sensor model.

    Raises:
        BadInputError: kind `no_map_folder`: it holds neither cells nor a robot's state.
        ConflictError: a robot has its state open.
        DamagedDataError: a cell or the state is not sound.
    """
    if (folder / FILE_NAME).is_file():
        return _snapshot_of_robot(folder)
    if (folder / MAP_FILE).is_file():
        head = read_head(folder)
        whole = EvidenceMap(head.geometry)
        for cell in read_cells(folder, head.geometry):
            whole.replace(cell.key, cell.evidence)
        return snapshot_of(whole, head.sensor_model)
    raise BadInputError(
        "no_map_folder",
        f"{folder} holds no map: neither {MAP_FILE} and cells (`cairn map export URL --cells DIR`) nor a robot's "
        f"{FILE_NAME} (`cairn robot pull --map URL --state DIR`)",
    )


def _snapshot_of_robot(folder: Path) -> MapSnapshot:
    store = ReplicaStore(folder)
    try:
        known = [store.get(key) for key in ("robot", "map", "geometry")]
        if None in known:
            raise BadInputError("no_map_folder", f"the robot in {folder} has not learnt of a map yet")
        robot, map_name, geometry = (str(text) for text in known)
        grid = Geometry.model_validate_json(geometry)
        replica = Replica(store, robot=robot_name(robot), map_name=map_name, geometry=grid)
        return replica.snapshot(stored_model(store))
    finally:
        store.close()
