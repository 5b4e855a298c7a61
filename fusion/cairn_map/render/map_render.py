"""Rendering of a map for a camera: the node that each pixel sees, its range, and its readings.

    renderer = MapRenderer(threads=2)
    seen = renderer.nearest(snapshot, sight, T_map_camera, range_max_m=20)
    seen.range_m                                     (H, W) metres along each ray, NaN where nothing is
    renderer.temperature(snapshot, seen)             (H, W) kelvin, NaN where no temperature is known

Each pixel is that of its ray, so any lens will do, and the result is the same with any number of threads. The readings
of a cell's nodes are computed once, when the first pixel needs them, and kept until the cell changes.
"""

import math
from collections.abc import Callable, Hashable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from cairn_map.arrays import Floats
from cairn_map.errors import BadInputError
from cairn_map.evidence.brick_cell import BrickCell
from cairn_map.evidence.brick_counts import BrickNumbers
from cairn_map.evidence.channels import Channel, ChannelKind
from cairn_map.evidence.compact_cell import HeldCell, has_sums, opened, sums_of
from cairn_map.evidence.grid import CellKey, check_cubes
from cairn_map.queries.frozen_map import FrozenMap
from cairn_map.queries.map_snapshot import MapSnapshot
from cairn_map.queries.point_kernels import group_into
from cairn_map.queries.point_queries import first_of_kind
from cairn_map.render import render_kernels as kernels
from cairn_map.render.camera_rays import CameraRays, checked_pose
from cairn_map.render.node_tables import Table, drawn_in_colours, mean_table, probability_table
from cairn_map.render.render_kernels import read_nodes_into

Values = npt.NDArray[np.float32]
Changes = Mapping[CellKey, Floats]
"""By cell: time of the last change of each 4^3 block, (8^(depth - 2),) in Morton order; NaN where that is unknown."""
ROWS_MIN = 8
"""Rows of a thread's share of an image, at least."""


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceImage:
    """Image of the surfaces that a camera sees: for each pixel an occupied node of the map, or nothing."""

    sight: CameraRays
    range_m: Values
    """(H, W) metres along the pixel's ray to where it enters the node; NaN where it sees nothing."""
    slots: npt.NDArray[np.int32]
    """(H, W) index of the node's cell in the snapshot, -1 for none."""
    places: npt.NDArray[np.uint32]
    """(H, W) Morton code inside the cell of the voxel that the ray enters first."""
    nodes: npt.NDArray[np.uint8]
    """(H, W) n of the node's 2^n voxels along an edge: above 0 only where a voxel is smaller than a pixel."""

    @property
    def hit(self) -> npt.NDArray[np.bool_]:
        """(H, W) True where the pixel sees a node."""
        return np.asarray(self.slots >= 0)

    @property
    def depth_m(self) -> Values:
        """(H, W) metres along the camera's axis."""
        depth: Values = self.range_m * self.sight.rays[..., 2].astype(np.float32)
        return depth


@dataclass(slots=True, eq=False)
class CellTables:
    """Tables of the readings of one cell's nodes; valid while the cell's sums are these objects."""

    sums: tuple[object, ...]
    brick_of: BrickNumbers
    """Row of a table by a brick's Morton number."""
    tables: dict[Hashable, Table] = field(default_factory=dict)
    """By what they show: a sensor model, or a channel."""


