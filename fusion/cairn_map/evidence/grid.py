"""The grid: from metres to numbers of voxels, from voxels to cells, and back (FORMAT.md section 2).

    point (m)  --round to nanometres, floor-->  voxel (3 x int64)
    voxel      --split at bit `depth`-->        cell (i, j, k) + place inside it (Morton code)

The floor is taken in integers, so a point that lies exactly on a border always belongs to the upper
neighbour: 0.15 m at 5 cm is voxel 3, although 0.15 / 0.05 is 2.9999999999999996 in floating point.
Cells are numbered by signed (i, j, k) and, as one number, by the 63-bit Morton code of the shifted indices.
"""

import hashlib
import json
import re
from collections.abc import Sequence
from functools import lru_cache
from typing import Annotated, Any, NamedTuple, NewType, Self

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, FailFast, Field, SerializerFunctionWrapHandler, model_serializer, model_validator

from cairn_map.arrays import Ints
from cairn_map.errors import BadInputError
from cairn_map.evidence.channels import HEIGHT_OFFSET, STANDARD_CHANNELS, Channel, ChannelKind
from cairn_map.kernels.morton_kernels import UInts, deinterleave, interleave

CellKey = NewType("CellKey", int)
"""63-bit Morton number of a cell."""


CELL_LIMIT = 1 << 20
"""Cell indices run from -CELL_LIMIT to CELL_LIMIT - 1: 5 368 km to each side at 5.12 m."""
BRICK_DEPTH = 3
"""A brick is 8^3 voxels, the three lowest octree depths."""
DEPTH_MAX = 8
STANDARD_EDGE_UM, STANDARD_CELL_UM, STANDARD_DEPTH_MAX, STANDARD_SUMS_MAX = 40_000, 5_120_000, 7, 9 << 21
"""Standard voxels' edge; and bounds of standard cells: their edge, their depth, and the sums of samples that a full one
has, which are those of 128^3 voxels with the standard channels."""
LEVEL_EDGE_M, LEVEL_STEP_M = 0.2, 0.05
"""Standard edge and height of a level layer's voxels, metres: of the study that chose how a level is read."""
CELL_TEXT = re.compile(",".join([r"(0|-?[1-9][0-9]{0,6})"] * 3))
"""The only text of each cell: `int` alone would also take " 1", "+1", "1_0" and other scripts' digits."""
NANOMETRES = 1e9
"""Nanometres in a metre."""


class Cell(NamedTuple):
    """Signed number of a cell along x, y, z; the cell spans [i L, (i + 1) L)."""

    i: int
    j: int
    k: int

    def __str__(self) -> str:
        return f"{self.i},{self.j},{self.k}"


