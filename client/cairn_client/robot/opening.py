"""A robot's durable state, opened; the server is asked only what was never learnt."""

from pathlib import Path

from cairn_client.http.api import MapApi
from cairn_client.replica.map_model import store_model
from cairn_client.replica.replica import Replica
from cairn_client.replica.replica_store import ReplicaStore
from cairn_map.commits.ids import RobotName
from cairn_map.evidence.grid import Geometry


def open_replica(
    directory: Path, api: MapApi, *, robot: RobotName, map_name: str, geometry: Geometry | None
) -> Replica:
    """The state in a directory; its grid is the given one, the remembered one, or the server's.

    Raises:
        CairnError: as `Robot`; nothing stays open.
    """
    store = ReplicaStore(directory)
    try:
        remembered = store.get("geometry")
        if geometry is None and remembered is not None:
            geometry = Geometry.model_validate_json(remembered)
        if geometry is None:
            info = api.map_info(map_name)
            geometry = info.geometry
            store_model(store, info.sensor_model)
        return Replica(store, robot=robot, map_name=map_name, geometry=geometry)
    except BaseException:
        store.close()
        raise
