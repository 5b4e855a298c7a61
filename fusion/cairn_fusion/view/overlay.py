"""The team's map drawn over a robot's live image: measurements of other robots in its view.

    visible       at the live depth: painted solid
    see-through   behind the live surface, beyond the next free space: in stripes, fainter the farther and older it is
    map only      where there is no live depth: in dots

    overlay = draw_overlay(renderer, snapshot, live, OverlayStyle(layer=Layer.TEMPERATURE))
    overlay.picture                      (H, W, 3); `with_overlay_legend` puts the legend below it

A map surface in front of the live depth is gone now, and is not drawn. A surface without a value is grey, never cold.
Where the pose is uncertain the ink spreads as far as it may be off, while stripes and dots stay sharp; where it is too
uncertain, nothing is drawn, and the picture says why.
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
Modes = npt.NDArray[np.uint8]
Layers = tuple[Rgb, Values, Modes]
"""Colours, covers and modes of the pixels in front, or of the rest."""
Spreads = tuple[Values, Values]
"""Uncertainty of places in front, and of the rest: `PoseSpread.at`."""
Scalar = TypeVar("Scalar", bound=np.generic)

TOLERANCE_VOXELS = 2.0
"""Difference of the map and the live depth that still agree, by default."""
GREY_COVER = 0.4
"""Cover of a surface without a value, over that of one with a value."""
THROUGH_COVER = 0.9
"""Cover of a hidden surface right behind the live one."""
THROUGH_COVER_MIN = 0.2
"""Least cover of a hidden surface, however far or old."""
MEANINGS = ("solid: visible", "stripes: behind that", "dots: from the map alone")
EXACT = PoseSpread.of_sigmas()


class OverlayMode(IntEnum):
    """Content of a pixel of an overlay, of the map in front."""

    NOTHING = kernels.NOTHING
    VISIBLE = kernels.VISIBLE
    SEE_THROUGH = kernels.SEE_THROUGH
    MAP_ONLY = kernels.MAP_ONLY


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Live:
    """A live image with its camera, pose and depth."""

    rgb: Rgb
    """(H, W, 3) sRGB."""
    range_m: Values
    """(H, W) metres along each pixel's ray; NaN where there is none."""
    sight: CameraRays
    T_map_camera: npt.NDArray[np.float64]
    spread: PoseSpread = EXACT
    """Uncertainty of `T_map_camera`."""

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
    """Layer and style of an overlay."""

    layer: Layer = Layer.TEMPERATURE
    scale: Scale | None = None
    """Scale of the layer's values; None: the layer's usual one."""
    tolerance_m: float | None = None
    """Difference of the map and the live depth up to which they agree; None: two voxels."""
    range_max_m: float = 20.0
    """Farthest surface that is drawn, metres along the ray."""
    fade_m: float = 8.0
    """Distance behind the live surface at which stripes have faded to 1/e, metres."""
    fade_s: float = 3600.0
    """Age at which stripes and dots have faded to 1/e, seconds, where the age is known."""
    blur_max_px: float = BLUR_MAX_PX
    """Nothing is drawn when half of it may be off by more than this standard deviation, pixels."""
    through_m: float = 10.0
    """Depth behind the live surface that is searched, metres."""
    step_px: int = 3
    """Pixels along both axes that share one look-up, except visible surfaces and the outlines of the map alone: stripes
    and dots show no more detail."""

    @property
    def colours(self) -> Scale:
        """The scale in use."""
        return self.scale or SCALES[self.layer]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Overlay:
    """An overlay, and the map values that it shows."""

    picture: Rgb
    """(H, W, 3) sRGB."""
    front: SurfaceImage
    """Map surfaces at the live surface, and along the outlines of `rest` where there is no live depth."""
    values: npt.NDArray[np.floating]
    """Values of the layer in front: (H, W), of colours (H, W, 3)."""
    rest: SurfaceImage
    """Map surfaces behind the live one, or the nearest where there is no live depth; for the middle of each `step_px`
    rows and columns."""
    values_of_rest: npt.NDArray[np.floating]
    """Values of the layer in `rest`: (h, w), of colours (h, w, 3)."""
    front_modes: npt.NDArray[np.uint8]
    """(H, W) VISIBLE, MAP_ONLY or NOTHING."""
    through: Flags
    """(H, W) true where something lies behind the live surface."""
    withheld: str | None = None
    """Reason why nothing was drawn; None if something was."""

    @property
    def modes(self) -> npt.NDArray[np.uint8]:
        """(H, W) `OverlayMode` of each pixel; SEE_THROUGH where nothing is in front, and something behind."""
        is_behind = (self.front_modes == OverlayMode.NOTHING) & self.through
        return np.where(is_behind, np.uint8(OverlayMode.SEE_THROUGH), self.front_modes)


