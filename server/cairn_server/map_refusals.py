"""Refusals that concern a map as a whole: its name is taken by another one, was never given, or it was deleted."""

from dataclasses import dataclass
from datetime import UTC, datetime

from cairn_map.commits.ids import map_of_layer
from cairn_map.epochs.layer import EVIDENCE, LAYERS_MAX, LayerDefinition, MapLayer
from cairn_map.errors import BadInputError, ConflictError, NotFoundError
from cairn_map.evidence.inverse_sensor_model import SensorModel

ASSIGNMENTS_MAX = 4096
"""Robots of a map to which operators assigned layers: their names are free, so there is no end of them otherwise."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GoneMap:
    """A map that an administrator deleted; its number is given to no other one, its name may be."""

    number: int
    name: str
    deleted_s: float
    """Time of the deletion, UTC seconds since 1970."""
    by: str
    """Name of the token by which it was deleted."""


def map_gone(gone: GoneMap) -> NotFoundError:
    """Error for a deleted map, of kind `gone`: the time of it, and the ways on for the owner of one of its robots."""
    when = datetime.fromtimestamp(gone.deleted_s, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
    return NotFoundError(
        "gone",
        f"map {gone.name} was deleted on {when}, and its tokens ended. A robot's folder keeps all that is in it, "
        "commits that wait, too. An administrator can bring the map back out of an archive, or make a map of this name "
        "again; the robot goes on there once an operator lets it in (`cairn map robots admit`)",
    )


def no_map(name: str) -> NotFoundError:
    """Error for a name that no map, or no layer of a map, has or had."""
    whole = map_of_layer(name)
    if whole is not None:
        layer = name.partition(".")[2]
        return NotFoundError(
            "no_map",
            f"there is no layer {layer!r} of map {whole}; `cairn map layer list` lists them, and `cairn map layer add` "
            "adds one",
        )
    return NotFoundError("no_map", f"there is no map {name!r}; `cairn map ls` lists them")


def check_same_map(name: str, known: tuple[MapLayer, SensorModel], asked: tuple[MapLayer, SensorModel]) -> None:
    """Refuse to make a map of a name that another one has.

    Raises:
        ConflictError: kind `map_exists`.
    """
    way_out = "Use it as it is, or take another name"
    (layer, sensor_model), (other_layer, other_model) = known, asked
    if layer.geometry != other_layer.geometry:
        raise ConflictError(
            "map_exists", f"map {name} exists with {layer.geometry}; asked for were {other_layer.geometry}. {way_out}"
        )
    if layer.epoch_s != other_layer.epoch_s:
        raise ConflictError(
            "map_exists",
            f"map {name} exists {_epochs_text(layer)}; asked for was one {_epochs_text(other_layer)}. {way_out}",
        )
    if sensor_model != other_model:
        raise ConflictError(
            "map_exists", f"map {name} exists with {sensor_model!r}; asked for was {other_model!r}. {way_out}"
        )


def check_same_layer(name: str, known: MapLayer, asked: LayerDefinition) -> None:
    """Refuse to define a layer of a name that another one of the map has.

    Raises:
        ConflictError: kind `other_layer`.
    """
    if known != MapLayer(geometry=asked.geometry, epoch_s=asked.epoch_s):
        raise ConflictError(
            "other_layer",
            f"layer {name} is there with {known}; asked for was {asked}. A layer's definition never changes: use it as "
            "it is, or take another name",
        )


def check_layer_count(name: str, further: int) -> None:
    """Refuse one more layer of a map that has as many as one may have.

    Raises:
        ConflictError: kind `too_many_layers`.
    """
    if further + 1 >= LAYERS_MAX:
        raise ConflictError(
            "too_many_layers",
            f"map {name} has {further} layers besides {EVIDENCE}, and a map at most {LAYERS_MAX} in all; make another "
            "map for more",
        )


def check_assignment_count(name: str, others: int) -> None:
    """Refuse the assignment of one more robot on a map where as many robots as may be have one.

    Raises:
        ConflictError: kind `too_many_assignments`.
    """
    if others >= ASSIGNMENTS_MAX:
        raise ConflictError(
            "too_many_assignments",
            f"{others} robots have layers of map {name} assigned, and at most {ASSIGNMENTS_MAX} may: take those of "
            "robots that are gone back (`cairn map layer assign URL ROBOT --none`)",
        )


def layer_of_map(row_name: str, what: str) -> BadInputError:
    """Error for what is done on a map as a whole, and was asked of one of its layers."""
    return BadInputError("layer_of_map", f"{row_name} is a layer of map {map_of_layer(row_name)}: {what}")


def _epochs_text(layer: MapLayer) -> str:
    return "without epochs" if layer.epoch_s is None else f"with epochs of {layer.epoch_s} s"
