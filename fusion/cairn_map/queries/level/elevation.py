"""Elevation: a level layer as a surface from above, with its uncertainty, and what hinders a vehicle on it.

    ground = cairn.open_map("http://base:8750/maps/site.ground").elevation()
    ground.height_m[y, x], ground.sigma_m[y, x]       # NaN where no surface is known
    ground.difficulty(Vehicle(step_max_m=0.2))        # 0 easy, 1 the limit of the vehicle, more: too much

A column's surface is the mean of the votes in the lowest three bins that hold 15 % of the column's votes, and at least
two: so the ground below grass, below a bridge, and where a person stood. What stands on it is an obstacle if as many
scans saw it. From the heights of a column and its eight neighbours come the slope and the roughness, of the plane
through them, and the step.
"""

import itertools
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from cairn_map.arrays import Flags, Floats, Ints
from cairn_map.errors import BadInputError
from cairn_map.evidence.channels import HEIGHT_OFFSET
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.grid import CellKey, Geometry, voxels_in_cell
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_map.queries.level.elevation_kernels import columns_into

SIGMA_MIN_M = 0.01
"""Uncertainty of a height that no number of votes takes away: errors of pose and range that scans of a stop share."""
VOTE_SPREAD = 0.29
"""Standard deviation of a vote within its bin, in steps of height: that of an even spread, sqrt(1/12)."""
SLOPE_SHARE = 0.35
"""Uncertainty of a height on a slope, as a share of the column's rise: returns lie anywhere in the column."""
CLEARANCE_M = 1.5
"""Height of a usual vehicle: what is higher above the ground does not hinder it."""
PLANE_MIN = 5
"""Columns of 3 x 3 with a height through which a plane is laid, at least."""
PIXELS_MAX = 1 << 24
"""Pixels of an elevation, at most: 57 bytes each, so that it takes 1 GB."""
TILE_PIXELS = 1 << 16
"""Pixels whose planes are laid at once."""
Part = tuple[slice, slice]
"""Part of an image: rows, columns."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Vehicle:
    """Limits of a vehicle on the ground."""

    slope_max_rad: float = 0.5236
    """Steepest slope, 30 degrees."""
    roughness_max_m: float = 0.08
    """Root mean square of the heights about a plane, on 3 x 3 columns."""
    step_max_m: float = 0.25
    """Highest step, and highest thing that it passes over."""

    def __post_init__(self) -> None:
        for name in ("slope_max_rad", "roughness_max_m", "step_max_m"):
            if not 0 < getattr(self, name) < np.inf:
                raise BadInputError("bad_range", f"{name} must be above 0 and finite, got {getattr(self, name)}")


STANDARD_VEHICLE = Vehicle()


@dataclass(frozen=True, slots=True, eq=False)
class Elevation:
    """A surface from above: (H, W) arrays, a pixel is a column of voxels; rows go along y and columns along x."""

    height_m: Floats
    """Height, metres, map frame; NaN where no surface is known, as in all but `votes`."""
    sigma_m: Floats
    """Standard deviation of the height as that of the column's mean ground."""
    votes: Ints
    """Votes of which the height is the mean."""
    slope_rad: Floats
    """Steepness of the plane through the columns around; NaN also where fewer than five of nine are known."""
    roughness_m: Floats
    """Root mean square of the heights about this plane; NaN likewise."""
    step_m: Floats
    """Largest difference of height to one of the eight neighbours."""
    obstacle_m: Floats
    """Height above the surface of the highest thing on it, within the clearance; 0 for none."""
    origin_m: tuple[float, float]
    """x, y of the centre of the pixel [0, 0], metres, map frame."""
    edge_m: float
    """Edge of a pixel, metres."""

    def difficulty(self, vehicle: Vehicle = STANDARD_VEHICLE) -> Floats:
        """(H, W) the largest of slope, roughness, step and obstacle in parts of the vehicle's limits; NaN: unknown.

        Above 1 the vehicle cannot pass.
        """
        parts = (
            self.slope_rad / vehicle.slope_max_rad,
            self.roughness_m / vehicle.roughness_max_m,
            np.maximum(self.step_m, self.obstacle_m) / vehicle.step_max_m,
        )
        found = np.fmax(np.fmax(parts[0], parts[1]), parts[2])
        return np.where(np.isnan(self.height_m), np.nan, found)

    def arrays(self) -> dict[str, np.ndarray[tuple[int, ...], np.dtype[np.generic]]]:
        """All of it by name, as files hold it."""
        named = {
            name: getattr(self, name)
            for name in ("height_m", "sigma_m", "votes", "slope_rad", "roughness_m", "step_m", "obstacle_m")
        }
        return named | {"origin_m": np.array(self.origin_m), "edge_m": np.array(self.edge_m)}


