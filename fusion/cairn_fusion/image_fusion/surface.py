"""Surface of a scan's range image, and its image in the rig's other cameras.

    range image --labels, steps--> pixels joined to a surface --Eq. 1-6--> 1 / range, drawn coarsely in each camera

It is drawn about twice as fine as the range image: more detail is not in it. Triangles between pixels of one surface
are drawn, and the nearest wins; across a step in depth nothing is drawn, because the space there is unknown. Labels:

    OK          a range within limits
    NO_RANGE    nothing came back, or from beyond the limits
    SATURATED   too much light came back: retroreflecting tape, bare metal face to face
    FLYING      a mixture of a near and a far surface (`flying_kernels`)

Behind glass and in mirrors a time-of-flight camera measures the path of its light, which a range alone does not show; a
map may (`mirror_labels`).
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from cairn_calib.rig.brown import radius_limit
from cairn_calib.rig.camera import Camera
from cairn_calib.rig.lidar import AnyCamera
from cairn_calib.rig.poses import Transform, inverse, transform_points
from cairn_calib.rig.rig import TIME_OF_FLIGHT_REACH_M, Rig
from cairn_fusion.image_fusion.cross_view_kernels import places_into
from cairn_fusion.image_fusion.row_bands import run_in_bands
from cairn_fusion.image_fusion.surface_kernels import (
    borrowed_ranges,
    draw_labels_into,
    draw_squares_into,
    draw_triangles_into,
    fronts,
    joints,
    nearest_of_nine,
)
from cairn_fusion.mapping.beam_returns import full_pixels
from cairn_fusion.mapping.flying_kernels import flying_pixels
from cairn_fusion.recording.scan import Scan
from cairn_fusion.transfer.transfer import KERNEL_COEFFICIENTS, Label
from cairn_map.arrays import Flags, Labels, Singles
from cairn_map.render.camera_rays import CameraRays

Values = npt.NDArray[np.float32]
COVER = 1.5
"""Width of a range pixel in `live_range`, over the distance to the next one: slanted surfaces are sampled wider."""
MIN_RANGE_M = 0.1
FLYING_STEP_M = 0.05
"""Limits of `range_labels`, as those of `integrate.Integrator`."""
AMPLITUDE_MAX = 65535
"""Highest count of an amplitude image."""
JOIN_SIGMAS = 3 * math.sqrt(2)
"""Largest step between two pixels of one surface by noise alone, standard deviations of the range."""
JOIN_STEP_M = 0.06
"""Smaller steps do not count: at 2 m the views of cameras 10 cm apart differ there by 2 colour pixels."""
DRAWN_PER_PIXEL = 2.2
"""Drawn pixels along a range pixel, approximately."""
EDGE_REACH = 0.6
"""Reach of occlusion around a range pixel, range pixels: half of it, and a little."""
BORROW_PX = 6
"""Largest distance from a pixel without a range to the one whose range it borrows, range pixels."""


def range_labels(
    scan: Scan,
    rig: Rig,
    *,
    min_range_m: float = MIN_RANGE_M,
    max_range_m: float = TIME_OF_FLIGHT_REACH_M,
    flying_step_m: float = FLYING_STEP_M,
) -> Labels:
    """(H, W) uint8 `Label` of each pixel of the scan's range camera: OK, NO_RANGE, SATURATED or FLYING.

    Args:
        scan: with a range image and, to detect saturated pixels, an amplitude image.
        rig: with the range camera.
        min_range_m: nearer returns are ignored.
        max_range_m: farther returns are ignored.
        flying_step_m: least difference of a flying pixel from both its neighbours; infinite: no pixel flies.
    """
    range_m = rig[scan.range_camera].true_ranges(scan.range_m, scan.amplitude)
    labels = np.full(range_m.shape, Label.OK, np.uint8)
    labels[flying_pixels(range_m, flying_step_m)] = Label.FLYING
    # Written so that NaN is outside the limits; a later label replaces an earlier one.
    labels[~((range_m >= min_range_m) & (range_m <= max_range_m))] = Label.NO_RANGE
    labels[full_pixels(scan, rig[scan.range_camera])] = Label.SATURATED
    if scan.amplitude is not None:  # no count is higher, so it is saturated whatever the rig states
        labels[scan.amplitude == AMPLITUDE_MAX] = Label.SATURATED
    return labels


@dataclass(frozen=True, slots=True, eq=False)
class RangeSurface:
    """Surface of one range image."""

    range_camera: str
    range_m: Singles
    """(H, W) metres along the beam; a pixel without a trusted range has that of the nearest with one, or NaN."""
    labels: Labels
    """(H, W) `Label` by `range_labels`."""
    across: Flags
    """(H, W) true if a pixel and the next in its row are of one surface."""
    down: Flags
    """(H, W) true if a pixel and the next in its column are of one surface."""
    fronts: Flags
    """(H, W) pixels where a surface ends before a farther one."""


@dataclass(frozen=True, slots=True, eq=False)
class Drawn:
    """A range surface as another camera sees it, (h, w)."""

    step_px: int
    """Pixels of the camera along one that is drawn."""
    per_pixel: float
    """Drawn pixels along one of the range camera."""
    nearness: Singles
    """1 / range from the camera, 1 / metres; 0 where nothing is known."""
    marks: Labels
    """Reason where no range is known: `Label`."""
    hiding: Singles
    """1 / range of the nearest around, 1 / metres, with the half pixels beyond edges; 0 where nothing is known."""
    slack: Singles
    """Largest excess of `hiding` over the surface at the same place by slant, 1 / metres."""


def surface_of(scan: Scan, rig: Rig, beyond: Flags | None = None) -> RangeSurface:
    """Surface of a scan's range image, without reflections in mirrors that a map shows: (H, W) `mirror_pixels`."""
    # Stage 1: labels, by the range image itself, and by the map where it proves a mirror.
    labels, mounted = range_labels(scan, rig), rig[scan.range_camera]
    if beyond is not None:
        labels[beyond & (labels == Label.OK)] = Label.BEYOND
    # Stage 2: ranges to draw; gaps in a surface are filled from near pixels, so that few holes are seen.
    range_m = mounted.true_ranges(scan.range_m, scan.amplitude)
    noise_m = np.maximum(JOIN_SIGMAS * mounted.range_sigma_image(range_m), JOIN_STEP_M).astype(np.float32)
    shown_m = borrowed_ranges(range_m, labels, BORROW_PX)
    # A mirror may be larger than the borrowing reach; its reflection lies in about the same pixels for near cameras.
    shown_m = np.where(np.isnan(shown_m) & (labels == Label.BEYOND), range_m, shown_m)
    # Stage 3: surfaces and their edges, by measured ranges alone: a borrowed one must join nothing.
    across, down = (joints(range_m, labels, noise_m, *step) for step in ((1, 0), (0, 1)))
    return RangeSurface(
        range_camera=scan.range_camera,
        range_m=shown_m,
        labels=labels,
        across=across,
        down=down,
        fronts=fronts(range_m, labels, across, down, noise_m),
    )


