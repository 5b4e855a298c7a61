"""The map's own sensor model, as the server told it, kept with the map for when there is no link."""

from cairn_client.replica.replica_store import ReplicaStore
from cairn_map.evidence.inverse_sensor_model import SensorModel

KEY = "sensor_model"


def stored_model(store: ReplicaStore) -> SensorModel:
    """The map's model; the usual one if no server has told."""
    text = store.get(KEY)
    return SensorModel() if text is None else SensorModel.model_validate_json(text)


def store_model(store: ReplicaStore, model: SensorModel) -> None:
    """Keep what the server told; under the replica's lock."""
    if stored_model(store) != model:
        with store.transaction():
            store.put(KEY, model.model_dump_json())