def elevation_of(
    cells: Iterable[tuple[CellKey, Evidence]],
    geometry: Geometry,
    model: SensorModel,
    *,
    low: Ints,
    high: Ints,
    clearance_m: float,
) -> Elevation:
    """Elevation of the columns from voxel `low` up to `high`, exclusive; voxels above or below are left out.

    Raises:
        BadInputError: kind `not_level`: the layer has cubic voxels; `bad_range`: no clearance.
    """
    if not geometry.is_flat:
        raise BadInputError(
            "not_level", "elevation is read of a level layer: `cairn map layer add MAP NAME --kind level` makes one"
        )
    if not clearance_m > 0:
        raise BadInputError("bad_range", f"the clearance must be above 0, got {clearance_m}")
    H, W = int(high[1] - low[1]), int(high[0] - low[0])
    # Stage 1: the voxels of the box, column by column from below.
    numbers, votes, offsets, hits, occupied = _voxels(cells, geometry, model, low, high)
    columns = (numbers[:, 1] - low[1]) * W + numbers[:, 0] - low[0]
    order = np.lexsort((numbers[:, 2], columns))
    # Stage 2: the surface of each column.
    step_mm = geometry.voxel_height_um / 1e3
    height, variance = np.full(H * W, np.nan), np.full(H * W, np.nan)
    count, obstacle = np.zeros(H * W, np.int64), np.zeros(H * W)
    columns_into(
        columns[order],
        numbers[order, 2],
        votes[order],
        offsets[order],
        hits[order],
        occupied[order],
        step_mm,
        clearance_m * 1e3,
        height,
        variance,
        count,
        obstacle,
    )
    # Stage 3: what the neighbours say. Arrays that are there already become those of the answer.
    height_m, sigma_m, obstacle_m = (each.reshape(H, W) for each in (height, variance, obstacle))
    for metres in (height_m, obstacle_m):
        metres /= 1e3
    obstacle_m[np.isnan(height_m)] = np.nan
    slope, roughness, step = _surroundings_into(height_m, count.reshape(H, W), sigma_m, geometry)
    x, y = ((int(number) * 2 + 1) * geometry.voxel_edge_um / 2e6 for number in low[:2])
    return Elevation(
        height_m=height_m,
        sigma_m=sigma_m,
        votes=count.reshape(H, W),
        slope_rad=slope,
        roughness_m=roughness,
        step_m=step,
        obstacle_m=obstacle_m,
        origin_m=(x, y),
        edge_m=geometry.voxel_edge_m,
    )


def _voxels(
    cells: Iterable[tuple[CellKey, Evidence]], geometry: Geometry, model: SensorModel, low: Ints, high: Ints
) -> tuple[Ints, Ints, Ints, Ints, Flags]:
    """Numbers, votes, sums of offsets in mm, hits and occupancy of the voxels in a box that were hit."""
    planes, step_mm = geometry.planes_of(HEIGHT_OFFSET.name), round(HEIGHT_OFFSET.step)
    none = np.empty(0, np.int64)
    found: list[tuple[Ints, Ints, Ints, Ints, Flags]] = [(none.reshape(0, 3), none, none, none, np.empty(0, np.bool_))]
    for key, evidence in cells:
        numbers = voxels_in_cell(evidence.voxels, key, geometry)
        sums = np.zeros((len(evidence), 2), np.int64)
        sums[evidence.sampled] = evidence.samples[:, planes]
        hits = evidence.counts[:, 0].astype(np.int64)
        kept = ((numbers >= low) & (numbers < high)).all(axis=1) & ((hits > 0) | (sums[:, 1] > 0))
        occupied = evidence.occupied(model)
        found.append((numbers[kept], sums[kept, 1], sums[kept, 0] * step_mm, hits[kept], occupied[kept]))
    return (
        np.concatenate([each[0] for each in found]),
        np.concatenate([each[1] for each in found]),
        np.concatenate([each[2] for each in found]),
        np.concatenate([each[3] for each in found]),
        np.concatenate([each[4] for each in found]),
    )


