"""The team's map over a robot's live image: what others measured, where this robot looks now.

    visible       the map agrees with the live depth: painted solid
    see-through   behind the live surface, beyond the next free space: in stripes, fainter the farther and older it is
    map only      no live depth says what is there: in dots

    overlay = draw_overlay(renderer, snapshot, live, OverlayStyle(layer=Layer.TEMPERATURE))
    overlay.picture                      (H, W, 3), with `legend()` below

A map surface in front of the live depth is gone now, and is not drawn. What the map has no value for is grey, never
cold. Where the pose is uncertain the ink spreads as far as it may be off, while stripes and dots stay sharp; where it
is too uncertain, nothing is drawn, and the picture says why.
"""

from dataclasses import dataclass
from enum import IntEnum
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from cairn_fusion.view import overlay_kernels as kernels
from cairn_map.arrays import Flags, Rgb
from cairn_map.errors import BadInputError
from cairn_map.queries.map_snapshot import MapSnapshot
from cairn_map.render.camera_rays import CameraRays, middles
from cairn_map.render.legend import with_legend, write_text_into
from cairn_map.render.map_picture import Ages, layer_values
from cairn_map.render.map_render import MapRenderer, SurfaceImage
from cairn_map.render.pose_spread import BLUR_MAX_PX, PoseSpread, spread_ink, why_withheld
from cairn_map.render.render_kernels import blend_into
from cairn_map.render.render_picture import SCALES, WARNING, Layer, Scale, painted

Values = npt.NDArray[np.float32]
Scalar = TypeVar("Scalar", bound=np.generic)

TOLERANCE_VOXELS = 2.0
GREY_COVER = 0.4
"""Of what has no value, beside what has."""
THROUGH_COVER = 0.9
THROUGH_COVER_MIN = 0.2
MEANINGS = ("solid: visible", "stripes: behind that", "dots: from the map alone")
EXACT = PoseSpread.of_sigmas()


