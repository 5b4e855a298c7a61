"""Layers in a simulation: operators of any server define them, and what happens may happen in one of them."""

from random import Random

from tests.fixtures.client.made import GEOMETRY, MAP
from tests.fixtures.map.classed import CLASSED
from tests.sync_sim.marks import has_marks
from tests.sync_sim.server import SimServer

from cairn_map.epochs.layer import LayerDefinition, MapLayer
from cairn_map.evidence.grid import Geometry, level_geometry
from cairn_map.wire.layer_messages import AddLayer
from cairn_server.access.auth import Caller, Role

BY = Caller(Role.ADMIN, name="ada")
DEFINITIONS = (
    LayerDefinition(name="named", geometry=CLASSED),
    *(
        LayerDefinition(
            name=f"at_{edge_um}",
            geometry=Geometry(voxel_edge_um=edge_um, depth=3, channels=GEOMETRY.channels),
            epoch_s=120 if edge_um > 50_000 else None,
        )
        for edge_um in (10_000, 20_000, 200_000)
    ),
    LayerDefinition(name="ground", geometry=level_geometry(), epoch_s=120),
)
"""One for each name: servers that are joined may define the same one, each by a commit of its own."""
Layers = dict[str, MapLayer]


def has_layers(seed: int) -> bool:
    """True for every fifth seed: its operators add layers, with epochs and without, with marks and without."""
    return seed % 5 == 2


def log_of(seed: int) -> str:
    """Name of the log that a seed is about: a layer's of every fifth seed, unless it has marks, which are the map's."""
    return f"{MAP}.fine" if seed % 5 == 3 and not has_marks(seed) else MAP


def add_layer(server: SimServer, random: Random) -> None:
    """An operator adds a layer, which may be there."""
    layer = random.choice(DEFINITIONS)
    request = AddLayer(name=layer.name, geometry=layer.geometry, epoch_s=layer.epoch_s)
    server.service.sync.layers.add(server.row, request, by=BY)


def layers_of(server: SimServer) -> Layers:
    """Layers that a server has."""
    return {row.name.partition(".")[2]: row.layer for row in server.service.store.layers(server.row)}


def layers_by_definition(server: SimServer) -> Layers:
    """Layers that the commits of its map define."""
    with server._store._maps.reading(server.row) as state:
        found = [kept.new.layer for kept in state.commits.values() if kept.new.layer is not None]
    return {layer.name: MapLayer(geometry=layer.geometry, epoch_s=layer.epoch_s) for layer in found}
