"""The truth behind a fused image: what other cameras' values would be at each pixel, and who sees what it shows.

values      what a perfect camera of the other spectrum would show through this camera's pixels
sees        for each source, whether it sees the surface point of the pixel, and whether that is within its image
near_edge   within one range pixel of a step in depth, in this camera's image or at the point's place in a source's
beyond      pixels that show something behind glass or in a mirror: a range camera measures where its light went
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from cairn_calib.rig.poses import Transform, inverse, transform_points
from cairn_calib.rig.rig import Rig, Spectrum
from cairn_map.arrays import Flags, Floats
from cairn_sim.render.rays import POINTS_OF_BUNDLE, cast, cast_directions
from cairn_sim.render.render import CameraView, colour_image, thermal_image
from cairn_sim.render.sensors import ColourSensor, ThermalSensor
from cairn_sim.scene.scene import Scene

HIDDEN_M = 0.1
"""Distance between an occluder and the surface behind it at least: a surface's own curvature hides nothing."""
EDGE_SHARE = 0.05
EDGE_M = HIDDEN_M / 2
"""Neighbours whose ranges differ by more than the share, or by as much as may hide something, are on both sides of an
edge."""


@dataclass(frozen=True, slots=True, eq=False)
class FusionTruth:
    """The truth behind an (H, W) fused image; the arrays of the module's picture."""

    values: npt.NDArray[np.float32]
    """(H, W, C) kelvin, or sRGB of 255."""
    sees: Mapping[str, Flags]
    in_view: Mapping[str, Flags]
    near_edge: Flags
    beyond: Flags
    pixel_px: float = 1.0
    """Pixels along one of the range camera, which is what can be known of where an edge is."""


def fusion_truth(
    scene: Scene, rig: Rig, camera: str, sources: Sequence[str], *, T_map_rig: Transform, range_camera: str
) -> FusionTruth:
    """The truth behind what sources of one spectrum give to a camera's pixels.

    Raises:
        BadInputError: no such camera, or one stands inside a solid.
    """
    seen_in, spectrum = rig[camera], rig[sources[0]].spectrum
    T_map_camera = T_map_rig @ seen_in.transform
    own = cast(scene, seen_in.camera, T_map_camera, opaque=seen_in.spectrum is Spectrum.THERMAL)
    other = cast(scene, seen_in.camera, T_map_camera, opaque=spectrum is Spectrum.THERMAL)
    view = CameraView(scene=scene, camera=seen_in.camera, T_map_camera=T_map_camera, hits=other)
    if spectrum is Spectrum.THERMAL:
        values = thermal_image(view, ThermalSensor(), None)[..., None]
    else:
        values = colour_image(view, ColourSensor(), None).astype(np.float32)
    range_m = np.where(own.solid < 0, np.nan, own.range_m).reshape(view.shape)
    points = transform_points(T_map_camera, seen_in.camera.rays() * range_m[..., None])
    focal_px = rig[range_camera].camera.focal_px[0]
    pixel_px = seen_in.camera.focal_px[0] / focal_px
    near_edge = _near_edges(range_m, pixel_px)
    sees, in_view = {}, {}
    for name in sources:
        mounted = rig[name]
        T_map_source = T_map_rig @ mounted.transform
        from_there = transform_points(inverse(T_map_source), points)
        pixels = mounted.camera.project(from_there)
        in_view[name] = mounted.camera.contains(pixels)
        sees[name] = in_view[name] & ~_hidden(scene, from_there, T_map_source, opaque=spectrum is Spectrum.THERMAL)
        hits = cast(scene, mounted.camera, T_map_source, opaque=spectrum is Spectrum.THERMAL)
        edges = _near_edges(hits.range_m.reshape(mounted.camera.height, -1), mounted.camera.focal_px[0] / focal_px)
        x, y = np.rint(np.where(in_view[name][..., None], pixels, 0)).astype(np.int64).transpose(2, 0, 1)
        near_edge |= in_view[name] & edges[y, x]
    beyond = (own.way != 0).reshape(view.shape)
    return FusionTruth(values.astype(np.float32), sees, in_view, near_edge, beyond, pixel_px)


def _hidden(scene: Scene, points: Floats, T_map_source: Transform, *, opaque: bool) -> Flags:
    """(H, W) whether something stands before points (H, W, 3) of a source's frame; False for NaN."""
    flat = points.reshape(-1, 3)
    known = np.flatnonzero(~np.isnan(flat[:, 0]))
    distance_m = np.linalg.norm(flat[known], axis=1)
    hits = cast_directions(
        scene, flat[known] / distance_m[:, None], T_map_source, bundle=POINTS_OF_BUNDLE, opaque=opaque
    )
    hidden = np.zeros(len(flat), bool)
    hidden[known] = hits.straight_m < distance_m - HIDDEN_M
    return hidden.reshape(points.shape[:2])


def _near_edges(range_m: Floats, pixel_px: float) -> Flags:
    """(H, W) pixels at most a range pixel, `pixel_px` of these, from a step in depth; what is endless is far away."""
    nearness = 1 / np.where(np.isnan(range_m), np.inf, range_m)
    step = np.minimum(EDGE_SHARE, EDGE_M * nearness) * nearness
    edges = np.zeros(range_m.shape, np.uint8)
    for axis in (0, 1):
        ahead = np.diff(nearness, axis=axis, append=np.take(nearness, [-1], axis=axis))
        # Slant is the same on both sides, a step is not.
        bend = np.abs(np.diff(ahead, axis=axis, prepend=np.take(ahead, [0], axis=axis)))
        edges |= (bend > step).astype(np.uint8)
    return grown(edges.astype(bool), pixel_px)


def grown(flags: Flags, pixel_px: float) -> Flags:
    """(H, W) pixels at most a range pixel, `pixel_px` of these, from one of (H, W) flags."""
    side = 2 * int(np.ceil(pixel_px)) + 1
    return np.asarray(cv2.dilate(flags.astype(np.uint8), np.ones((side, side), np.uint8)), dtype=bool)
