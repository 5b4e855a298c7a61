"""Scope of a robot's fetches: the cells that it wants, and how many bytes come in one reply and one round."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from cairn_client.replica.replica import Replica
from cairn_client.sync.exchange import is_within
from cairn_client.sync.near_cells import Wanted
from cairn_client.sync.requests import Box, Conversation
from cairn_client.sync.sync import RoundReport, fetch_cells, fetch_missing, fetch_present
from cairn_map.errors import BadInputError
from cairn_map.evidence.grid import CELL_LIMIT, Cell, cell_key

BoxMetres = tuple[tuple[float, float, float], tuple[float, float, float]]
"""Lowest and highest corner in the map's frame, metres."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Scope:
    """The part of a map that a robot fetches; by default all of it."""

    box_m: BoxMetres | None = None
    """Box in metres: only cells that share more than a face with it are fetched; None: all."""
    wanted: Wanted | None = None
    """Low-end: filter of the cells in the box; None: all."""
    reply_bytes_max: int | None = None
    """High-end and viewer: bytes of cells after which a reply ends, and the rest is asked for by another request."""
    round_bytes_max: int | None = None
    """Bytes of cells after which a round ends, and the next one goes on: a commit does not wait for the whole map."""

    def __post_init__(self) -> None:
        """Raises: BadInputError: the box is none, or there is no room for a cell in a reply."""
        if self.box_m is not None:
            low, high = self.box_m
            if not all(math.isfinite(a) and math.isfinite(b) and a < b for a, b in zip(low, high, strict=True)):
                raise BadInputError(
                    "bad_box", f"a box is its lowest and its highest corner in metres, got {self.box_m}"
                )
        for size_bytes in (self.reply_bytes_max, self.round_bytes_max):
            if size_bytes is not None and size_bytes < 1:
                raise BadInputError("bad_option", f"a reply and a round have at least 1 byte, got {size_bytes}")

    def box(self, cell_edges_m: Sequence[float]) -> Box | None:
        """The box as cells, of edges along x, y and z, lowest and highest, both included."""
        if self.box_m is None:
            return None
        low, high = (zip(corner, cell_edges_m, strict=True) for corner in self.box_m)
        first = Cell(*(_number(math.floor(_cells(value, edge_m))) for value, edge_m in low))
        last = Cell(*(_number(math.ceil(_cells(value, edge_m)) - 1) for value, edge_m in high))
        return first, last


EVERYTHING = Scope()


def fetch(
    replica: Replica, *, is_low_end: bool, scope: Scope, within: Box | None = None, near: Cell | None = None
) -> Conversation[RoundReport]:
    """Bring what is in the scope to the server's head: whole cells for a low-end robot, else what is missing.

    Only the cells in `within`, if that is given, in place of the scope's box. The cells next to `near` come first.

    Raises:
        UnreachableError: the link broke; what came is kept.
        DamagedDataError: the server's answer is not sound.
    """
    box = within or scope.box(replica.geometry.cell_edges_m)
    wanted = scope.wanted

    def is_in_scope(cell: Cell) -> bool:
        return is_within(cell_key(cell), box) and (wanted is None or wanted(cell))

    if is_low_end:
        needed = is_in_scope if box or wanted else None
        most = scope.round_bytes_max
        return (yield from fetch_cells(replica, wanted=needed, box=box, round_bytes_max=most, near=near))
    # Who joins a map with a long history sees the present first; so does who comes to another server.
    if replica.layer.has_epochs and replica.header is None:
        yield from fetch_present(replica, box=box, near=near)
    report = yield from fetch_missing(
        replica,
        box=box,
        reply_bytes_max=scope.reply_bytes_max,
        round_bytes_max=scope.round_bytes_max,
        near=near,
    )
    if box is not None:  # what is outside never comes, so own commits must not wait for it
        replica.forget_stable_commits(wanted=is_in_scope)
    replica.rest()
    return report


def _cells(metres: float, cell_edge_m: float) -> float:
    """A length in cells; three edges are three, and not a little more as floats have it."""
    return round(metres / cell_edge_m, 9)


def _number(value: int) -> int:
    """A cell's number on one axis, or the outermost one of the grid."""
    return max(-CELL_LIMIT, min(CELL_LIMIT - 1, value))