class OverlayMode(IntEnum):
    """What a pixel of an overlay shows of the map in front."""

    NOTHING = kernels.NOTHING
    VISIBLE = kernels.VISIBLE
    SEE_THROUGH = kernels.SEE_THROUGH
    MAP_ONLY = kernels.MAP_ONLY


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Live:
    """A live image, and where it was taken."""

    rgb: Rgb
    """(H, W, 3) sRGB."""
    range_m: Values
    """(H, W) metres along each pixel's ray; NaN where there is none."""
    sight: CameraRays
    T_map_camera: npt.NDArray[np.float64]
    spread: PoseSpread = EXACT
    """How certain `T_map_camera` is."""

    def __post_init__(self) -> None:
        size = (self.sight.height, self.sight.width)
        if self.rgb.shape != (*size, 3) or self.rgb.dtype != np.uint8 or self.range_m.shape != size:
            raise BadInputError(
                "image_size",
                f"the camera has {size[1]} x {size[0]} pixels, so rgb must be {(*size, 3)} uint8 and range_m {size}; "
                f"got {self.rgb.shape} {self.rgb.dtype} and {self.range_m.shape}",
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class OverlayStyle:
    """What is drawn, and how."""

    layer: Layer = Layer.TEMPERATURE
    scale: Scale | None = None
    """None: the layer's usual one."""
    tolerance_m: float | None = None
    """By how much the map and the live depth may differ and still agree; None: two voxels."""
    range_max_m: float = 20.0
    fade_m: float = 8.0
    """Behind the live surface by this, stripes have faded to 1/e; and"""
    fade_s: float = 3600.0
    """likewise at this age, where the age is known."""
    blur_max_px: float = BLUR_MAX_PX
    """Nothing is drawn when half of it may be off by more (standard deviation)."""
    through_m: float = 10.0
    """So far behind the live surface things are looked for."""
    step_px: int = 3
    """All but the visible, and the outline of what the map alone has, is looked up once for so many pixels along both
    axes: stripes and dots do not show more."""

    @property
    def colours(self) -> Scale:
        """The scale."""
        return self.scale or SCALES[self.layer]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Overlay:
    """What was drawn."""

    picture: Rgb
    """(H, W, 3)"""
    front: SurfaceImage
    """What the map has where the live surface is, and, where there is no live depth, along the outlines of `rest`."""
    values: npt.NDArray[np.floating]
    """Of the layer, in front; (H, W), of colours (H, W, 3)."""
    rest: SurfaceImage
    """What lies behind the live surface, or, where there is no live depth, the nearest on the map; for the middle of
    each `step_px` rows and columns."""
    values_of_rest: npt.NDArray[np.floating]
    front_modes: npt.NDArray[np.uint8]
    """(H, W) VISIBLE, MAP_ONLY or NOTHING."""
    through: Flags
    """(H, W) whether something lies behind the live surface."""
    withheld: str | None = None
    """Why nothing was drawn."""

    @property
    def modes(self) -> npt.NDArray[np.uint8]:
        """(H, W) `OverlayMode` of each pixel; SEE_THROUGH where nothing is in front, but something is behind."""
        is_behind = (self.front_modes == OverlayMode.NOTHING) & self.through
        return np.where(is_behind, np.uint8(OverlayMode.SEE_THROUGH), self.front_modes)


def draw_overlay(
    renderer: MapRenderer, snapshot: MapSnapshot, live: Live, style: OverlayStyle, ages: Ages | None = None
) -> Overlay:
    """The map over a live image.

    Args:
        renderer: keeps what it worked out between images.
        snapshot: the map.
        live: the image, its depth and its camera.
        style: which layer, and how.
        ages: when the map changed; without it nothing fades with age.

    Raises:
        BadInputError: the map has no such layer, or the pose is no rigid transform.
    """
    tolerance_m = np.float32(style.tolerance_m or TOLERANCE_VOXELS * snapshot.geometry.voxel_edge_m)
    range_m, step = np.asarray(live.range_m, np.float32), style.step_px
    coarse_m = middles(range_m, step)
    rest = _rest(renderer, snapshot, live, coarse_m, tolerance_m, style)
    rest_modes = np.where(np.isnan(coarse_m), np.uint8(OverlayMode.MAP_ONLY), np.uint8(OverlayMode.SEE_THROUGH))
    rest_modes[~rest.hit] = OverlayMode.NOTHING
    H, W = range_m.shape
    everywhere = _wide(rest_modes, step, (H, W))
    is_alone = np.isnan(range_m)
    # Ink that is spread has no outline.
    is_fine = is_alone & _wide(_outlines(rest_modes, coarse_m), step, (H, W)) & live.spread.is_exact
    around = (
        np.where(is_fine, np.float32(0), range_m - tolerance_m),
        np.where(is_fine, np.float32(style.range_max_m), range_m + tolerance_m),
    )
    front = renderer.nearest(snapshot, live.sight, live.T_map_camera, range_max_m=style.range_max_m, between_m=around)
    modes = np.where(
        front.hit,
        np.where(is_alone, np.uint8(OverlayMode.MAP_ONLY), np.uint8(OverlayMode.VISIBLE)),
        OverlayMode.NOTHING,
    )
    modes = modes.astype(np.uint8)
    modes[is_alone & ~is_fine & (everywhere == OverlayMode.MAP_ONLY)] = OverlayMode.MAP_ONLY
    values = layer_values(renderer, snapshot, front, style.layer, ages)
    values_of_rest = layer_values(renderer, snapshot, rest, style.layer, ages)
    spreads, why = None, None
    if not live.spread.is_exact:
        rest_m = _wide(rest.range_m, step, (H, W))
        spreads = live.spread.at(live.sight, front.range_m), live.spread.at(live.sight, rest_m)
        drawn = front.hit | (everywhere != OverlayMode.NOTHING)
        likely = np.where(front.hit[..., None], *spreads)
        why = why_withheld(likely[drawn], blur_max_px=style.blur_max_px)
    if why is not None:
        picture = live.rgb.copy()
        write_text_into(picture, f"map withheld: {why}", (8, 8), WARNING)
    else:
        covers = _covers(renderer, snapshot, rest, coarse_m, style, ages)
        covers[_unknown(values_of_rest)] *= GREY_COVER
        front_covers = np.ones((H, W), np.float32)
        if ages is not None and is_fine.any():
            as_dots = _covers(renderer, snapshot, front, np.full_like(range_m, np.nan), style, ages)
            front_covers[is_fine] = as_dots[is_fine]
        front_covers[_unknown(values)] *= GREY_COVER
        front_covers[~front.hit] = 0
        colours = painted(values, style.colours), painted(values_of_rest, style.colours)
        ink = np.empty((H, W, 4), np.uint8)
        if spreads is None:
            kernels.ink_into(colours[0], front_covers, modes, colours[1], covers, rest_modes, step, ink)
        else:
            covers[~rest.hit] = 0
            wide = _wide(colours[1], step, (H, W)), _wide(covers, step, (H, W))
            solid = spread_ink(_solid_ink(colours[0], front_covers * np.float32(kernels.VISIBLE_COVER)), spreads[0])
            behind = spread_ink(_solid_ink(*wide), spreads[1])
            kernels.hatch_into(solid, behind, ~np.isnan(range_m), ink)
        picture = np.empty_like(live.rgb)
        blend_into(np.ascontiguousarray(live.rgb).reshape(-1, 3), ink.reshape(-1, 4), picture.reshape(-1, 3))
    return Overlay(
        picture=picture,
        front=front,
        values=values,
        rest=rest,
        values_of_rest=values_of_rest,
        front_modes=modes,
        through=everywhere == OverlayMode.SEE_THROUGH,
        withheld=why,
    )


def _rest(
    renderer: MapRenderer,
    snapshot: MapSnapshot,
    live: Live,
    coarse_m: Values,
    tolerance_m: np.float32,
    style: OverlayStyle,
) -> SurfaceImage:
    """What is beyond the live surface, and the nearest where there is none."""
    sight, far = live.sight.every(style.step_px), np.full_like(coarse_m, style.range_max_m)
    is_alone = np.isnan(coarse_m)
    nowhere = np.float32(np.nan)
    behind_m = coarse_m + tolerance_m
    asked = {"range_max_m": style.range_max_m}
    behind = renderer.beyond(
        snapshot, sight, live.T_map_camera, between_m=(behind_m, np.minimum(far, behind_m + style.through_m)), **asked
    )
    alone = renderer.nearest(
        snapshot, sight, live.T_map_camera, between_m=(np.where(is_alone, np.float32(0), nowhere), far), **asked
    )
    return SurfaceImage(
        sight,
        np.where(is_alone, alone.range_m, behind.range_m),
        np.where(is_alone, alone.slots, behind.slots),
        np.where(is_alone, alone.places, behind.places),
        np.where(is_alone, alone.nodes, behind.nodes),
    )


def _outlines(modes: Rgb, coarse_m: Values) -> Flags:
    """(h, w) where the map has something, and has nothing, in the 3 x 3 around, without any live depth in both."""
    return _spread(modes == OverlayMode.MAP_ONLY) & _spread(np.isnan(coarse_m) & (modes == OverlayMode.NOTHING))


def _spread(flags: Flags) -> Flags:
    """(h, w) whether any of the 3 x 3 around is set."""
    wide = np.pad(flags, 1)
    rows = wide[:-2] | wide[1:-1] | wide[2:]
    return np.asarray(rows[:, :-2] | rows[:, 1:-1] | rows[:, 2:])


def with_overlay_legend(picture: Rgb, scale: Scale) -> Rgb:
    """The picture with its legend below: the scale, and what solid, stripes and dots mean."""
    return with_legend(picture, scale, MEANINGS)


def _covers(
    renderer: MapRenderer,
    snapshot: MapSnapshot,
    rest: SurfaceImage,
    live_m: Values,
    style: OverlayStyle,
    ages: Ages | None,
) -> Values:
    """(h, w) of the rest: less the farther behind the live surface it is, and the older."""
    fade = np.nan_to_num((rest.range_m - live_m) / np.float32(style.fade_m))
    if ages is not None:
        age = (ages.now - renderer.changed(snapshot, rest, ages.changes)).astype(np.float32)
        fade += np.nan_to_num(np.maximum(age, 0)) / np.float32(style.fade_s)
    full = np.where(np.isnan(live_m), np.float32(1), np.float32(THROUGH_COVER))
    return np.asarray(np.maximum(full * np.exp(-fade), THROUGH_COVER_MIN), np.float32)


def _wide(values: npt.NDArray[Scalar], step: int, size: tuple[int, int]) -> npt.NDArray[Scalar]:
    """(H, W, ...) of what is known of each `step` x `step` pixels."""
    return values.repeat(step, axis=0).repeat(step, axis=1)[: size[0], : size[1]]


def _solid_ink(colours: Rgb, covers: Values) -> Rgb:
    """(H, W, 4) of `overlay_kernels`."""
    ink = np.dstack([colours, np.full(covers.shape, 255, np.uint8)]) * covers[..., None]
    return np.asarray(np.rint(ink), np.uint8)


def _unknown(values: npt.NDArray[np.floating]) -> Flags:
    return np.asarray(np.isnan(values if values.ndim == 2 else values[..., 0]))