def draw_overlay(
    renderer: MapRenderer, snapshot: MapSnapshot, live: Live, style: OverlayStyle, ages: Ages | None = None
) -> Overlay:
    """The map over a live image.

    Args:
        renderer: keeps its tables from image to image.
        snapshot: the map.
        live: the image, its depth and its camera.
        style: layer and style.
        ages: when the map changed; without it nothing fades with age.

    Raises:
        BadInputError: the map has no such layer, or the pose is no rigid transform.
    """
    tolerance_m = np.float32(style.tolerance_m or TOLERANCE_VOXELS * snapshot.geometry.voxel_edge_m)
    range_m, step = np.asarray(live.range_m, np.float32), style.step_px
    # Stage 1: behind the live surface, and on the map alone; coarsely, for stripes and dots show no more.
    coarse_m = middles(range_m, step)
    rest = _rest(renderer, snapshot, live, coarse_m, tolerance_m, style)
    rest_modes = np.where(np.isnan(coarse_m), np.uint8(OverlayMode.MAP_ONLY), np.uint8(OverlayMode.SEE_THROUGH))
    rest_modes[~rest.hit] = OverlayMode.NOTHING
    everywhere = _enlarge(rest_modes, step, range_m.shape)
    # Stage 2: at the live surface, and along the sharp outlines of the map alone; spread ink has no outline.
    is_alone = np.isnan(range_m)
    is_fine = is_alone & _enlarge(_outlines(rest_modes, coarse_m), step, range_m.shape) & live.spread.is_exact
    front = _front(renderer, snapshot, live, is_fine, tolerance_m, style)
    modes = np.where(front.hit, np.where(is_alone, OverlayMode.MAP_ONLY, OverlayMode.VISIBLE), OverlayMode.NOTHING)
    modes = modes.astype(np.uint8)
    modes[is_alone & ~is_fine & (everywhere == OverlayMode.MAP_ONLY)] = OverlayMode.MAP_ONLY
    # Stage 3: values of the layer, and how far the pose's uncertainty moves them in the picture.
    values = layer_values(renderer, snapshot, front, style.layer, ages)
    values_of_rest = layer_values(renderer, snapshot, rest, style.layer, ages)
    spreads = _spreads(live, front, rest, step)
    why = _why_withheld(spreads, front, everywhere, style)
    # Stage 4: ink, unless it could be anywhere; fainter with depth and age, and grey without a value.
    if why is not None:
        picture = live.rgb.copy()
        write_text_into(picture, f"map withheld: {why}", (8, 8), WARNING)
    else:
        covers = _covers(renderer, snapshot, rest, coarse_m, style, ages)
        covers[_unknown(values_of_rest)] *= GREY_COVER
        front_covers = _front_covers(renderer, snapshot, front, values, is_fine, style, ages)
        fronts = painted(values, style.colours), front_covers, modes
        rests = painted(values_of_rest, style.colours), covers, rest_modes
        if spreads is None:
            ink = _ink(fronts, rests, step)
        else:
            ink = _spread_ink(fronts, rests, spreads, rest, is_alone, step)
        picture = _blended(live.rgb, ink)
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


