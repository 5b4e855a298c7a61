"""Votes for classes: one for each voxel, camera and measurement, from the label images of its scans.

    pixels   of all scans, by voxel and class                          integers, in any order
    winner   class with the most pixels, of equal ones the smaller number
    vote     weight 1 to 4: by how much the winner leads, of pixels and of their share

Frames of one stop repeat the same mistake, and so count as one vote. Its weight is the lead of the winner over the next
class in pixels, but no more than its share of all pixels in quarters, rounded up: one pixel weighs 1, four of one class
4, fifty against forty-six 1.

Scans are counted on a grid without the classes, whose planes would be carried through every sum of hits; the planes of
all classes come with the votes, once a measurement.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from threading import Lock
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from cairn_calib.rig.rig import Rig
from cairn_fusion.mapping.beam_returns import Returns
from cairn_fusion.mapping.class_vote_kernels import add_votes_into, count_pixels_into, place_rows_into, votes_into
from cairn_fusion.mapping.samples import ImageTransfers
from cairn_fusion.recording.scan import LabelNames, Scan
from cairn_fusion.transfer.transfer import Label
from cairn_map.arrays import Bytes, Int32s, Ints, Words32
from cairn_map.errors import BadInputError
from cairn_map.evidence.channels import OTHER, VOTE_MAX, Channel, ChannelKind
from cairn_map.evidence.evidence import Evidence, empty_evidence
from cairn_map.evidence.grid import CellKey, Geometry, split_voxels, voxels_of_points

SILENT = -1
"""Class of a pixel whose label says nothing."""


Item = TypeVar("Item", bound=np.generic)


@dataclass(slots=True, eq=False)
class PixelCounts:
    """Pixels of one camera by voxel and class, in the arrays of `class_vote_kernels`; grown as scans come."""

    slots: Int32s = field(default_factory=lambda: np.zeros(2, np.int32))
    voxels: Int32s = field(default_factory=lambda: np.empty((0, 3), np.int32))
    heads: Int32s = field(default_factory=lambda: np.empty(0, np.int32))
    nexts: Int32s = field(default_factory=lambda: np.empty(0, np.int32))
    classes: Bytes = field(default_factory=lambda: np.empty(0, np.uint8))
    pixels: Ints = field(default_factory=lambda: np.empty(0, np.int64))
    rows: int = 0
    """Different voxels so far."""
    pairs: int = 0
    """Different pairs of voxel and class so far."""

    def add(self, voxels: Ints, classes: Ints) -> None:
        """Count (N,) pixels of voxels (N, 3) and classes; `SILENT` ones are left out."""
        # Room for the worst case; pages that stay unwritten cost no memory.
        rows, pairs = self.rows + len(voxels), self.pairs + len(voxels)
        self.voxels, self.heads = _grown(self.voxels, rows, self.rows), _grown(self.heads, rows, self.rows)
        self.nexts, self.classes = _grown(self.nexts, pairs, self.pairs), _grown(self.classes, pairs, self.pairs)
        self.pixels = _grown(self.pixels, pairs, self.pairs)
        if 2 * rows > len(self.slots):
            self.slots = np.zeros(1 << (2 * rows - 1).bit_length(), np.int32)
            place_rows_into(self.voxels[: self.rows], self.slots)
        self.rows, self.pairs = count_pixels_into(
            voxels,
            classes,
            self.slots,
            self.voxels,
            self.heads,
            self.nexts,
            self.classes,
            self.pixels,
            self.rows,
            self.pairs,
        )

    def votes(self) -> tuple[Ints, Ints, Ints]:
        """(V, 3) different voxels, the class of the vote in each, and its weight, 1 to `VOTE_MAX`."""
        winners, weights = np.empty(self.rows, np.int64), np.empty(self.rows, np.int64)
        votes_into(self.heads[: self.rows], self.nexts, self.classes, self.pixels, VOTE_MAX, winners, weights)
        return self.voxels[: self.rows].astype(np.int64), winners, weights


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


def without_classes(geometry: Geometry) -> Geometry:
    """The same grid without its channel of classes, on which scans are counted."""
    channels = tuple(channel for channel in geometry.channels if channel.kind is not ChannelKind.CLASSES)
    return geometry if len(channels) == len(geometry.channels) else geometry.model_copy(update={"channels": channels})


class ClassVotes:
    """Votes of a measurement's cameras; thread-safe except for `joined`."""

    def __init__(self, geometry: Geometry) -> None:
        self.geometry = geometry
        """The map's, with its classes."""
        self._channel = _channel_of(geometry)
        self._lock = Lock()
        self._counts: dict[str, PixelCounts] = {}

    def add(self, classes: Mapping[str, Ints], scan: Scan, rig: Rig, returns: Returns, sight: ImageTransfers) -> None:
        """Count the pixels of a scan's label images, of `classes_of_labels`, for the voxels where beams ended."""
        if not classes or not len(returns.pixels):
            return
        hits = voxels_of_points(returns.points_map, self.geometry)
        for camera, numbers in classes.items():
            if camera == scan.range_camera:
                # Its own image: each point lies in its own pixel.
                of_point = numbers.ravel()[returns.pixels]
            else:
                # No voxel has a vote that makes others needless.
                transfer = sight.into(camera, np.zeros(1, np.bool_), np.zeros(len(hits), np.int32))
                of_point = np.full(len(hits), SILENT, np.int64)
                seen = np.nonzero(transfer.labels == Label.OK)[0]
                x, y = transfer.pixels[:, seen]
                of_point[seen] = numbers[y, x]
            if (of_point != SILENT).any():
                self.count(camera, hits, of_point)

    def count(self, camera: str, voxels: Ints, classes: Ints) -> None:
        """Count (N,) pixels of a camera that show voxels (N, 3) and classes; `SILENT` ones say nothing."""
        with self._lock:
            self._counts.setdefault(camera, PixelCounts()).add(voxels, classes)

    def joined(self, counted: Mapping[CellKey, Evidence]) -> dict[CellKey, Evidence]:
        """Evidence that was counted on the grid `without_classes`, with one vote for each voxel and camera, by cell."""
        channel = self._channel
        if channel is None:
            return dict(counted)
        found = [counts.votes() for _, counts in sorted(self._counts.items())] or [PixelCounts().votes()]
        voxels, winners, weights = (np.concatenate([each[part] for each in found]) for part in range(3))
        numbers, places = split_voxels(voxels, self.geometry)
        # Rows of all planes are made of one cell at a time: with 64 classes they take 512 bytes a voxel.
        order = np.lexsort((places, numbers))
        cells, starts = np.unique(numbers[order], return_index=True)
        voted = dict(zip(cells.tolist(), np.split(order, starts[1:]), strict=True)) if len(order) else {}
        none, nothing = np.empty(0, np.int64), empty_evidence(without_classes(self.geometry))
        joined: dict[CellKey, Evidence] = {}
        for key in sorted({*counted, *voted}):
            rows = voted.get(key, none)
            votes = places[rows], winners[rows], weights[rows]
            joined[CellKey(key)] = self._of_cell(counted.get(CellKey(key), nothing), *votes, channel)
        return joined

    def _of_cell(self, counted: Evidence, places: Words32, winners: Ints, weights: Ints, channel: Channel) -> Evidence:
        """Evidence of one cell with its votes, several for a voxel where several cameras saw it; places rise."""
        # Stage 1: voxels; votes are for what was hit, so of cubes none is new.
        voxels, counts, before = counted.voxels, counted.counts, counted.sampled.astype(np.int64)
        rows = np.searchsorted(voxels, places)
        if not np.array_equal(voxels[np.minimum(rows, len(voxels) - 1)] if len(voxels) else voxels, places):
            voxels = np.union1d(counted.voxels, places)
            row_of, rows = np.searchsorted(voxels, counted.voxels), np.searchsorted(voxels, places)
            counts, before = np.zeros((len(voxels), 2), np.int32), row_of[before]
            counts[row_of] = counted.counts
        # Stage 2: rows of samples, those of other channels and those of votes.
        is_first = np.diff(rows, prepend=-1) > 0
        sampled, at = rows[is_first], np.cumsum(is_first) - 1
        if len(before):
            sampled = np.union1d(sampled, before)
            at = np.searchsorted(sampled, rows)
        samples = np.zeros((len(sampled), self.geometry.plane_count), np.int64)
        planes = self.geometry.planes_of(channel.name)
        if len(before):
            others = np.delete(np.arange(self.geometry.plane_count), planes)
            samples[np.searchsorted(sampled, before)[:, None], others] = counted.samples
        # Stage 3: votes. The last class has no plane of its own: it is the rest of the weight.
        add_votes_into(samples[:, planes], at, winners, weights)
        return Evidence(voxels, counts, sampled.astype(np.uint32), samples)


def _channel_of(geometry: Geometry) -> Channel | None:
    return next((channel for channel in geometry.channels if channel.kind is ChannelKind.CLASSES), None)


def _grown(array: npt.NDArray[Item], needed: int, used: int) -> npt.NDArray[Item]:
    """The array with room for `needed` entries, at least doubled, of which the first `used` are kept."""
    if needed <= len(array):
        return array
    grown = np.empty((max(needed, 2 * len(array)), *array.shape[1:]), array.dtype)
    grown[:used] = array[:used]
    return grown