class Geometry(BaseModel, frozen=True, extra="forbid"):
    """Geometry of a map, fixed at its creation: voxel edge, octree depth of a cell, channels."""

    voxel_edge_um: Annotated[int, Field(ge=1000, le=1_000_000)] = STANDARD_EDGE_UM
    """Edge of a voxel, micrometres: an integer, so that borders are exact."""
    depth: Annotated[int, Field(ge=BRICK_DEPTH, le=DEPTH_MAX)] = STANDARD_DEPTH_MAX
    """Octree depth of a cell, which has 2^depth voxels along an edge. Standard are the largest cells of at most 5.12 m,
    the paper's, and 128^3 voxels; of 64^3 or fewer if the samples have more than 9 planes."""
    channels: Annotated[tuple[Channel, ...], Field(max_length=16), FailFast()] = STANDARD_CHANNELS
    height_step_um: Annotated[int, Field(ge=1000, le=1_000_000)] | None = None
    """Height of a flat voxel of a level layer (`queries.level`), micrometres; None: voxels are cubes. A level layer's
    standard cells are those of at most 5.12 m height."""

    @model_validator(mode="after")
    def _with_depth(self) -> Self:
        if "depth" not in self.model_fields_set:
            object.__setattr__(self, "depth", _standard_depth(self.voxel_height_um, self.plane_count))
        return self

    @model_validator(mode="after")
    def _one_list_of_classes(self) -> Self:
        # The number of a plane is a byte of the fingerprint's weights: one list of 64 fits, two might not.
        if sum(channel.kind is ChannelKind.CLASSES for channel in self.channels) > 1:
            raise ValueError("a map has one channel of classes at most; more classes are another layer")
        return self

    @model_validator(mode="after")
    def _is_level(self) -> Self:
        if self.height_step_um is not None and HEIGHT_OFFSET not in self.channels:
            raise ValueError(
                f"flat voxels have the channel {HEIGHT_OFFSET.name}, a scalar in mm with steps of 5 from 0"
            )
        if self.height_step_um is not None and self.height_step_um > self.voxel_edge_um:
            raise ValueError(f"a height step is at most the voxel edge, got {self.height_step_um} um")
        return self

    @model_serializer(mode="wrap")
    def _without_step(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        # Cubes are stated as they were before voxels could be flat: digests, commits and answers keep their bytes.
        fields: dict[str, Any] = handler(self)
        if self.height_step_um is None:
            fields.pop("height_step_um", None)
        return fields

    @model_validator(mode="after")
    def _names_differ(self) -> Self:
        names = [channel.name for channel in self.channels]
        if len(set(names)) != len(names) or "occupancy" in names:
            raise ValueError(f"channel names must differ from each other and from 'occupancy', got {names}")
        return self

    def __str__(self) -> str:
        """Such as `voxels of 0.04 m, cells of 128^3, channels colour, temperature`."""
        names = ", ".join(channel.name for channel in self.channels) or "none"
        height = f" and {self.voxel_height_m:g} m height" if self.is_flat else ""
        return f"voxels of {self.voxel_edge_m:g} m{height}, cells of {self.side}^3, channels {names}"

    @property
    def voxel_edge_m(self) -> float:
        """Edge of a voxel, metres; of a flat one its horizontal edges."""
        return self.voxel_edge_um / 1e6

    @property
    def is_flat(self) -> bool:
        """True if voxels are lower than they are wide: a level layer, read as a surface."""
        return self.height_step_um is not None

    @property
    def voxel_height_um(self) -> int:
        """Height of a voxel, micrometres; of a cube its edge."""
        return self.voxel_edge_um if self.height_step_um is None else self.height_step_um

    @property
    def voxel_height_m(self) -> float:
        """Height of a voxel, metres; of a cube its edge."""
        return self.voxel_height_um / 1e6

    @property
    def voxel_edges_m(self) -> tuple[float, float, float]:
        """Edges of a voxel along x, y and z, metres; equal but where voxels are flat."""
        return self.voxel_edge_m, self.voxel_edge_m, self.voxel_height_m

    @property
    def side(self) -> int:
        """Voxels along a cell's edge."""
        return 1 << self.depth

    @property
    def cell_edge_m(self) -> float:
        """Edge of a cell, metres; of one of flat voxels its horizontal edges."""
        return self.voxel_edge_um * self.side / 1e6

    @property
    def cell_edges_m(self) -> tuple[float, float, float]:
        """Edges of a cell along x, y and z, metres; equal but where voxels are flat."""
        return self.cell_edge_m, self.cell_edge_m, self.voxel_height_um * self.side / 1e6

    def voxel_size_um(self) -> Ints:
        """(3,) edges of a voxel along x, y and z, micrometres."""
        return np.array([self.voxel_edge_um, self.voxel_edge_um, self.voxel_height_um], np.int64)

    @property
    def plane_count(self) -> int:
        """Columns of the sample matrix."""
        return sum(len(channel.planes) for channel in self.channels)

    def planes_of(self, name: str) -> slice:
        """Columns of one channel in the sample matrix.

        Raises:
            BadInputError: the map has no such channel.
        """
        start = 0
        for channel in self.channels:
            stop = start + len(channel.planes)
            if channel.name == name:
                return slice(start, stop)
            start = stop
        raise BadInputError("unknown_channel", f"map has no channel {name!r}; it has {[c.name for c in self.channels]}")

    def channel(self, name: str) -> Channel | None:
        """The channel of that name, or None."""
        return next((channel for channel in self.channels if channel.name == name), None)

    def digest(self) -> bytes:
        """SHA-256 (32 bytes) over the geometry as JSON with sorted keys; two maps can share evidence only if equal."""
        return _digest(self.voxel_edge_um, self.depth, self.channels, self.height_step_um)


@lru_cache(maxsize=64)
def _digest(voxel_edge_um: int, depth: int, channels: tuple[Channel, ...], height_step_um: int | None) -> bytes:
    geometry = Geometry(voxel_edge_um=voxel_edge_um, depth=depth, channels=channels, height_step_um=height_step_um)
    text = json.dumps(geometry.model_dump(mode="json"), sort_keys=True, separators=(",", ":"), ensure_ascii=True)
    return hashlib.sha256(text.encode()).digest()


def geometry_for(*, voxel_edge_m: float, channels: tuple[Channel, ...] = STANDARD_CHANNELS) -> Geometry:
    """The geometry with voxels of an edge in metres, and standard cells: as `Geometry(voxel_edge_um=...)`.

    So a server can change a full cell in 850 MB of memory (docs/decisions/024-cells-of-at-most-128.md).

    Raises:
        BadInputError: the voxel edge is not 1 mm to 1 m.
    """
    edge_um = round(voxel_edge_m * 1e6)
    if not 1000 <= edge_um <= 1_000_000:
        raise BadInputError("bad_geometry", f"voxel edge must be 0.001 to 1 m, got {voxel_edge_m}")
    return Geometry(voxel_edge_um=edge_um, channels=channels)


def level_geometry(*, voxel_edge_m: float = LEVEL_EDGE_M, height_step_m: float = LEVEL_STEP_M) -> Geometry:
    """The geometry of a level layer: flat voxels, their horizontal edge and height in metres, with standard cells.

    Raises:
        BadInputError: the edge is not 1 mm to 1 m, or the height not 1 mm to the edge.
    """
    edge_um, step_um = round(voxel_edge_m * 1e6), round(height_step_m * 1e6)
    if not 1000 <= step_um <= edge_um <= 1_000_000:
        raise BadInputError(
            "bad_geometry",
            f"a level's voxel edge must be 0.001 to 1 m, and its height step 0.001 m to the edge, "
            f"got {voxel_edge_m} and {height_step_m}",
        )
    return Geometry(voxel_edge_um=edge_um, height_step_um=step_um, channels=(HEIGHT_OFFSET,))


def check_cubes(geometry: Geometry) -> None:
    """Refuse a level layer where a question is about space: it holds surfaces, and hardly anything of what is free.

    Raises:
        BadInputError: kind `level_layer`.
    """
    if geometry.is_flat:
        raise BadInputError(
            "level_layer",
            "this layer is a level: it answers points, slices, height maps, elevation and pictures. For rays, "
            "obstacles, free space and overlays ask a layer of cubic voxels",
        )


def _standard_depth(edge_um: int, planes: int) -> int:
    depth = STANDARD_DEPTH_MAX
    while depth > BRICK_DEPTH and (edge_um << depth > STANDARD_CELL_UM or planes << 3 * depth > STANDARD_SUMS_MAX):
        depth -= 1
    return depth


@lru_cache(maxsize=4096)
def cell_key(cell: tuple[int, int, int]) -> CellKey:
    """The 63-bit number of a cell.

    Raises:
        BadInputError: an index is beyond the numbered space.
    """
    if not all(-CELL_LIMIT <= v < CELL_LIMIT for v in cell):
        raise BadInputError("cell_range", f"cell indices must lie in [-{CELL_LIMIT}, {CELL_LIMIT}), got {cell}")
    return CellKey(int(interleave(np.array([cell], dtype=np.int64) + CELL_LIMIT)[0]))


def cell_keys(cells: Sequence[tuple[int, int, int]]) -> UInts:
    """(N,) uint64, the numbers of N cells; as `cell_key`, at a twentieth of its cost.

    Raises:
        BadInputError: an index is beyond the numbered space.
    """
    try:
        found = np.array(cells, dtype=np.int64).reshape(-1, 3)
    except OverflowError:
        found = np.full((1, 3), CELL_LIMIT)
    if ((found < -CELL_LIMIT) | (found >= CELL_LIMIT)).any():
        raise BadInputError("cell_range", f"cell indices must lie in [-{CELL_LIMIT}, {CELL_LIMIT})")
    return interleave(found + CELL_LIMIT)


def cells_of_keys(keys: UInts) -> npt.NDArray[np.int64]:
    """(N, 3) signed indices of N cell numbers; the mirror of `cell_keys`."""
    return deinterleave(keys.astype(np.uint64)) - CELL_LIMIT


@lru_cache(maxsize=4096)
def cell_of_key(key: int) -> Cell:
    """Signed indices of a cell number; the mirror of `cell_key`."""
    i, j, k = deinterleave(np.array([key], dtype=np.uint64))[0] - CELL_LIMIT
    return Cell(int(i), int(j), int(k))


def cell_from_text(text: str) -> Cell:
    """Cell of a text `i,j,k`.

    Raises:
        BadInputError: not three integers, or beyond the numbered space.
    """
    found = CELL_TEXT.fullmatch(text)
    if not found:
        raise BadInputError("bad_cell", f"a cell is written i,j,k with integers, got {text[:64]!r}")
    cell = Cell(*(int(part) for part in found.groups()))
    cell_key(cell)
    return cell


def voxels_of_points(points_m: npt.NDArray[np.floating], geometry: Geometry) -> Ints:
    """(N, 3) int64 voxel numbers of (N, 3) points in metres, map frame; points must be finite.

    Raises:
        BadInputError: a point lies outside the numbered space or is not finite.
    """
    points = np.asarray(points_m, dtype=np.float64).reshape(-1, 3)
    reach_m = (CELL_LIMIT - 1) * geometry.cell_edges_m[2]  # the least of the three
    if not (np.abs(points) < reach_m).all():  # also catches NaN
        raise BadInputError("point_range", f"points must be finite and within {reach_m:.0f} m of the origin")
    # Division by one number takes a third of the time of division by three.
    size_um = geometry.voxel_size_um() if geometry.is_flat else geometry.voxel_edge_um
    voxels: Ints = np.rint(points * NANOMETRES).astype(np.int64) // (size_um * 1000)
    return voxels


def split_voxels(voxels: Ints, geometry: Geometry) -> tuple[npt.NDArray[np.uint64], npt.NDArray[np.uint32]]:
    """Cell numbers (N,) uint64 and Morton codes inside the cell (N,) uint32 of (N, 3) voxel numbers."""
    cells = interleave((voxels >> geometry.depth) + CELL_LIMIT)
    places = interleave(voxels & (geometry.side - 1)).astype(np.uint32)
    return cells, places


def voxels_in_cell(places: npt.NDArray[np.uint32], key: int, geometry: Geometry) -> Ints:
    """(N, 3) voxel numbers of places (Morton codes) inside one cell; the mirror of `split_voxels`."""
    origin = np.array(cell_of_key(key), dtype=np.int64) * geometry.side
    return deinterleave(places.astype(np.uint64)) + origin


def centres_of_voxels(voxels: Ints, geometry: Geometry) -> npt.NDArray[np.float64]:
    """(N, 3) float64 centres in metres, map frame, of (N, 3) voxel numbers."""
    return np.asarray((voxels * 2 + 1) * (geometry.voxel_size_um() / 2e6), dtype=np.float64)
