"""Votes for classes: one for each voxel, camera and measurement, from the label images of its scans.

    pixels   of all scans, by voxel and class                          integers, in any order
    winner   class with the most pixels, of equal ones the smaller number
    vote     weight 1 to 4: by how much the winner leads, of pixels and of their share

Frames of one stop repeat the same mistake, and so count as one vote. Its weight is the lead of the winner over the next
class in pixels, but no more than its share of all pixels in quarters, rounded up: one pixel weighs 1, four of one class
4, fifty against forty-six 1.
"""

from collections.abc import Mapping
from threading import Lock
from typing import NamedTuple

import numpy as np

from cairn_calib.rig.rig import Rig
from cairn_fusion.mapping.beam_returns import Returns
from cairn_fusion.mapping.ray_casting import unique_voxels
from cairn_fusion.mapping.samples import ImageTransfers
from cairn_fusion.recording.scan import LabelNames, Scan
from cairn_fusion.transfer.transfer import Label
from cairn_map.arrays import Ints, Words32
from cairn_map.errors import BadInputError
from cairn_map.evidence.channels import OTHER, VOTE_MAX, Channel, ChannelKind
from cairn_map.evidence.evidence import Evidence, packed_evidence
from cairn_map.evidence.grid import CellKey, Geometry, split_voxels, voxels_of_points

ROWS_MAX = 1 << 21
"""Rows of pixel counts of one camera, 40 bytes each, above which those of the same voxel and class are added up."""
SILENT = -1
"""Class of a pixel whose label says nothing."""


class PixelCounts(NamedTuple):
    """Pixels of one camera by voxel and class."""

    voxels: Ints
    """(M, 3) voxel numbers."""
    classes: Ints
    """(M,) class of each row."""
    pixels: Ints
    """(M,) how many."""


class CameraVotes(NamedTuple):
    """Votes of one camera, one for each voxel."""

    voxels: Ints
    """(V, 3) different voxel numbers."""
    winners: Ints
    """(V,) class of each vote."""
    weights: Ints
    """(V,) weight of each vote, 1 to `VOTE_MAX`."""


def classes_of_labels(scan: Scan, geometry: Geometry) -> dict[str, Ints]:
    """Class numbers (H, W) of a scan's label images, `SILENT` where one says nothing; none of a map without classes.

    Raises:
        BadInputError: kind `unknown_class`: a name of the scan's table that the map's list lacks.
    """
    channel = _channel_of(geometry)
    if channel is None or not scan.labels:
        return {}
    check_label_names(scan.label_names, geometry)
    names = {name: number for number, name in enumerate(channel.classes)}
    number_of = np.full(max(scan.label_names, default=0) + 1, SILENT, np.int64)
    for value, name in scan.label_names.items():
        number_of[value] = SILENT if name is None else names[name]
    # Each value is in the table: `check_scan` saw to it.
    return {camera: number_of[image] for camera, image in scan.labels.items()}


def check_label_names(label_names: LabelNames, geometry: Geometry) -> None:
    """Refuse a table of labels for a map with other classes; a map without classes takes any.

    Raises:
        BadInputError: kind `unknown_class`: a name that the map's list lacks.
    """
    channel = _channel_of(geometry)
    if channel is None:
        return
    unknown = sorted({name for name in label_names.values() if name is not None} - {*channel.classes})
    if unknown:
        raise BadInputError(
            "unknown_class",
            f"the labels name {', '.join(unknown[:8])}, and the map's classes are {', '.join(channel.classes)}; "
            f"name what is none of them {OTHER!r}, or add a layer with these classes",
        )


