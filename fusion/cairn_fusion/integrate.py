"""A scan as evidence: the paper's chapter IV from images to voxels.

    returns  points of the map                       Eq. 1-5
    samples  what cameras saw of them                Eq. 5-6: `samples`
    hits     where beams ended, misses where the image looks through      `tally`, `carve`; for lidars `cast`
    pack     evidence by cell

Inverse sensor model: one count per voxel and scan, and a hit wins over a miss. The result depends on the scan alone,
never on the map, nor on how many scans are added in what order on how many threads.
"""

import math
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
import numpy.typing as npt

from cairn_calib.poses import Transform, checked_transform, transform_points
from cairn_calib.rig import Rig
from cairn_fusion.carve import MARGIN_VOXELS, Window, carving_of, window_of
from cairn_fusion.cast import SeenVoxels, seen_voxels
from cairn_fusion.samples import Returns, returns_of, sample_sums
from cairn_fusion.scan import Scan
from cairn_fusion.tallies import Tallies
from cairn_fusion.tally import Each
from cairn_map.channels import ChannelKind
from cairn_map.errors import BadInputError
from cairn_map.evidence import Evidence, packed_evidence
from cairn_map.grid import CellKey, Geometry, split_voxels, voxels_of_points

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]


class Method(StrEnum):
    """How free space is found."""

    CARVE = "carve"
    """Projectively, where the camera's image fits in a plane; else as `CAST`."""
    CAST = "cast"
    """Ray by ray: for lidars, and as the slow twin."""


@dataclass(frozen=True, slots=True)
class Integrator:
    """How scans become evidence; its text goes into every commit."""

    min_range_m: float = 0.1
    max_range_m: float = 10.0
    """Beyond it a time-of-flight camera wraps round; a return there is ignored, not taken for free space."""
    method: Method = Method.CARVE
    flying_step_m: float = 0.05
    """What a pixel must differ from both its neighbours by to be taken for a mixture of them (`flying_kernels`), and
    so for no return; of images that are carved. Infinite: none is."""

    def __post_init__(self) -> None:
        if not 0 <= self.min_range_m < self.max_range_m < float("inf"):
            raise BadInputError(
                "bad_range", f"0 <= min_range_m < max_range_m must hold, got {self.min_range_m}, {self.max_range_m}"
            )
        if not self.flying_step_m > 0:
            raise BadInputError("bad_range", f"flying_step_m must be above 0, got {self.flying_step_m}")

    def __str__(self) -> str:
        limits = f"min_range_m={self.min_range_m:g} max_range_m={self.max_range_m:g}"
        return f"cairn-{self.method} 2 {limits} flying_step_m={self.flying_step_m:g}"


class Integration:
    """Scans being integrated, by any number of threads, which take turns only to count. Memory: see `tally`."""

    def __init__(self, rig: Rig, geometry: Geometry, integrator: Integrator, *, around_m: Floats | None = None) -> None:
        """Args: around_m: (3,) where the first tally is to be centred; None: where the first scan was taken."""
        self._rig = rig
        self._geometry = geometry
        self._integrator = integrator
        self._tallies = Tallies(geometry, max_range_m=integrator.max_range_m, around_m=around_m)

    def add(self, scan: Scan) -> None:
        """Add a scan.

        Raises:
            BadInputError: an image does not fit its camera, the scan names a channel that the map lacks, or reaches
                beyond the numbered space; nothing was added.
        """
        limits, rig, camera = self._integrator, self._rig, self._rig[scan.range_camera].camera
        window = window_of(camera) if limits.method is Method.CARVE else None  # pyright: ignore[reportArgumentType]
        returns = returns_of(
            scan,
            rig,
            min_range_m=limits.min_range_m,
            max_range_m=limits.max_range_m,
            flying_step_m=limits.flying_step_m if window is not None else math.inf,
        )
        scalars = _scalar_evidence(scan, self._geometry)
        if window is None:
            self._tallies.merge(_cast(scan, rig, self._geometry, returns))
        elif len(returns.pixels):
            self._carve(scan, returns, window)
        self._tallies.merge(scalars)

    def add_points(self, points: npt.NDArray[np.floating], T_map_sensor: Transform) -> None:
        """Add a sweep of a sensor whose points have no order, ray by ray.

        Args:
            points: (N, 3) metres, sensor frame, all seen from its origin; NaN where nothing came back.
            T_map_sensor: where it was.

        Raises:
            BadInputError: not (N, 3), or it reaches beyond the numbered space; nothing was added.
        """
        if points.ndim != 2 or points.shape[1] != 3:
            raise BadInputError("bad_points", f"points must be (N, 3), got {points.shape}")
        T = checked_transform(T_map_sensor, name="T_map_sensor")
        own = points.astype(np.float64)
        range_m = np.linalg.norm(own, axis=1)
        kept = own[(range_m >= self._integrator.min_range_m) & (range_m <= self._integrator.max_range_m)]
        points_map = transform_points(T, kept)
        ends, first, _ = _unique_voxels(voxels_of_points(points_map, self._geometry))
        seen = seen_voxels(T[:3, 3], points_map[first], ends, self._geometry)
        samples = np.zeros((len(ends), self._geometry.plane_count), np.int64)
        self._tallies.merge(_packed_by_cell(seen, ends, samples, self._geometry))

    def diff(self, each: Each = map) -> dict[CellKey, Evidence]:
        """The evidence of all scans, by cell; `each` as for `Tally.packed`. Not while scans are being added."""
        return self._tallies.packed(each)

    def _carve(self, scan: Scan, returns: Returns, window: Window) -> None:
        """Hits where beams ended, misses where the image looks through."""
        edge_m = self._geometry.voxel_edge_m
        farthest_m = float(np.nanmax(returns.range_m))
        with self._tallies.around(returns.T_map_tof[:3, 3], farthest_m) as (tally, hits):
            voxel_of, count = hits.number(returns.points_map, tally)
            sums = sample_sums(scan, self._rig, self._geometry, returns, voxel_of, count)
            carving = carving_of(
                window.clear_ranges(returns.range_m, MARGIN_VOXELS * edge_m),
                window,
                returns.T_map_tof,
                corner=tally.corner,
                dims=tally.dims,
                voxel_edge_m=edge_m,
                min_range_m=self._integrator.min_range_m,
                scratch=hits.scratch,
            )
            tally.add_hits(hits, sums)
            tally.add_misses(hits, carving)


