"""A scan as evidence: the paper's chapter IV from images to voxels.

    points   in the range camera's frame            Eq. 1-4
    samples  colour, temperature, amplitude          Eq. 5-6 with a z-buffer; only what a camera really saw
    cast     hits and misses                         inverse sensor model, one count per voxel and scan
    pack     evidence by cell

Each voxel that was hit gets at most one sample per channel and scan: the mean of the pixels that fell on it, with
weight 1. So a voxel's weights never exceed its hits, however fine the images are, and samples stay small numbers.
The result depends on the scan alone, never on the map.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cairn_calib.poses import transform_points
from cairn_calib.rig import Rig
from cairn_fusion.cast import SeenVoxels, seen_voxels
from cairn_fusion.scan import Scan, check_scan
from cairn_fusion.transfer import depth_steps, points_from_range, transfer_points
from cairn_map.channels import Channel, ChannelKind
from cairn_map.errors import BadInputError
from cairn_map.evidence import Evidence, packed_evidence
from cairn_map.evidence_map import EvidenceMap
from cairn_map.grid import CellKey, Geometry, split_voxels, voxels_of_points

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Integrator:
    """How scans become evidence; its text goes into every commit."""

    min_range_m: float = 0.1
    max_range_m: float = 10.0
    """Beyond it a time-of-flight camera wraps round; a return there is ignored, not taken for free space."""

    def __post_init__(self) -> None:
        if not 0 <= self.min_range_m < self.max_range_m < float("inf"):
            raise BadInputError(
                "bad_range", f"0 <= min_range_m < max_range_m must hold, got {self.min_range_m}, {self.max_range_m}"
            )

    def __str__(self) -> str:
        return f"cairn-cast 1 min_range_m={self.min_range_m:g} max_range_m={self.max_range_m:g}"


def integrate_scan(scan: Scan, rig: Rig, geometry: Geometry, *, integrator: Integrator) -> dict[CellKey, Evidence]:
    """The evidence of one scan, by cell.

    Args:
        scan: images and pose; checked against the rig.
        rig: the head that took it.
        geometry: of the map.
        integrator: range limits.

    Returns:
        Packed evidence; every voxel has one hit or one miss, or only a scalar sample.

    Raises:
        BadInputError: an image does not fit its camera, or the scan reaches beyond the numbered space.
    """
    check_scan(scan, rig)
    range_m = np.where(
        (scan.range_m >= integrator.min_range_m) & (scan.range_m <= integrator.max_range_m), scan.range_m, np.nan
    )
    image_points = points_from_range(range_m, rig[scan.range_camera].camera)
    returned = np.nonzero(np.isfinite(image_points[..., 2]).ravel())[0]
    points_tof = image_points.reshape(-1, 3)[returned]
    steps_m = depth_steps(image_points).ravel()[returned]
    T_map_tof = scan.T_map_rig @ rig[scan.range_camera].transform
    points = transform_points(T_map_tof, points_tof)
    ends, first, voxel_of = _unique_voxels(voxels_of_points(points, geometry))
    samples = np.zeros((len(ends), geometry.plane_count), np.int64)
    for channel, values, at in _samples(scan, rig, geometry, points_tof, steps_m, returned):
        _add_mean_samples(samples[:, geometry.planes_of(channel.name)], channel, values, voxel_of[at])
    seen = seen_voxels(T_map_tof[:3, 3], points[first], ends, geometry)
    local = EvidenceMap(geometry)
    local.merge(_packed_by_cell(seen, ends, samples, geometry))
    local.merge(_scalar_evidence(scan, geometry))
    return local.packed()


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


def _samples(
    scan: Scan, rig: Rig, geometry: Geometry, points_tof: Floats, steps_m: Floats, returned: Ints
) -> Iterator[tuple[Channel, Floats, Ints]]:
    """For each channel of the map: values (M, C) and the points (M,) that they belong to."""
    for channel in geometry.channels:
        if channel.kind is ChannelKind.COLOUR:
            images: dict[str, npt.NDArray[np.generic]] = dict(scan.colour)
        elif channel.kind is ChannelKind.TEMPERATURE:
            images = dict(scan.thermal)
        elif channel.kind is ChannelKind.INTENSITY and scan.amplitude is not None:
            yield channel, scan.amplitude.reshape(-1, 1)[returned].astype(np.float64), np.arange(len(returned))
            continue
        else:
            continue
        waiting = np.arange(len(points_tof))
        # The first camera speaks for what it sees; the next ones only fill what was hidden from those before.
        for name, image in images.items():
            transfer = transfer_points(
                points_tof[waiting], rig, src=scan.range_camera, dst=name, steps_m=steps_m[waiting]
            )
            values = transfer.sample(image).astype(np.float64).reshape(-1, channel.value_count)
            valid = np.isfinite(values).all(axis=1)
            found = waiting[transfer.ok][valid]
            yield channel, values[valid], found
            waiting = np.setdiff1d(waiting, found, assume_unique=True)


def _add_mean_samples(sums: Ints, channel: Channel, values: Floats, voxel_of: Ints) -> None:
    """Write one sample of weight 1, the mean of its values, to every voxel that has none of this channel yet."""
    pixels = np.bincount(voxel_of, minlength=len(sums))
    free = (pixels > 0) & (sums[:, -1] == 0)
    for c in range(channel.value_count):
        totals = np.bincount(voxel_of, weights=values[:, c], minlength=len(sums))
        sums[free, c] = channel.quantise(totals[free] / pixels[free])
    if channel.kind is ChannelKind.TEMPERATURE:
        sums[free, 1] = sums[free, 0] ** 2
    sums[free, -1] = 1


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