class MapRenderer:
    """Renderer of a map from any pose; it keeps its tables between frames. For one thread at a time."""

    def __init__(self, *, threads: int = 1, on_share: Callable[[], None] = lambda: None) -> None:
        """Use `threads` threads; `on_share` is called before each share of the work, and may raise to end it."""
        self._threads = max(1, threads)
        self._on_share = on_share
        self._skips: tuple[object, npt.NDArray[np.uint8]] | None = None
        self.kept: dict[CellKey, CellTables] = {}
        """Tables by cell; a caller that has some already may put them here."""

    def nearest(
        self,
        snapshot: MapSnapshot,
        sight: CameraRays,
        T_map_camera: npt.ArrayLike,
        *,
        range_max_m: float,
        between_m: tuple[Values, Values] | None = None,
    ) -> SurfaceImage:
        """The first occupied node along each ray.

        Args:
            snapshot: the map.
            sight: the camera.
            T_map_camera: (4, 4) rigid.
            range_max_m: no ray goes farther.
            between_m: two of (H, W) metres, the ranges at which each ray begins and ends; NaN for rays that see
                nothing. None: all begin at the camera.

        Raises:
            BadInputError: kinds `bad_pose`, `bad_range`, `bad_camera`: `between_m` of another size.
        """
        return self._seen(snapshot.frozen, sight, T_map_camera, range_max_m, between_m, is_beyond=False)

    def beyond(
        self,
        snapshot: MapSnapshot,
        sight: CameraRays,
        T_map_camera: npt.ArrayLike,
        *,
        range_max_m: float,
        between_m: tuple[Values, Values],
    ) -> SurfaceImage:
        """The first occupied node behind the surfaces where the rays begin.

        Each ray goes on through the surface until it comes out into a voxel that is known to be free, and sees what it
        meets from there on. So a wall's other side is not taken for a thing behind the wall, and where the space
        behind a surface was never seen, nothing is shown.

        Arguments and errors as of `nearest`.
        """
        return self._seen(snapshot.frozen, sight, T_map_camera, range_max_m, between_m, is_beyond=True)

    def probability(self, snapshot: MapSnapshot, seen: SurfaceImage) -> Values:
        """(H, W) probability of occupancy of the node's likeliest voxel; NaN where nothing is seen."""
        model = snapshot.model
        return self._read(snapshot, seen, model, 1, lambda key, cell: probability_table(cell, model))[..., 0]

    def temperature(self, snapshot: MapSnapshot, seen: SurfaceImage) -> Values:
        """(H, W) kelvin, of the map's first temperature channel; NaN where no temperature is known."""
        return self._mean(snapshot, seen, first_of_kind(snapshot.geometry, ChannelKind.TEMPERATURE), 1)[..., 0]

    def colour(self, snapshot: MapSnapshot, seen: SurfaceImage) -> Values:
        """(H, W, 3) sRGB 0 to 255, of the map's first colour channel, else of its classes; NaN where none is known."""
        return self._mean(snapshot, seen, drawn_in_colours(snapshot.geometry), 3)

    def changed(self, snapshot: MapSnapshot, seen: SurfaceImage, changes: Changes) -> Floats:
        """(H, W) time of the node's last change, in the unit of `changes`; NaN where that is unknown."""
        return changed_at(snapshot.frozen.keys, seen, changes)

    def _mean(self, snapshot: MapSnapshot, seen: SurfaceImage, channel: Channel, planes: int) -> Values:
        # The channel is the key of its table.
        geometry = snapshot.geometry
        return self._read(
            snapshot,
            seen,
            channel,
            planes,
            lambda key, cell: mean_table(cell, channel, geometry),
        )

    def _seen(
        self,
        frozen: FrozenMap,
        sight: CameraRays,
        T_map_camera: npt.ArrayLike,
        range_max_m: float,
        between_m: tuple[Values, Values] | None,
        *,
        is_beyond: bool,
    ) -> SurfaceImage:
        # Check, and convert to what the kernel takes: lengths in voxel edges, float32.
        # Rays step by one edge along all three axes.
        check_cubes(frozen.geometry)
        T = checked_pose(T_map_camera, reach_m=frozen.reach_m)
        H, W, edge_m = sight.height, sight.width, frozen.geometry.voxel_edge_m
        if not 0 < range_max_m < np.inf:
            raise BadInputError("bad_range", f"the range must be above 0 and finite, metres; got {range_max_m}")
        reach_m = np.full((H, W), range_max_m, np.float32)
        starts, ends = (np.zeros_like(reach_m), reach_m) if between_m is None else between_m
        if starts.shape != (H, W) or ends.shape != (H, W):
            raise BadInputError("bad_camera", f"between_m must be two of ({H}, {W}), as the camera's image is")
        starts = np.asarray(np.maximum(starts, 0) / edge_m, np.float32)
        ends = np.asarray(np.minimum(ends, reach_m) / edge_m, np.float32)
        # Walk all rays; each thread writes rows of its own.
        skips = self._skips_of(frozen)
        seen = SurfaceImage(
            sight,
            np.empty((H, W), np.float32),
            np.empty((H, W), np.int32),
            np.empty((H, W), np.uint32),
            np.empty((H, W), np.uint8),
        )

        def look(rows: slice) -> None:
            kernels.see_into(
                frozen.grid,
                skips,
                T,
                sight.rays[rows].reshape(-1, 3),
                math.sqrt(2) * sight.pixel_rad,  # the diagonal: a ball as wide holds the middle of a pixel
                starts[rows].reshape(-1),
                ends[rows].reshape(-1),
                is_beyond,
                seen.range_m[rows].reshape(-1),
                seen.slots[rows].reshape(-1),
                seen.places[rows].reshape(-1),
                seen.nodes[rows].reshape(-1),
            )

        self._by_rows(H, look)
        # Voxel edges to metres, in place.
        np.multiply(seen.range_m, np.float32(edge_m), out=seen.range_m)
        return seen

    def _read(
        self,
        snapshot: MapSnapshot,
        seen: SurfaceImage,
        name: Hashable,
        planes: int,
        make: Callable[[CellKey, BrickCell], Table],
    ) -> Values:
        # Tables of the cells in sight; slot -1, nothing, is the first bin.
        frozen = snapshot.frozen
        # Cells that no pixel sees need no table: most of a map is never read.
        slots = np.flatnonzero(np.bincount(seen.slots.reshape(-1) + 1, minlength=1 + len(frozen.cells))[1:])
        tables = {slot: self._table(frozen.keys[slot], frozen.cells[slot], name, make) for slot in slots.tolist()}
        out = np.full((seen.sight.height, seen.sight.width, planes), np.nan, np.float32)

        # Then cell by cell, so that a cell's table stays in the processor's cache.
        def read(rows: slice) -> None:
            flat = seen.slots[rows].reshape(-1)
            starts, order = np.empty(len(frozen.cells) + 1, np.int64), np.empty(len(flat), np.int32)
            group_into(flat, starts, order)
            for slot, kept in tables.items():
                read_nodes_into(
                    order[starts[slot] : starts[slot + 1]],
                    seen.places[rows].reshape(-1),
                    seen.nodes[rows].reshape(-1),
                    kept.brick_of,
                    kept.tables[name],
                    out[rows].reshape(-1, planes),
                )

        self._by_rows(seen.sight.height, read)
        return out

    def _table(
        self, key: CellKey, cell: HeldCell, name: Hashable, make: Callable[[CellKey, BrickCell], Table]
    ) -> CellTables:
        """A cell's tables, this one among them, kept until the cell's sums are other objects."""
        # Merging into a frozen cell copies its sums first, so the same object means the same sums.
        kept = self.kept.get(key)
        if kept is not None and name in kept.tables and has_sums(cell, kept.sums):
            return kept
        sums = opened(cell)
        if kept is None or not has_sums(cell, kept.sums):
            kept = self.kept[key] = CellTables(sums_of(cell), sums.counts.brick_of)
        kept.tables[name] = make(key, sums)
        return kept

    def _skips_of(self, frozen: FrozenMap) -> npt.NDArray[np.uint8]:
        # A new snapshot of a changed map has new words; tables of cells that are gone go with the old ones.
        if self._skips is None or self._skips[0] is not frozen.grid.words:
            skips = np.empty(frozen.grid.bricks.shape, np.uint8)
            kernels.skips_into(frozen.grid, skips)
            self._skips = frozen.grid.words, skips
            here = set(frozen.keys)
            self.kept = {key: kept for key, kept in self.kept.items() if key in here}
        return self._skips[1]

    def _by_rows(self, height: int, work: Callable[[slice], None]) -> None:
        """Do the work on shares of an image's rows, in all threads."""
        # Four shares a thread: rows differ in cost, and the last share must not be waited for long.
        step = max(ROWS_MIN, -(-height // (4 * self._threads)))
        shares = [slice(start, min(start + step, height)) for start in range(0, height, step)]

        def do(share: slice) -> None:
            self._on_share()
            work(share)

        # One thread needs no pool.
        if self._threads == 1:
            for share in shares:
                do(share)
            return
        # Kernels release Python's lock, and each share writes rows of its own.
        with ThreadPoolExecutor(self._threads) as pool:
            list(pool.map(do, shares))


def changed_at(keys: Sequence[CellKey], seen: SurfaceImage, changes: Changes) -> Floats:
    """(H, W) time of the last change of what is seen, in the unit of `changes`; `keys`: of the cells, by slot."""
    # Cell by cell, because changes are held by cell.
    H, W = seen.slots.shape
    found, flat = np.full(H * W, np.nan), seen.slots.reshape(-1)
    places, nodes = seen.places.reshape(-1), seen.nodes.reshape(-1)
    for slot, key in enumerate(keys):
        if key in changes and len(rows := np.flatnonzero(flat == slot)):
            # A place is a Morton code: without its lowest 6 bits the block, without 9 the brick.
            blocks, brick = places[rows] >> np.uint32(6), changes[key].reshape(-1, 8)
            is_brick = nodes[rows] == kernels.NODE_DEPTH  # the only node that is larger than a block
            newest = np.fmax.reduce(brick[blocks >> np.uint32(3)], axis=1)
            found[rows] = np.where(is_brick, newest, changes[key][blocks])
    return found.reshape(H, W)