def integrate_scan(scan: Scan, rig: Rig, geometry: Geometry, *, integrator: Integrator) -> dict[CellKey, Evidence]:
    """The evidence of one scan, by cell: every voxel has one hit or one miss, or only a scalar sample.

    Raises:
        BadInputError: as `Integration.add`.
    """
    one = Integration(rig, geometry, integrator)
    one.add(scan)
    return one.diff()


def integrate_scans(
    scans: Sequence[Scan], rig: Rig, geometry: Geometry, *, integrator: Integrator, threads: int | None = None
) -> dict[CellKey, Evidence]:
    """The evidence of many scans, by cell; the same bits on any number of threads, because all of it is integers.

    Raises:
        BadInputError: as `Integration.add`.
    """
    count = max(1, min(threads or os.cpu_count() or 1, len(scans)))
    around_m = scans[0].T_map_rig[:3, 3] if scans else None
    integration = Integration(rig, geometry, integrator, around_m=around_m)
    with ThreadPoolExecutor(count) as pool:
        # Whoever is done takes the next scan.
        list(pool.map(integration.add, scans))
        return integration.diff(pool.map)


def _cast(scan: Scan, rig: Rig, geometry: Geometry, returns: Returns) -> dict[CellKey, Evidence]:
    """The evidence of one scan but for its scalars, ray by ray."""
    ends, first, voxel_of = _unique_voxels(voxels_of_points(returns.points_map, geometry))
    samples = sample_sums(scan, rig, geometry, returns, voxel_of, len(ends))
    seen = seen_voxels(returns.T_map_tof[:3, 3], returns.points_map[first], ends, geometry)
    return _packed_by_cell(seen, ends, samples, geometry)


def _unique_voxels(voxels: Ints) -> tuple[Ints, Ints, Ints]:
    """Different voxels (U, 3), the first point in each (U,), and the number of each point's voxel (N,)."""
    if not len(voxels):
        return voxels, np.empty(0, np.int64), np.empty(0, np.int64)
    low = voxels.min(axis=0)
    span = voxels.max(axis=0) - low + 1
    shifted = voxels - low
    flat = (shifted[:, 2] * span[1] + shifted[:, 1]) * span[0] + shifted[:, 0]
    _, first, voxel_of = np.unique(flat, return_index=True, return_inverse=True)
    return voxels[first], first, voxel_of


def _packed_by_cell(seen: SeenVoxels, ends: Ints, samples: Ints, geometry: Geometry) -> dict[CellKey, Evidence]:
    end_cells, end_places = split_voxels(ends, geometry)
    order = np.lexsort((end_places, end_cells))
    end_cells, end_places, samples = end_cells[order], end_places[order], samples[order]
    cells, starts = np.unique(seen.cells, return_index=True)
    bounds = np.append(starts, len(seen.cells))
    packed: dict[CellKey, Evidence] = {}
    for cell, start, stop in zip(cells, bounds[:-1], bounds[1:], strict=True):
        hit = seen.hit[start:stop]
        mine = slice(*np.searchsorted(end_cells, [cell, cell + np.uint64(1)]))
        full = np.zeros((stop - start, geometry.plane_count), np.int64)
        # Hits and end points of a cell are the same voxels in the same order.
        full[hit] = samples[mine]
        counts = np.stack([hit, ~hit], axis=1).astype(np.int32)
        packed[CellKey(int(cell))] = packed_evidence(seen.places[start:stop], counts, full, geometry)
    return packed


def _scalar_evidence(scan: Scan, geometry: Geometry) -> dict[CellKey, Evidence]:
    """Named readings, at the voxel where the rig stands."""
    if not scan.scalars:
        return {}
    samples = np.zeros((1, geometry.plane_count), np.int64)
    for name, value in scan.scalars.items():
        channel = geometry.channel(name)
        if channel is None or channel.kind is not ChannelKind.SCALAR:
            raise BadInputError("unknown_channel", f"the map has no scalar channel {name!r}; create it with one")
        samples[0, geometry.planes_of(name)] = [int(channel.quantise(np.array([value]))[0]), 1]
    cells, places = split_voxels(voxels_of_points(scan.T_map_rig[:3, 3], geometry), geometry)
    return {CellKey(int(cells[0])): packed_evidence(places, np.zeros((1, 2), np.int32), samples, geometry)}