def _front(
    renderer: MapRenderer,
    snapshot: MapSnapshot,
    live: Live,
    is_fine: Flags,
    tolerance_m: np.float32,
    style: OverlayStyle,
) -> SurfaceImage:
    """Map surfaces within the tolerance of the live depth, and anywhere along the rays of pixels marked `is_fine`."""
    # NaN bounds, where there is no live depth and no outline, ask for nothing.
    range_m = np.asarray(live.range_m, np.float32)
    around = (
        np.where(is_fine, np.float32(0), range_m - tolerance_m),
        np.where(is_fine, np.float32(style.range_max_m), range_m + tolerance_m),
    )
    return renderer.nearest(snapshot, live.sight, live.T_map_camera, range_max_m=style.range_max_m, between_m=around)


def _spreads(live: Live, front: SurfaceImage, rest: SurfaceImage, step: int) -> Spreads | None:
    """Uncertainty of each pixel's place, in front and behind, as `PoseSpread.at`; None for an exact pose."""
    if live.spread.is_exact:
        return None
    # The spread depends on the distance of the surface, so the two layers have their own.
    rest_m = _enlarge(rest.range_m, step, live.range_m.shape)
    return live.spread.at(live.sight, front.range_m), live.spread.at(live.sight, rest_m)


def _why_withheld(spreads: Spreads | None, front: SurfaceImage, everywhere: Modes, style: OverlayStyle) -> str | None:
    """Reason to draw nothing, by the pixels that would be drawn; None if there is none."""
    if spreads is None:
        return None
    # Only pixels that would be drawn count; in front hides the rest.
    drawn = front.hit | (everywhere != OverlayMode.NOTHING)
    likely = np.where(front.hit[..., None], *spreads)
    return why_withheld(likely[drawn], blur_max_px=style.blur_max_px)


def _front_covers(
    renderer: MapRenderer,
    snapshot: MapSnapshot,
    front: SurfaceImage,
    values: npt.NDArray[np.floating],
    is_fine: Flags,
    style: OverlayStyle,
    ages: Ages | None,
) -> Values:
    """(H, W) factors of the cover in front: less without a value, and of the map alone less with age."""
    # A visible surface is measured now, so its age does not count.
    covers = np.ones(is_fine.shape, np.float32)
    # Outlines of the map alone fade as its dots do.
    if ages is not None and is_fine.any():
        as_dots = _covers(renderer, snapshot, front, np.full(is_fine.shape, np.nan, np.float32), style, ages)
        covers[is_fine] = as_dots[is_fine]
    covers[_unknown(values)] *= GREY_COVER
    covers[~front.hit] = 0
    return covers


def _blended(rgb: Rgb, ink: Rgb) -> Rgb:
    """(H, W, 3) a live image with ink over it."""
    picture = np.empty_like(rgb)
    blend_into(np.ascontiguousarray(rgb).reshape(-1, 3), ink.reshape(-1, 4), picture.reshape(-1, 3))
    return picture


def _ink(front: Layers, rest: Layers, step: int) -> Rgb:
    """(H, W, 4) ink of both layers: colours, covers and modes of each."""
    # The kernel looks the coarse layer up itself: nothing is enlarged.
    ink = np.empty((*front[1].shape, 4), np.uint8)
    kernels.ink_into(*front, *rest, step, ink)
    return ink


def _spread_ink(front: Layers, rest: Layers, spreads: Spreads, behind: SurfaceImage, is_alone: Flags, step: int) -> Rgb:
    """(H, W, 4) ink of both layers, each blurred by its spread, with sharp hatches."""
    # Modes do not count: both layers are blurred over their edges, and the hatches tell them apart.
    colours, covers, _ = rest
    covers = np.where(behind.hit, covers, np.float32(0))
    size = is_alone.shape
    # Each by the uncertainty at its own distance: a far surface moves less by a shift, and as much by a turn.
    solid = spread_ink(_solid_ink(front[0], front[1] * np.float32(kernels.VISIBLE_COVER)), spreads[0])
    hidden = spread_ink(_solid_ink(_enlarge(colours, step, size), _enlarge(covers, step, size)), spreads[1])
    ink = np.empty((*size, 4), np.uint8)
    kernels.hatch_into(solid, hidden, ~is_alone, ink)
    return ink