def drawn_surface(surface: RangeSurface, rig: Rig, camera: str) -> Drawn:
    """A surface as a camera of the rig sees it.

    Args:
        surface: of a scan.
        rig: its rig.
        camera: camera that sees it.
    """
    # Stage 1: the range pixels in that camera (Eq. 1-6), in drawn pixels.
    src, dst = rig[surface.range_camera], rig[camera]
    seen_by, ratio = dst.camera, dst.camera.focal_px[0] / src.camera.focal_px[0]
    step = max(1, round(ratio / DRAWN_PER_PIXEL))
    at = places(surface.range_m, beams(src.camera), seen_by, inverse(dst.transform) @ src.transform)
    # Pixel k drawn stands for the camera's k step to k step + step - 1.
    u, v = (((axis - (step - 1) / 2) / step).astype(np.float64) for axis in at[:2])
    q = at[2].astype(np.float64)
    # Stage 2: triangles; trusted pixels that have none, as squares; and reasons where nothing is drawn.
    shape = -(-seen_by.height // step), -(-seen_by.width // step)
    nearness, marks, drawn = (
        np.zeros(shape, np.float32),
        np.full(shape, Label.NO_RANGE, np.uint8),
        np.zeros(u.shape, bool),
    )
    draw_triangles_into(nearness, drawn, u, v, q, surface.across, surface.down)
    trusted, per_pixel = surface.labels == Label.OK, ratio / step
    draw_squares_into(nearness, trusted & ~drawn, u, v, q, 0.5 * per_pixel)
    draw_labels_into(marks, nearness, surface.labels, u, v, 0.5 * per_pixel)
    # Stage 3: the surface as an occluder, widened at the edges that the range image resolves to a pixel only.
    edges = nearness.copy()
    draw_squares_into(edges, surface.fronts, u, v, q, EDGE_REACH * per_pixel)
    hiding = nearest_of_nine(edges)
    return Drawn(
        step_px=step, per_pixel=per_pixel, nearness=nearness, marks=marks, hiding=hiding, slack=_slack(edges, hiding)
    )


def places(range_m: Singles, rays: Singles, dst: AnyCamera, T_dst_src: Transform) -> tuple[Singles, Singles, Singles]:
    """Pixels of an image's points in another camera.

    Args:
        range_m: (H, W) metres along the beams; NaN for no point.
        rays: (3, H, W) float32, their unit rays, frame of the image's camera: `beams`, or some of them.
        dst: the other camera.
        T_dst_src: from the image's camera to the other.

    Returns:
        (H, W) float32 each: x and y, pixels, also beyond the image, x NaN for a point that `dst` cannot see; and
        1 / range from there.
    """
    if isinstance(dst, Camera) and len(dst.distortion) == KERNEL_COEFFICIENTS:
        u, v, q = (np.empty(range_m.shape, np.float32) for _ in range(3))
        lens, coefficients = np.array([*dst.focal_px, *dst.centre_px]), np.array(dst.distortion)
        numbers = (
            np.ascontiguousarray(rays),
            np.ascontiguousarray(T_dst_src),
            lens,
            coefficients,
            radius_limit(dst.distortion),
        )
        run_in_bands(lambda first, last: places_into(u, v, q, range_m, *numbers, first, last), len(range_m))
        return u, v, q
    # Any other camera projects by itself, in float64: Eq. 5 and 6 with its own lens.
    points = transform_points(T_dst_src, np.moveaxis(rays, 0, -1).astype(np.float64) * range_m[..., None])
    pixels = dst.project(points).astype(np.float32)
    nearness = (1 / np.linalg.norm(points, axis=-1)).astype(np.float32)
    return np.ascontiguousarray(pixels[..., 0]), np.ascontiguousarray(pixels[..., 1]), nearness


@lru_cache(maxsize=16)
def beams(camera: AnyCamera) -> Singles:
    """(3, H, W) float32 unit ray of every pixel, axis by axis for vector instructions; read-only."""
    planes = np.ascontiguousarray(np.moveaxis(camera.rays(), -1, 0), dtype=np.float32)
    planes.setflags(write=False)
    return planes


@lru_cache(maxsize=16)
def sight_of(camera: AnyCamera) -> CameraRays:
    """A camera's rays as input of map rendering; cached, because results for them are cached too."""
    return CameraRays(camera.rays())


def _slack(nearness: Singles, hiding: Singles) -> Singles:
    """(h, w) difference of a slanted surface from its nearest neighbour, where the surface goes on."""
    steps = np.zeros_like(nearness)
    for axis in (0, 1):
        # Of the steps to both sides the smaller: on a slope they are alike, at an edge one is large and no slant.
        ahead = np.abs(np.diff(nearness, axis=axis, append=np.float32(np.inf)))
        behind = np.abs(np.diff(nearness, axis=axis, prepend=np.float32(np.inf)))
        steps += np.minimum(ahead, behind)
    steps[~np.isfinite(steps)] = 0
    return np.minimum(2 * steps, hiding).astype(np.float32)


def live_range(scan: Scan, rig: Rig, *, camera: str, beyond: npt.NDArray[np.bool_] | None = None) -> Values:
    """Live depth of any camera, from the range camera's image: (H, W) float32, metres along its rays; NaN for unknown.

    Each range pixel covers as many of the camera's as lie between it and its neighbours; where several do, the nearest
    counts. Saturated and flying pixels (`range_labels`) are left out, and reflections in mirrors: `beyond`, (H, W) of
    the range camera, from `mirror_pixels`. It is for viewing and for occlusion; it never becomes evidence.

    Raises:
        BadInputError: kind `unknown_camera`, or images of another size.
    """
    # Stage 1: trusted ranges; the range camera itself needs no more.
    seen_by, source = rig[camera], rig[scan.range_camera]
    labels = range_labels(scan, rig)
    trusted = (labels != Label.SATURATED) & (labels != Label.FLYING)
    if beyond is not None:
        trusted &= ~beyond
    true_m = source.true_ranges(scan.range_m, scan.amplitude)
    range_m = np.where(trusted, true_m, np.float32(np.nan)).astype(np.float32, copy=False)
    if camera == scan.range_camera:
        return range_m
    # Stage 2: each range pixel in the camera (Eq. 1-6), as a square that reaches its neighbours' squares.
    at = places(range_m, beams(source.camera), seen_by.camera, inverse(seen_by.transform) @ source.transform)
    u, v, q = (each.astype(np.float64) for each in at)
    gap_px = _pixel_rad(source.camera.rays()) / _pixel_rad(seen_by.camera.rays())
    half_px = int(COVER * max(gap_px, 1.0) / 2) + 0.5
    nearness = np.zeros((seen_by.camera.height, seen_by.camera.width), np.float32)
    draw_squares_into(nearness, trusted, u, v, q, half_px)
    # 0 is where nothing was drawn.
    with np.errstate(divide="ignore"):
        return np.where(nearness > 0, 1 / nearness, np.float32(np.nan))


def _pixel_rad(rays: npt.NDArray[np.float64]) -> float:
    """Angle between neighbouring pixels in the middle of an image, radians."""
    row = rays[rays.shape[0] // 2]
    middle = len(row) // 2
    return float(np.linalg.norm(row[middle] - row[middle - 1]))
