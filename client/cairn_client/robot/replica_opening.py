"""Opening of a robot's folder: its replica, on the grid that is given, remembered, or asked of the server once."""

import logging
from collections.abc import Callable, Iterable
from pathlib import Path

from cairn_client.http.api import MapApi
from cairn_client.replica.limits import STANDARD_LIMITS, Limits
from cairn_client.replica.replica import Replica
from cairn_client.replica.replica_state import ReplicaState
from cairn_client.replica.replica_store import ReplicaStore
from cairn_map.commits.ids import CommitId, RobotName
from cairn_map.epochs.layer import MapLayer
from cairn_map.evidence.grid import Geometry

log = logging.getLogger(__name__)


def open_replica(
    directory: Path,
    api: MapApi,
    *,
    robot: RobotName,
    map_name: str,
    geometry: Geometry | MapLayer | None,
    limits: Limits | None,
    amendable: Callable[[], Iterable[CommitId]],
) -> tuple[Replica, Limits]:
    """The directory's state, on the given grid, else the remembered one, else the server's; and its limits.

    Args:
        directory: folder of the robot.
        api: the server, asked only where the grid is unknown.
        robot: its name.
        map_name: the map.
        geometry: grid, or grid and epochs; None: unknown.
        limits: those from now on; None: the remembered ones.
        amendable: returns commits that may still be amended; called later.

    Raises:
        CairnError: as `Robot`.
    """
    store = ReplicaStore(directory)
    try:
        state = ReplicaState(store)
        known = limits or state.limits or STANDARD_LIMITS
        layer = geometry if isinstance(geometry, MapLayer) else state.layer
        # A given grid alone is that of a map without epochs, unless the folder knows better.
        if isinstance(geometry, Geometry):
            layer = MapLayer(geometry=geometry, epoch_s=state.epoch_s)
        # The one question that cannot wait for a link: without a grid no evidence has a place.
        if layer is None:
            info = api.map_info(map_name)
            layer = info.layer
            state.note_model(info.sensor_model)
        replica = Replica(
            store,
            robot=robot,
            map_name=map_name,
            geometry=layer.geometry,
            epoch_s=layer.epoch_s,
            amendable=amendable,
            memory_bytes_max=known.map_bytes_max,
            keep_acked_s=known.keep_acked_s,
        )
        most = known.map_bytes_max
        log.info(
            "robot %s: its map may take %s of memory", robot, "all" if most is None else f"at most {most / 1e6:.0f} MB"
        )
        # Remembered only now that the folder has proven to be this robot's.
        if limits is not None:
            state.limits = limits
        return replica, known
    # The store holds the folder's lock: another try must get it.
    except BaseException:
        store.close()
        raise
