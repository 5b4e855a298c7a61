"""The public door of cairn: the names that programs use, each at home in another package.

    from cairn import Robot, load_rig, open_map

A name's module is imported when the name is first used, so that `import cairn` costs nothing. These names stay where
they are; modules behind them may move. docs/python-api.md lists them.
"""

from importlib import import_module

TYPE_CHECKING = False  # type checkers take it for true; importing `typing` would cost half of `import cairn`

if TYPE_CHECKING:
    from cairn_calib.rig.rig import Rig, load_rig
    from cairn_client.folders.map_folder import open_layers, open_map
    from cairn_client.replica.limits import Limits
    from cairn_client.robot.layered_robot import LayeredRobot
    from cairn_client.robot.robot import Robot
    from cairn_client.robot.robot_events import (
        CellsChanged,
        CellsDropped,
        Committed,
        Event,
        LinkBack,
        LinkLost,
        OutboxNearlyFull,
        Pushed,
        Refused,
        SyncFailed,
    )
    from cairn_client.sync.scope import Scope
    from cairn_fusion.recording.recording import Recording, open_recording
    from cairn_fusion.recording.scan import Scan
    from cairn_fusion.recording.scan_units import kelvin_from_celsius
    from cairn_map.codec.cell_code import Profile
    from cairn_map.errors import (
        BadInputError,
        CairnError,
        ConflictError,
        DamagedDataError,
        DeniedError,
        NotFoundError,
        UnreachableError,
    )
    from cairn_map.evidence.grid import Geometry, geometry_for, level_geometry
    from cairn_map.evidence.inverse_sensor_model import SensorModel
    from cairn_map.queries.layers.layered_snapshot import LayeredSnapshot
    from cairn_map.queries.level.elevation import Elevation, Vehicle
    from cairn_map.queries.map_snapshot import MapSnapshot
    from cairn_map.queries.mark_groups import MarkGroup, group_marks
    from cairn_map.queries.native.point_handle import PointHandle
    from cairn_map.queries.occupancy_states import State
    from cairn_map.wire.layer_messages import MappedLayer

    __version__: str

__all__ = [
    "BadInputError",
    "CairnError",
    "CellsChanged",
    "CellsDropped",
    "Committed",
    "ConflictError",
    "DamagedDataError",
    "DeniedError",
    "Elevation",
    "Event",
    "Geometry",
    "LayeredRobot",
    "LayeredSnapshot",
    "Limits",
    "LinkBack",
    "LinkLost",
    "MapSnapshot",
    "MappedLayer",
    "MarkGroup",
    "NotFoundError",
    "OutboxNearlyFull",
    "PointHandle",
    "Profile",
    "Pushed",
    "Recording",
    "Refused",
    "Rig",
    "Robot",
    "Scan",
    "Scope",
    "SensorModel",
    "State",
    "SyncFailed",
    "UnreachableError",
    "Vehicle",
    "geometry_for",
    "group_marks",
    "kelvin_from_celsius",
    "level_geometry",
    "load_rig",
    "open_layers",
    "open_map",
    "open_recording",
]

_MODULES = {
    "cairn_calib.rig.rig": "Rig load_rig",
    "cairn_client.folders.map_folder": "open_layers open_map",
    "cairn_client.replica.limits": "Limits",
    "cairn_client.robot.layered_robot": "LayeredRobot",
    "cairn_client.robot.robot": "Robot",
    "cairn_client.robot.robot_events": """
        Event Committed Pushed Refused CellsChanged CellsDropped OutboxNearlyFull LinkLost LinkBack SyncFailed
    """,
    "cairn_client.sync.scope": "Scope",
    "cairn_fusion.recording.recording": "Recording open_recording",
    "cairn_fusion.recording.scan": "Scan",
    "cairn_fusion.recording.scan_units": "kelvin_from_celsius",
    "cairn_map.codec.cell_code": "Profile",
    "cairn_map.errors": """
        CairnError BadInputError DeniedError NotFoundError ConflictError DamagedDataError UnreachableError
    """,
    "cairn_map.evidence.grid": "Geometry geometry_for level_geometry",
    "cairn_map.evidence.inverse_sensor_model": "SensorModel",
    "cairn_map.queries.layers.layered_snapshot": "LayeredSnapshot",
    "cairn_map.queries.level.elevation": "Elevation Vehicle",
    "cairn_map.queries.map_snapshot": "MapSnapshot",
    "cairn_map.queries.mark_groups": "MarkGroup group_marks",
    "cairn_map.queries.native.point_handle": "PointHandle",
    "cairn_map.queries.occupancy_states": "State",
    "cairn_map.wire.layer_messages": "MappedLayer",
}
"""Names by the module that defines them; the same as the imports above, which only type checkers read."""

_HOME = {name: module for module, names in _MODULES.items() for name in names.split()}


def __getattr__(name: str) -> object:
    """Value of a name on its first use (PEP 562); from then on it is an ordinary attribute.

    Raises:
        AttributeError: the door has no such name.
    """
    if name == "__version__":
        from importlib.metadata import version

        value: object = version("cairn-robotics")
    elif name in _HOME:
        value = getattr(import_module(_HOME[name]), name)
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}; its names are in docs/python-api.md")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """All names, used or not."""
    return sorted({*globals(), *__all__, "__version__"})