def _surroundings_into(
    height_m: Floats, votes: Ints, sigma_m: Floats, geometry: Geometry
) -> tuple[Floats, Floats, Floats]:
    """Slope, roughness and step of each column; `sigma_m` holds variances of votes, mm2, then uncertainties, metres.

    All of it is made by tiles: the sums of a column's plane take 200 bytes.
    """
    found = slope, roughness, step = np.empty(height_m.shape), np.empty(height_m.shape), np.empty(height_m.shape)
    for tile, bordered, inner in _tiles(*height_m.shape):
        for whole, part in zip(found, _around(height_m[bordered], geometry.voxel_edge_m), strict=True):
            whole[tile] = part[inner]
        spread2 = sigma_m[tile] / 1e6 + (VOTE_SPREAD * geometry.voxel_height_m) ** 2
        rise_m = np.nan_to_num(np.tan(slope[tile])) * geometry.voxel_edge_m
        sigma2 = spread2 / np.maximum(votes[tile], 1) + SIGMA_MIN_M**2 + (SLOPE_SHARE * rise_m) ** 2
        sigma_m[tile] = np.sqrt(sigma2)
    return slope, roughness, step


def _tiles(H: int, W: int) -> Iterator[tuple[Part, Part, Part]]:
    """Tiles of an image; each with the part that has its neighbours, too, and its own place in that part."""
    columns = min(max(W, 1), TILE_PIXELS)
    rows = max(1, TILE_PIXELS // columns)
    for y, x in itertools.product(range(0, H, rows), range(0, W, columns)):
        top, left = max(y - 1, 0), max(x - 1, 0)
        yield (
            (slice(y, y + rows), slice(x, x + columns)),
            (slice(top, y + rows + 1), slice(left, x + columns + 1)),
            (slice(y - top, y - top + rows), slice(x - left, x - left + columns)),
        )


def _around(height_m: Floats, edge_m: float) -> tuple[Floats, Floats, Floats]:
    """Slope and roughness of the plane through each 3 x 3 columns, and the largest step to one of the eight around."""
    H, W = height_m.shape
    padded = np.pad(height_m, 1, constant_values=np.nan)
    # Sums of the normal equations over the known ones of nine; heights relative to the middle, which is known.
    sums, step = np.zeros((10, H, W)), np.zeros((H, W))
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            z = padded[1 + dy : 1 + dy + H, 1 + dx : 1 + dx + W] - height_m
            known = ~np.isnan(z)
            z = np.where(known, z, 0.0)
            step = np.maximum(step, np.abs(z))
            x, y = dx * edge_m, dy * edge_m
            for row, factor in enumerate((1.0, x, y, x * x, x * y, y * y)):
                sums[row] += np.where(known, factor, 0.0)
            for row, product in enumerate((z, x * z, y * z, z * z), 6):
                sums[row] += product
    n, sx, sy, sxx, sxy, syy, sz, sxz, syz, szz = sums
    with np.errstate(divide="ignore", invalid="ignore"):
        # About the means; a determinant of 0 has all columns in a line.
        cxx, cxy, cyy = sxx - sx * sx / n, sxy - sx * sy / n, syy - sy * sy / n
        cxz, cyz, czz = sxz - sx * sz / n, syz - sy * sz / n, szz - sz * sz / n
        area = cxx * cyy - cxy * cxy
        a, b = (cxz * cyy - cyz * cxy) / area, (cyz * cxx - cxz * cxy) / area
        rest = np.sqrt(np.maximum(czz - a * cxz - b * cyz, 0.0) / n)
    unknown = np.isnan(height_m)
    no_plane = unknown | (n < PLANE_MIN) | ~(area > 1e-9 * edge_m**4)
    slope, roughness = np.where(no_plane, np.nan, np.arctan(np.hypot(a, b))), np.where(no_plane, np.nan, rest)
    return slope, roughness, np.where(unknown, np.nan, step)
