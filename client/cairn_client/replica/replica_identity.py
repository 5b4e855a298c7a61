"""Whose a robot's folder is."""

from collections.abc import Mapping

from cairn_client.replica.replica_store import ReplicaStore
from cairn_map.errors import BadInputError
from cairn_map.wire.messages import Mode

URL_KEY, MODE_KEY = "url", "mode"
"""Of the server's map, and how the robot was opened last."""


def identify(store: ReplicaStore, identity: Mapping[str, str]) -> None:
    """Make the folder this robot's, or see that it is.

    Raises:
        BadInputError: kind `other_replica`: it is of another robot, map or grid.
    """
    with store.transaction():
        for key, value in identity.items():
            known = store.get(key)
            if known is not None and known != value:
                raise BadInputError(
                    "other_replica",
                    f"the robot's folder belongs to another {key}: {known[:120]}; choose another (--state)",
                )
            store.put(key, value)


def note_use(store: ReplicaStore, *, url: str, mode: Mode) -> None:
    """Remember on which map, and how, a robot works."""
    with store.transaction():
        store.put(URL_KEY, url)
        store.put(MODE_KEY, mode)
