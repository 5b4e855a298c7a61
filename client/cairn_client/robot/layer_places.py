"""Layers by place: which layers of a map a robot maps into where it is, such as the ground outdoors and rooms indoors.

    places = LayerPlaces(
        boxes={"evidence": [((-15.0, 4.0, -1.5), (-10.9, 7.0, 1.5))]},      # a shed
        elsewhere=("ground",),                                              # a level
    )
    robot.observe(scan, into=places.layers_at(scan.T_map_rig))              # of a `LayeredRobot`

The place of a scan is that of the head, whatever it looks at: what a robot sees through a door from within belongs to
the layer of the room, and what it sees of the room from outside to that of the ground. Where boxes of two layers
overlap, as they may in a doorway, scans go into both.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cairn_client.sync.scope import BoxMetres, Scope
from cairn_map.errors import BadInputError


@dataclass(frozen=True, slots=True, kw_only=True)
class LayerPlaces:
    """Boxes in which a robot maps into a layer, and the layers into which it maps outside of all of them."""

    boxes: Mapping[str, Sequence[BoxMetres]]
    """By layer: lowest and highest corner of each, metres, map frame."""
    elsewhere: tuple[str, ...]
    """Layers of all other places; none: scans from there go nowhere."""

    def __post_init__(self) -> None:
        """Check the boxes.

        Raises:
            BadInputError: kind `bad_box`: one is none; `bad_layer`: `elsewhere` is a text, not several names.
        """
        if isinstance(self.elsewhere, str):
            raise BadInputError(
                "bad_layer", f"elsewhere takes names of layers, such as ('ground',), got {self.elsewhere!r}"
            )
        for boxes in self.boxes.values():
            for box_m in boxes:
                Scope(box_m=box_m)

    @property
    def layers(self) -> tuple[str, ...]:
        """All layers, for a robot to contribute to."""
        return tuple(dict.fromkeys([*self.boxes, *self.elsewhere]))

    def layers_at(self, T_map_rig: npt.ArrayLike) -> tuple[str, ...]:
        """Layers for a scan of a head at this pose, (4, 4); a face of a box belongs to it."""
        at_m = np.asarray(T_map_rig, np.float64)[:3, 3]
        found = tuple(
            layer
            for layer, boxes in self.boxes.items()
            if any((np.asarray(low) <= at_m).all() and (at_m <= np.asarray(high)).all() for low, high in boxes)
        )
        return found or self.elsewhere
