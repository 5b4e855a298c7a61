"""Integration of scans into evidence: the paper's chapter IV, from images to voxels.

    returns  points of the map, and the clear length of each beam    Eq. 1-5    `beam_returns`
    samples  colour and temperature of these points                  Eq. 5-6    `samples`
    votes    classes of label images, one vote for each voxel and camera         `class_votes`
    counts   hits where beams ended, misses where the image looks through       `free_space`, `brick_tally`
             for lidars, ray by ray                                             `ray_casting`
             in a level layer: a vote for each column and surface               `level.votes`
    pack     evidence by cell

Inverse sensor model: one count per voxel and scan, and a hit wins over a miss. The result depends on the scans alone,
never on the map, nor on the order or the threads in which scans are added.
"""

import math
import os
import re
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from enum import StrEnum
from threading import Lock
from typing import Any

import numpy as np
import numpy.typing as npt

from cairn_calib.rig.poses import Transform, check_transform, inverse, transform_points
from cairn_calib.rig.rig import LIDAR, LIDAR_REACH_M, TIME_OF_FLIGHT_REACH_M, MountedCamera, Rig
from cairn_fusion.mapping.beam_returns import ReturnCounts, Returns, clear_image, returns_of
from cairn_fusion.mapping.brick_tally import Each, TallyPool
from cairn_fusion.mapping.class_votes import ClassVotes, classes_of_labels, without_classes
from cairn_fusion.mapping.free_space import Window, carving_of, window_of
from cairn_fusion.mapping.level.votes import votes_of
from cairn_fusion.mapping.ray_casting import beam_evidence, carried, clear_ends, silent_ends
from cairn_fusion.mapping.samples import ImageTransfers, SampleLimits, Sampling
from cairn_fusion.recording.scan import Scan, check_scan
from cairn_fusion.transfer.transfer import DEPTH_TOLERANCE_M
from cairn_map.arrays import Floats
from cairn_map.errors import BadInputError
from cairn_map.evidence.channels import ChannelKind
from cairn_map.evidence.evidence import Evidence, packed_evidence
from cairn_map.evidence.grid import CellKey, Geometry, split_voxels, voxels_of_points

FIELD = re.compile(r"(\w+)=(\S+)")
"""Number of an integrator, as its text states it."""


class Method(StrEnum):
    """Method of finding free space."""

    CARVE = "carve"
    """Projective, where the camera's image fits in a plane; else as `CAST`."""
    CAST = "cast"
    """Ray by ray: for lidars, and as the slow twin."""


@dataclass(frozen=True, slots=True)
class Integrator:
    """Parameters of the integration of scans; their text goes into every commit."""

    min_range_m: float = 0.1
    """Least range of a return, metres; nearer ones are ignored."""
    max_range_m: float | None = None
    """Greatest range of a return, metres. A farther one is ignored, and is no proof of free space. None: that of a
    usual sensor of its kind (`rig.TIME_OF_FLIGHT_REACH_M`, `rig.LIDAR_REACH_M`)."""
    method: Method = Method.CARVE
    flying_step_m: float = 0.05
    """Difference from both neighbours, metres, beyond which a pixel of a carved image is a mixture of them
    (`flying_kernels`) and no return. Infinite: no pixel is."""
    noise_sigmas: float = 2.0
    """Margin of free space before a surface, in standard deviations of the range (the rig's `sensing`); at least one
    voxel."""
    sample_spread_voxels: float = 1.0
    """Largest uncertainty of a sample's place, voxels (`pixel_covariance`); beyond it the sample is left out."""
    temperature_step_k: float = 4.0
    """Largest difference of the thermal image within the area of a range pixel, kelvin; beyond it there is no
    temperature, for it could be the background's, or a hot thing's on the background. Infinite: no limit."""
    hidden_behind_m: float = DEPTH_TOLERANCE_M
    """Depth behind the nearest point of a bin beyond which a point is hidden, metres (`transfer`). Infinite: never."""

    def __post_init__(self) -> None:
        farthest_m = TIME_OF_FLIGHT_REACH_M if self.max_range_m is None else self.max_range_m
        if not 0 <= self.min_range_m < farthest_m < float("inf"):
            raise BadInputError(
                "bad_range", f"0 <= min_range_m < max_range_m must hold, got {self.min_range_m}, {farthest_m}"
            )
        if not self.flying_step_m > 0:
            raise BadInputError("bad_range", f"flying_step_m must be above 0, got {self.flying_step_m}")
        if not 0 <= self.noise_sigmas < float("inf"):
            raise BadInputError("bad_range", f"noise_sigmas must be finite, from 0, got {self.noise_sigmas}")
        if not self.sample_spread_voxels > 0:
            raise BadInputError("bad_range", f"sample_spread_voxels must be above 0, got {self.sample_spread_voxels}")
        for name in ("temperature_step_k", "hidden_behind_m"):
            if not getattr(self, name) > 0:
                raise BadInputError("bad_range", f"{name} must be above 0, got {getattr(self, name)}")

    def __str__(self) -> str:
        # The text goes into every commit, so that evidence can be found by how it was made; 6 is the version of the
        # integrator.
        farthest = "usual" if self.max_range_m is None else f"{self.max_range_m:g}"
        limits = f"min_range_m={self.min_range_m:g} max_range_m={farthest}"
        surfaces = f"flying_step_m={self.flying_step_m:g} noise_sigmas={self.noise_sigmas:g}"
        samples = f"sample_spread_voxels={self.sample_spread_voxels:g} temperature_step_k={self.temperature_step_k:g}"
        samples += f" hidden_behind_m={self.hidden_behind_m:g}"
        return f"cairn-{self.method} 6 {limits} {surfaces} {samples}"

    def reach_m(self, mounted: MountedCamera) -> float:
        """Greatest range of a return of this range camera, metres."""
        return mounted.usual_reach_m if self.max_range_m is None else self.max_range_m