class ClassVotes:
    """Votes of a measurement's cameras; thread-safe except for `diff`."""

    def __init__(self, geometry: Geometry) -> None:
        self._geometry = geometry
        self._channel = _channel_of(geometry)
        self._lock = Lock()
        self._counts: dict[str, list[PixelCounts]] = {}

    def add(self, classes: Mapping[str, Ints], scan: Scan, rig: Rig, returns: Returns, sight: ImageTransfers) -> None:
        """Count the pixels of a scan's label images, of `classes_of_labels`, for the voxels where beams ended."""
        if not classes or not len(returns.pixels):
            return
        hits = voxels_of_points(returns.points_map, self._geometry)
        voxels, voxel_of = unique_voxels(hits)
        for camera, numbers in classes.items():
            if camera == scan.range_camera:
                # Its own image: each point lies in its own pixel.
                of_point = numbers.ravel()[returns.pixels]
            else:
                transfer = sight.into(camera, np.zeros(len(voxels), np.bool_), voxel_of.astype(np.int32))
                of_point = np.full(len(voxel_of), SILENT, np.int64)
                seen = np.nonzero(transfer.labels == Label.OK)[0]
                x, y = transfer.pixels[:, seen]
                of_point[seen] = numbers[y, x]
            said = of_point != SILENT
            if said.any():
                self._count(camera, voxels, voxel_of[said], of_point[said])

    def diff(self) -> dict[CellKey, Evidence]:
        """One vote for each voxel and camera, by cell; without hits and misses."""
        if self._channel is None or not self._counts:
            return {}
        votes = [_votes_of(_summed(counts)) for _, counts in sorted(self._counts.items())]
        numbers, places = split_voxels(np.concatenate([each.voxels for each in votes]), self._geometry)
        winners = np.concatenate([each.winners for each in votes])
        weights = np.concatenate([each.weights for each in votes])
        # Rows of all planes are made of one cell at a time: with 64 classes they take 512 bytes a voxel.
        order = np.argsort(numbers, kind="stable")
        cells, starts = np.unique(numbers[order], return_index=True)
        return {
            CellKey(cell): self._of_cell(places[rows], winners[rows], weights[rows], self._channel)
            for cell, rows in zip(cells.tolist(), np.split(order, starts[1:]), strict=True)
        }

    def _of_cell(self, places: Words32, winners: Ints, weights: Ints, channel: Channel) -> Evidence:
        """Votes in one cell, several for a voxel where several cameras saw it."""
        voxels, row_of = np.unique(places, return_inverse=True)
        planes = self._geometry.planes_of(channel.name)
        sums = np.zeros((len(voxels), self._geometry.plane_count), np.int64)
        # The last class has no plane of its own: it is the rest of the weight.
        named = winners < len(channel.classes) - 1
        np.add.at(sums, (row_of[named], planes.start + winners[named]), weights[named])
        np.add.at(sums[:, planes.stop - 1], row_of, weights)
        return packed_evidence(voxels, np.zeros((len(voxels), 2), np.int32), sums, self._geometry)

    def _count(self, camera: str, voxels: Ints, voxel_of: Ints, classes: Ints) -> None:
        N = len(self._channel.classes) if self._channel else 1
        pairs, pixels = np.unique(voxel_of * N + classes, return_counts=True)
        counts = PixelCounts(voxels[pairs // N], pairs % N, pixels)
        with self._lock:
            held = self._counts.setdefault(camera, [])
            held.append(counts)
            # The first part is the sum of those before: what came since is added up when it is as much again.
            if sum(len(one.pixels) for one in held[1:]) > max(ROWS_MAX, len(held[0].pixels)):
                held[:] = [_summed(held)]


def _channel_of(geometry: Geometry) -> Channel | None:
    return next((channel for channel in geometry.channels if channel.kind is ChannelKind.CLASSES), None)


def _votes_of(counts: PixelCounts) -> CameraVotes:
    """Votes of one camera, one for each voxel; the counts rise in voxel, and in class within one, as `_summed` are."""
    voxels, voxel_of = unique_voxels(counts.voxels)
    starts = np.flatnonzero(np.diff(voxel_of, prepend=-1))
    total, first = np.add.reduceat(counts.pixels, starts), np.maximum.reduceat(counts.pixels, starts)
    # Of classes with as many pixels the first row has the smallest number.
    best = np.flatnonzero(counts.pixels == first[voxel_of])
    winner_rows = best[np.unique(voxel_of[best], return_index=True)[1]]
    rest = counts.pixels.copy()
    rest[winner_rows] = 0
    lead = first - np.maximum.reduceat(rest, starts)
    weights = np.clip(np.minimum(lead, -(-VOTE_MAX * lead // total)), 1, VOTE_MAX)
    return CameraVotes(voxels, counts.classes[winner_rows], weights)


def _summed(parts: list[PixelCounts]) -> PixelCounts:
    """Pixels of the same voxel and class added up, rising in voxel, in the order of `unique_voxels`, and in class."""
    if len(parts) == 1:
        return parts[0]
    voxels, voxel_of = unique_voxels(np.concatenate([part.voxels for part in parts]))
    classes = np.concatenate([part.classes for part in parts])
    N = int(classes.max()) + 1
    pairs, row_of = np.unique(voxel_of * N + classes, return_inverse=True)
    pixels = np.bincount(row_of, np.concatenate([part.pixels for part in parts]), len(pairs)).astype(np.int64)
    return PixelCounts(voxels[pairs // N], pairs % N, pixels)
