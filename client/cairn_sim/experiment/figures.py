"""Figures of the experiment, number by number: the content of `report.json` and the source of the pages.

RunFigures > ResolutionFigures > MeasurementFigures      one commit
                               > CellFigures > CodedCell  one cell, written in one of the `codings`
                               > TruthFigures             the map against the simulated truth
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from statistics import median

import numpy as np

from cairn_map.evidence.grid import BRICK_DEPTH, DEPTH_MAX, Geometry, geometry_for
from cairn_sim.evaluation.scores import Scores

PAPER_CELL_UM = 5_120_000
"""Edge of the paper's cells at every resolution, micrometres."""
PAPER_VOXEL_BYTES = 8
"""Bytes of a voxel in the paper's uncompressed cube: 16 MB for 128^3 voxels (Table 3)."""
Json = dict[str, object]


def paper_geometry(voxel_edge_m: float) -> Geometry:
    """Geometry with the paper's cells: 256^3 voxels at 2 cm, where the standard ones of this size are of 128^3.

    Raises:
        BadInputError: the voxel edge is not 1 mm to 1 m.
    """
    geometry = geometry_for(voxel_edge_m=voxel_edge_m)
    depth = min(DEPTH_MAX, max(BRICK_DEPTH, (PAPER_CELL_UM // geometry.voxel_edge_um).bit_length() - 1))
    return Geometry(voxel_edge_um=geometry.voxel_edge_um, depth=depth)


@dataclass(frozen=True, slots=True, kw_only=True)
class MeasurementFigures:
    """One stop of a robot, and the commit that it became. Times are of the wall clock unless they say CPU."""

    robot: str
    stop: int
    scans: int
    rays: int
    """Pixels with a range inside the integrator's limits."""
    integrate_s: float
    integrate_cpu_s: float
    """CPU seconds of all threads together."""
    commit_s: float
    """Encoding the evidence into a commit."""
    merge_s: float
    """Adding it to the map."""
    commit_bytes: int
    cells: int
    voxels: int


@dataclass(frozen=True, slots=True, kw_only=True)
class CodedCell:
    """One cell in one coding; CPU time of one thread."""

    size_bytes: int
    encode_s: float
    decode_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class CellFigures:
    """One cell of the finished map."""

    cell: str
    """`i,j,k`"""
    known: int
    """Voxels that were seen at all."""
    occupied: int
    pack_s: float
    """From the bricks in memory to the packed rows that codings read; CPU."""
    unpack_s: float
    """And back."""
    coded: Mapping[str, CodedCell]
    """By the coding's name."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TruthFigures:
    """The map against the truth."""

    cells: int
    """Compared; evenly chosen where that is not all."""
    poses: int
    """Poses of the range camera from which the truth was computed."""
    scores: Scores


@dataclass(frozen=True, slots=True, kw_only=True)
class CodingTotals:
    """A coding over all cells of one resolution: Table 3's numbers."""

    mean_cell_bytes: float
    map_bytes: int
    ratio: float
    """Uncompressed map over compressed map."""
    bits_per_occupied: float | None
    """Bits of the compressed map for each occupied voxel; None without any. Empty cells raise a ratio, not this."""
    encode_median_s: float
    decode_median_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class ResolutionFigures:
    """Everything about the map with one voxel edge."""

    voxel_edge_m: float
    side: int
    """Voxels along a cell's edge."""
    map_memory_bytes: int
    """Bytes of the map's bricks in memory."""
    measurements: Sequence[MeasurementFigures]
    cells: Sequence[CellFigures]
    truth: TruthFigures | None

    @property
    def title(self) -> str:
        """The voxel edge for people: `4 cm`."""
        return f"{self.voxel_edge_m * 100:g} cm"

    @property
    def cube_bytes(self) -> int:
        """A cell as a dense array of the paper's 8 B."""
        return PAPER_VOXEL_BYTES * self.side**3

    @property
    def uncompressed_bytes(self) -> int:
        """All non-empty cells as such arrays."""
        return self.cube_bytes * len(self.cells)

    @property
    def cells_with_obstacles(self) -> int:
        """Cells that hold at least one occupied voxel."""
        return sum(cell.occupied > 0 for cell in self.cells)

    @property
    def coding_names(self) -> list[str]:
        """In the order of `CODINGS`."""
        return list(self.cells[0].coded) if self.cells else []

    def filled(self, which: str) -> list[float]:
        """Share of each cell's voxels that are `occupied` or `known`, 0 to 1."""
        return [getattr(cell, which) / self.side**3 for cell in self.cells]

    def totals(self, coding: str) -> CodingTotals:
        """A coding's share of Table 3."""
        coded = [cell.coded[coding] for cell in self.cells]
        map_bytes = sum(one.size_bytes for one in coded)
        occupied = sum(cell.occupied for cell in self.cells)
        return CodingTotals(
            mean_cell_bytes=map_bytes / len(coded),
            map_bytes=map_bytes,
            ratio=self.uncompressed_bytes / map_bytes,
            bits_per_occupied=8 * map_bytes / occupied if occupied else None,
            encode_median_s=median(one.encode_s for one in coded),
            decode_median_s=median(one.decode_s for one in coded),
        )

    def rates(self) -> dict[str, float]:
        """Speed of turning images into evidence, over all measurements."""
        seconds = sum(one.integrate_s for one in self.measurements)
        cpu_s = sum(one.integrate_cpu_s for one in self.measurements)
        scans, rays = (sum(getattr(one, name) for one in self.measurements) for name in ("scans", "rays"))
        return {
            "images_per_s": scans / seconds,
            "rays_per_s": rays / seconds,
            "rays_per_cpu_s": rays / cpu_s,
            "measurement_median_s": median(one.integrate_s for one in self.measurements),
            "measurement_median_cpu_s": median(one.integrate_cpu_s for one in self.measurements),
            "commit_median_s": median(one.commit_s for one in self.measurements),
            "merge_median_s": median(one.merge_s for one in self.measurements),
        }

    def to_json(self) -> Json:
        """All of it, and what is derived from it."""
        return {
            **asdict(self),
            "truth": None if self.truth is None else {**asdict(self.truth), "ratios": ratios(self.truth.scores)},
            "derived": {
                "nonempty_cells": len(self.cells),
                "cells_with_obstacles": self.cells_with_obstacles,
                "uncompressed_cube_bytes": self.cube_bytes,
                "uncompressed_map_bytes": self.uncompressed_bytes,
                "codings": {name: asdict(self.totals(name)) for name in self.coding_names},
                "filled_occupied": quartiles(self.filled("occupied")),
                "filled_known": quartiles(self.filled("known")),
                "commit_bytes": quartiles([float(one.commit_bytes) for one in self.measurements]),
                **self.rates(),
            },
        }


@dataclass(slots=True, kw_only=True)
class RunFigures:
    """The whole run; `resolutions` grows as they are finished."""

    about: Json
    """Parameters, versions, machine."""
    asked: Sequence[str]
    """Resolutions that were asked for: a run may have been interrupted."""
    resolutions: list[ResolutionFigures] = field(default_factory=list)

    def to_json(self) -> Json:
        """The document `report.json`."""
        return {
            "format": "cairn-experiment",
            "version": 1,
            "about": self.about,
            "asked": list(self.asked),
            "resolutions": [one.to_json() for one in self.resolutions],
        }


def ratios(scores: Scores) -> dict[str, float | None]:
    """The ratios of scores, 0 to 1; None for 0 of 0."""
    names = ("recall", "carved", "unknown", "precision", "false_free", "false_free_half", "recall_free")
    values = {name: float(getattr(scores, name)) for name in names}
    return {name: None if np.isnan(value) else value for name, value in values.items()}


def quartiles(values: Sequence[float]) -> list[float]:
    """Least, lower quartile, median, upper quartile, largest."""
    return [float(value) for value in np.percentile(values, [0, 25, 50, 75, 100])]
