"""Layers of maps: a list of them for any reader, what operators add, and the robots that they assign to them.

A further layer is defined by a commit of the author `operator` in its map's log, which relays carry and robots keep as
they do retracts and marks. With that commit the store has the layer, as a log of its own under the name MAP.LAYER.
"""

from collections.abc import Callable, Sequence

from cairn_map.commits.ids import map_of_layer, robot_name
from cairn_map.epochs.layer import EVIDENCE
from cairn_map.errors import BadInputError, NotFoundError
from cairn_map.wire.layer_messages import AddLayer, Assignment, LayerAdded, LayerInfo, RobotAssignment, layer_info
from cairn_map.wire.messages import MapInfo
from cairn_server.access.auth import Caller
from cairn_server.cell_room import check_geometry
from cairn_server.map_refusals import check_same_layer, layer_of_map
from cairn_server.memory_shares import MemoryShares
from cairn_server.store.store import Store
from cairn_server.store.store_rows import MapRow
from cairn_server.sync.operator_commits import OperatorCommits


class MapLayers:
    """Layers of all maps of a store; called from many threads."""

    def __init__(
        self,
        store: Store,
        commits: OperatorCommits,
        shares: MemoryShares,
        *,
        info: Callable[[MapRow], MapInfo],
        on_new: Callable[[], None],
    ) -> None:
        """`info` returns facts of a map; `on_new` is called after each commit."""
        self._store = store
        self._commits = commits
        self._shares = shares
        self._info = info
        self._on_new = on_new

    def list(self, row: MapRow) -> list[LayerInfo]:
        """The layers of a map: first the one that it began with, then the others by name.

        Raises:
            BadInputError: kind `layer_of_map`: it is a layer itself.
        """
        if row.of_map is not None:
            raise layer_of_map(row.name, "ask the map for its layers")
        return [layer_info(self._info(each)) for each in (row, *self._store.layers(row))]

    def add(self, row: MapRow, request: AddLayer, *, by: Caller) -> LayerAdded:
        """Add a layer to a map, as an operator says; durable on return. An equal one stays as it is.

        Raises:
            BadInputError: kind `layer_of_map`: the map is a layer itself; `reserved_name`: a map begins with the layer
                of this name; `cell_too_large`.
            ConflictError: kind `other_layer` or `too_many_layers`.
        """
        if row.of_map is not None:
            raise layer_of_map(row.name, "add the layer to the map")
        if request.name == EVIDENCE:
            raise BadInputError("reserved_name", f"{EVIDENCE} is the layer that a map begins with; take another name")
        name = f"{row.name}.{request.name}"
        found = next((each for each in self._store.layers(row) if each.name == name), None)
        if found is not None:
            check_same_layer(name, found.layer, request.definition)
            return LayerAdded(commit=None, layer=layer_info(self._info(found)))
        check_geometry(request.geometry, self._shares)
        commit = self._commits.append(row, by=by.name, layer=request.definition)
        self._store.audit_log.add(
            by.name, "add_layer", f"map {row.name}: {request.definition} by {commit}", client=by.address
        )
        self._on_new()
        return LayerAdded(commit=str(commit), layer=layer_info(self._info(self._store.map(name))))

    def assignments(self, row: MapRow, robot: str | None = None) -> Sequence[RobotAssignment]:
        """Assignments of a map, or of the map of a layer: of all robots by name, or (one at most) of a robot."""
        found = self._store.notes.assignments(self._whole(row), robot)
        return [
            RobotAssignment(robot=name, assignment=Assignment.model_validate_json(text)) for name, text in found.items()
        ]

    def assign(self, row: MapRow, robot: str, assignment: Assignment, *, by: Caller) -> None:
        """Say which layers of a map a robot takes part in, whether it is registered or not; durable on return.

        The robot asks for it as often as it does rounds. It is of this server: relays carry none.

        Raises:
            BadInputError: kind `layer_of_map`: the map is a layer itself; `bad_name`.
            NotFoundError: kind `no_map`: the map has no such layer.
            ConflictError: kind `too_many_assignments`.
        """
        if row.of_map is not None:
            raise layer_of_map(row.name, "assign its layers on the map")
        for layer in assignment.layers:
            self._store.map(row.name if layer == EVIDENCE else f"{row.name}.{layer}")
        self._store.notes.assign(row, robot_name(robot), assignment.model_dump_json(exclude_none=True))
        detail = f"map {row.name}: {robot} maps into {', '.join(each.layer for each in assignment.contributes)}"
        self._store.audit_log.add(by.name, "assign_layers", detail, client=by.address)

    def unassign(self, row: MapRow, robot: str, *, by: Caller) -> None:
        """Leave a robot's layers to its program again.

        Raises:
            BadInputError: kind `layer_of_map`: the map is a layer itself.
            NotFoundError: kind `no_assignment`: it has none.
        """
        if row.of_map is not None:
            raise layer_of_map(row.name, "take its layers back on the map")
        if not self._store.notes.assignments(row, robot):
            raise NotFoundError("no_assignment", f"robot {robot[:32]!r} has no layers assigned on map {row.name}")
        self._store.notes.assign(row, robot, None)
        self._store.audit_log.add(by.name, "unassign_layers", f"map {row.name}: {robot}", client=by.address)

    def _whole(self, row: MapRow) -> MapRow:
        name = map_of_layer(row.name)
        return row if name is None else self._store.map(name)