def _rest(
    renderer: MapRenderer,
    snapshot: MapSnapshot,
    live: Live,
    coarse_m: Values,
    tolerance_m: np.float32,
    style: OverlayStyle,
) -> SurfaceImage:
    """Map surfaces beyond the live surface, and the nearest where there is no live depth."""
    # Two queries: beyond the free space behind a live depth, and from the camera on where there is none.
    sight, far = live.sight.every(style.step_px), np.full_like(coarse_m, style.range_max_m)
    is_alone = np.isnan(coarse_m)
    # A surface within the tolerance is the live one itself, so the search begins behind it.
    nowhere = np.float32(np.nan)
    behind_m = coarse_m + tolerance_m
    asked = {"range_max_m": style.range_max_m}
    behind = renderer.beyond(
        snapshot, sight, live.T_map_camera, between_m=(behind_m, np.minimum(far, behind_m + style.through_m)), **asked
    )
    alone = renderer.nearest(
        snapshot, sight, live.T_map_camera, between_m=(np.where(is_alone, np.float32(0), nowhere), far), **asked
    )
    # Each ray is in one of the two, so they merge into one layer.
    return SurfaceImage(
        sight,
        np.where(is_alone, alone.range_m, behind.range_m),
        np.where(is_alone, alone.slots, behind.slots),
        np.where(is_alone, alone.places, behind.places),
        np.where(is_alone, alone.nodes, behind.nodes),
    )


def _outlines(modes: Rgb, coarse_m: Values) -> Flags:
    """(h, w) true where the 3 x 3 around hold both a surface of the map and none, each without a live depth."""
    return _spread(modes == OverlayMode.MAP_ONLY) & _spread(np.isnan(coarse_m) & (modes == OverlayMode.NOTHING))


def _spread(flags: Flags) -> Flags:
    """(h, w) true where any of the 3 x 3 around is."""
    # Of rows first, then of columns.
    wide = np.pad(flags, 1)
    rows = wide[:-2] | wide[1:-1] | wide[2:]
    return np.asarray(rows[:, :-2] | rows[:, 1:-1] | rows[:, 2:])


def with_overlay_legend(picture: Rgb, scale: Scale) -> Rgb:
    """The picture with its legend below: the scale, and the meaning of solid, stripes and dots."""
    return with_legend(picture, scale, MEANINGS)


def _covers(
    renderer: MapRenderer,
    snapshot: MapSnapshot,
    rest: SurfaceImage,
    live_m: Values,
    style: OverlayStyle,
    ages: Ages | None,
) -> Values:
    """(h, w) covers of the rest: less the farther behind the live surface, and the older."""
    # Exponents of distance and age add up; an unknown one does not fade.
    fade = np.nan_to_num((rest.range_m - live_m) / np.float32(style.fade_m))
    if ages is not None:
        age = (ages.now - renderer.changed(snapshot, rest, ages.changes)).astype(np.float32)
        fade += np.nan_to_num(np.maximum(age, 0)) / np.float32(style.fade_s)
    # Dots are opaque unless they fade; a hidden surface never covers the live image, and never vanishes.
    full = np.where(np.isnan(live_m), np.float32(1), np.float32(THROUGH_COVER))
    return np.asarray(np.maximum(full * np.exp(-fade), THROUGH_COVER_MIN), np.float32)


def _enlarge(values: npt.NDArray[Scalar], step: int, size: tuple[int, ...]) -> npt.NDArray[Scalar]:
    """(H, W, ...) values of (h, w, ...) squares of `step` x `step` pixels."""
    return values.repeat(step, axis=0).repeat(step, axis=1)[: size[0], : size[1]]


def _solid_ink(colours: Rgb, covers: Values) -> Rgb:
    """(H, W, 4) ink (`overlay_kernels`) of colours with covers of 0 to 1."""
    # Ink is multiplied by its cover, so that blurred layers add up.
    ink = np.dstack([colours, np.full(covers.shape, 255, np.uint8)]) * covers[..., None]
    return np.asarray(np.rint(ink), np.uint8)


def _unknown(values: npt.NDArray[np.floating]) -> Flags:
    return np.asarray(np.isnan(values if values.ndim == 2 else values[..., 0]))