def integrator_from_text(text: str) -> Integrator | None:
    """The integrator that a commit states, its numbers to six digits; None if it states none."""
    stated = dict(FIELD.findall(text))
    values: dict[str, Any] = {}
    try:
        values["method"] = Method(text.partition(" ")[0].removeprefix("cairn-"))
        for one in fields(Integrator):
            if stated.get(one.name, "usual") != "usual":
                values[one.name] = float(stated[one.name])
        return Integrator(**values)
    except (ValueError, BadInputError):
        return None


class Integration:
    """Evidence of scans that any number of threads add; they take turns only to count. Memory: see `brick_tally`."""

    def __init__(self, rig: Rig, geometry: Geometry, integrator: Integrator, *, around_m: Floats | None = None) -> None:
        """Args: around_m: (3,) centre of the first tally, metres; None: the place of the first scan."""
        self._rig = rig
        # Classes come with the votes alone: their planes would be carried through every sum.
        self._geometry = without_classes(geometry)
        self._integrator = integrator
        # Room for images; sweeps of lidars are counted ray by ray, without a tally.
        reach_m = TIME_OF_FLIGHT_REACH_M if integrator.max_range_m is None else integrator.max_range_m
        self._tallies = TallyPool(self._geometry, max_range_m=reach_m, around_m=around_m)
        self._votes = ClassVotes(geometry)
        # A sample whose place is less certain than this could be another voxel's.
        spread_m = integrator.sample_spread_voxels * geometry.voxel_edge_m
        limits = SampleLimits(spread_m, integrator.temperature_step_k, integrator.hidden_behind_m)
        self._sampling = Sampling(rig, geometry, limits)
        self._lock = Lock()
        self.counts = ReturnCounts()
        """Count of the pixels of all scans, by what became of them."""

    def add(self, scan: Scan) -> None:
        """Add a scan.

        Raises:
            BadInputError: an image does not fit its camera, the scan names a channel that the map lacks, or reaches
                beyond the numbered space; nothing was added.
        """
        if scan.points_m is not None:
            self._add_sweep(scan, scan.points_m)
            return
        limits, rig, camera = self._integrator, self._rig, self._rig[scan.range_camera].camera
        # A camera with an image plane is carved through it; a lidar, or method CAST, goes ray by ray.
        window = window_of(camera) if limits.method is Method.CARVE else None  # pyright: ignore[reportArgumentType]
        # Stage 1: points (Eq. 1-5). A lidar's neighbours are too far apart to tell a flying pixel.
        returns = returns_of(
            scan,
            rig,
            min_range_m=limits.min_range_m,
            max_range_m=limits.max_range_m,
            flying_step_m=limits.flying_step_m if window is not None else math.inf,
        )
        # Stage 2: named readings and labels, checked before anything is counted.
        scalars, classes = _scalar_evidence(scan, self._geometry), classes_of_labels(scan, self._votes.geometry)
        # Stage 3: hits, samples and misses.
        sight = ImageTransfers(scan, returns, self._sampling)
        if self._geometry.is_flat:
            self._tallies.merge(votes_of(returns.T_map_tof[:3, 3], returns.points_map, self._geometry))
        elif window is None:
            self._cast(scan, returns, sight)
        elif returns.reach_m > 0:
            self._carve(scan, returns, window, sight)
        self._tallies.merge(scalars)
        # Stage 4: one vote for a class wherever a labelled pixel shows a voxel that was hit.
        self._votes.add(classes, scan, rig, returns, sight)
        with self._lock:
            self.counts += returns.counts

    def add_points(
        self,
        points: npt.NDArray[np.floating],
        T_map_sensor: Transform,
        *,
        range_camera: str | None = None,
        T_map_body: Transform | None = None,
    ) -> None:
        """Add a sweep of points without order, ray by ray.

        Args:
            points: (N, 3) metres, sensor frame, all seen from its origin; NaN where nothing came back.
            T_map_sensor: pose of the sensor.
            range_camera: the rig's camera whose driver made the points of its ranges, in its own frame; they have its
                noise, and the rig's `range_bias` at the usual amplitude is subtracted. None: another sensor, with a
                lidar's usual noise; points are taken as they are.
            T_map_body: pose of the frame of the rig's body; None: no point is taken for the robot's body.

        Raises:
            BadInputError: not (N, 3), or it reaches beyond the numbered space, or points that the range camera cannot
                have seen while its rig states a bias; nothing was added.
        """
        if points.ndim != 2 or points.shape[1] != 3:
            raise BadInputError("bad_points", f"points must be (N, 3), got {points.shape}")
        T = check_transform(T_map_sensor, name="T_map_sensor")
        of = None if range_camera is None else self._rig[range_camera]
        # Points without a bias, within limits, and not on the robot itself; NaN is outside all limits.
        own = (points if of is None else of.true_points(points)).astype(np.float64)
        range_m = np.linalg.norm(own, axis=1)
        void, near = ~(range_m > 0), range_m < self._integrator.min_range_m
        farthest_m = LIDAR_REACH_M if self._integrator.max_range_m is None else self._integrator.max_range_m
        if of is not None:
            farthest_m = self._integrator.reach_m(of)
        far = range_m > farthest_m
        kept = ~(void | near | far)
        limited = int(np.count_nonzero(kept))
        if self._rig.body is not None and T_map_body is not None:
            T_body_sensor = inverse(check_transform(T_map_body, name="T_map_body")) @ T
            kept &= ~self._rig.body.holds(transform_points(T_body_sensor, own))
        points_map = carried(own[kept], T)
        if self._geometry.is_flat:
            self._tallies.merge(votes_of(T[:3, 3], points_map, self._geometry))
        else:
            # Clear up to a margin before each point, by its noise.
            sigma_m = LIDAR.sigma_at(range_m[kept], usual=LIDAR) if of is None else of.range_sigma_m(range_m[kept])
            clear_m = self._clear_ends(T[:3, 3], points_map, sigma_m)
            self._tallies.merge(beam_evidence(T[:3, 3], points_map, clear_m, self._geometry, sums_of=None))
        counts = ReturnCounts(
            used=len(points_map),
            no_return=int(np.count_nonzero(void)),
            too_near=int(np.count_nonzero(near & ~void)),
            too_far=int(np.count_nonzero(far)),
            own_body=limited - len(points_map),
        )
        with self._lock:
            self.counts += counts

    def diff(self, each: Each = map) -> dict[CellKey, Evidence]:
        """The evidence of all scans, by cell; `each` as for `Tally.packed`. Not while scans are being added."""
        return self._votes.joined(self._tallies.packed(each))

    def _add_sweep(self, scan: Scan, points: npt.NDArray[np.float32]) -> None:
        """Add a scan whose points have no raster, ray by ray."""
        check_scan(scan, self._rig)
        scalars = _scalar_evidence(scan, self._geometry)
        body = scan.T_map_rig if scan.T_map_body is None else scan.T_map_body
        T_map_sensor = scan.T_map_rig @ self._rig[scan.range_camera].transform
        self.add_points(points, T_map_sensor, range_camera=scan.range_camera, T_map_body=body)
        self._tallies.merge(scalars)

    def _carve(self, scan: Scan, returns: Returns, window: Window, sight: ImageTransfers) -> None:
        """Count hits where beams ended, misses where the image looks through."""
        edge_m = self._geometry.voxel_edge_m
        mounted, sigmas = self._rig[scan.range_camera], self._integrator.noise_sigmas
        # How far each pixel is certainly clear: its own range less a margin, and its neighbours' on slanted surfaces.
        clear_m = clear_image(returns, mounted, voxel_edge_m=edge_m, noise_sigmas=sigmas)
        # Hits are numbered once; samples and misses use the numbers.
        with self._tallies.around(returns.T_map_tof[:3, 3], returns.reach_m) as (tally, hits):
            # Each voxel that was hit has one number within this scan, however many beams ended in it.
            voxel_of, count = hits.number(returns.points_map, tally)
            sums = sight.sums(voxel_of, count)
            # Voxels that the image looks through: culled by bricks, then voxel by voxel.
            carving = carving_of(
                window.shown(clear_m),
                window,
                returns.T_map_tof,
                corner=tally.corner,
                dims=tally.dims,
                voxel_edge_m=edge_m,
                min_range_m=self._integrator.min_range_m,
                scratch=hits.scratch,
            )
            # Hit before miss: a voxel that was hit is not counted as seen through by the same scan.
            tally.add_hits(hits, sums)
            tally.add_misses(hits, carving)

    def _cast(self, scan: Scan, returns: Returns, sight: ImageTransfers) -> None:
        """Count hits where beams ended, misses along each beam."""
        mounted, origin_m = self._rig[scan.range_camera], returns.T_map_tof[:3, 3]
        # Beams that returned end a margin before their point; beams without a return are clear as far as the sensor
        # says.
        sigma_m = mounted.range_sigma_image(returns.range_m).ravel()[returns.pixels]
        clear_m = np.concatenate(
            [self._clear_ends(origin_m, returns.points_map, sigma_m), silent_ends(returns, mounted.camera.rays())]
        )
        self._tallies.merge(beam_evidence(origin_m, returns.points_map, clear_m, self._geometry, sums_of=sight.sums))

    def _clear_ends(self, origin_m: Floats, points_map: Floats, sigma_m: Floats) -> Floats:
        edge_m, sigmas = self._geometry.voxel_edge_m, self._integrator.noise_sigmas
        return clear_ends(origin_m, points_map, sigma_m, voxel_edge_m=edge_m, noise_sigmas=sigmas)


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
    # Threads share nothing but the tally, and integers commute: any number of them gives the same bits.
    count = max(1, min(threads or os.cpu_count() or 1, len(scans)))
    around_m = scans[0].T_map_rig[:3, 3] if scans else None
    integration = Integration(rig, geometry, integrator, around_m=around_m)
    with ThreadPoolExecutor(count) as pool:
        # A free thread takes the next scan.
        list(pool.map(integration.add, scans))
        return integration.diff(pool.map)


def _scalar_evidence(scan: Scan, geometry: Geometry) -> dict[CellKey, Evidence]:
    """Evidence of named readings, in the voxel of the rig's origin."""
    if not scan.scalars:
        return {}
    samples = np.zeros((1, geometry.plane_count), np.int64)
    for name, value in scan.scalars.items():
        # A reading without a channel of the map is refused before anything is counted.
        channel = geometry.channel(name)
        if channel is None or channel.kind is not ChannelKind.SCALAR:
            raise BadInputError("unknown_channel", f"the map has no scalar channel {name!r}; create it with one")
        samples[0, geometry.planes_of(name)] = [int(channel.quantise(np.array([value]))[0]), 1]
    cells, places = split_voxels(voxels_of_points(scan.T_map_rig[:3, 3], geometry), geometry)
    return {CellKey(int(cells[0])): packed_evidence(places, np.zeros((1, 2), np.int32), samples, geometry)}
