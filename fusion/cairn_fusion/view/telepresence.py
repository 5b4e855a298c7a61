"""Telepresence: an operator's view through a robot's cameras, scan by scan.

scan --surface--> drawn in each camera --the picture as guide--> depth of every pixel --cross view--> fused --> picture

thermal-on-colour    colour, with temperatures blended over it
colour-on-thermal    the thermal camera's view, with colour in it
side-by-side         colour, and next to it the temperatures of the same pixels
stereo               thermal-on-colour for both eyes, from the left and the right colour camera
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np
import numpy.typing as npt

from cairn_calib.rig.poses import inverse, transform_points
from cairn_calib.rig.rig import Rig, Spectrum
from cairn_fusion.image_fusion.cross_view import CrossView, cross_view
from cairn_fusion.image_fusion.dense_depth import DenseDepth, Origin, dense_depth
from cairn_fusion.image_fusion.mirror_labels import mirror_pixels
from cairn_fusion.image_fusion.surface import Drawn, drawn_surface, surface_of
from cairn_fusion.recording.scan import Scan, check_scan
from cairn_fusion.transfer.transfer import Label
from cairn_fusion.view.painting import (
    Emphasis,
    Hottest,
    draw_legend_into,
    enlarge,
    enlargement,
    hottest,
    mark_hottest_into,
    paint_alone,
    paint_over,
    write_into,
)
from cairn_fusion.view.temperature_scale import TemperatureScale, locked_scale
from cairn_map.arrays import Rgb
from cairn_map.errors import BadInputError
from cairn_map.queries.map_snapshot import MapSnapshot
from cairn_map.render.map_render import MapRenderer

Image = npt.NDArray[np.generic]

SAME_SHARE = 0.05
"""Largest relative difference of range at one place."""


class ViewMode(StrEnum):
    """Content of a picture."""

    THERMAL_ON_COLOUR = "thermal-on-colour"
    COLOUR_ON_THERMAL = "colour-on-thermal"
    SIDE_BY_SIDE = "side-by-side"
    STEREO = "stereo"


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewOptions:
    """An operator's choices."""

    mode: ViewMode = ViewMode.THERMAL_ON_COLOUR
    camera: str | None = None
    """Camera with the pixels; None: the first that fits the mode."""
    emphasis: Emphasis = field(default_factory=Emphasis)
    scale: TemperatureScale | None = None
    """Scale of temperatures; None: the first picture's, for all."""
    marks_hottest: bool = True
    """True if the hottest place is marked."""


class Telepresence:
    """Pictures of one rig; the temperature scale is kept from one to the next."""

    def __init__(self, rig: Rig, options: ViewOptions, snapshot: MapSnapshot | None = None) -> None:
        """With a map, reflections in mirrors that it proves are not painted.

        Raises:
            BadInputError: the rig lacks a camera that the mode needs.
        """
        self._rig, self._options, self._scale, self._snapshot = rig, options, options.scale, snapshot
        self._renderer = MapRenderer()
        self._eyes = _eyes(rig, options)

    @property
    def scale(self) -> TemperatureScale | None:
        """Scale of all pictures; None before the first that shows a temperature."""
        return self._scale

    def view(self, scan: Scan) -> Rgb:
        """(H, W, 3) sRGB: the picture of a scan.

        Two side by side are twice as wide; one lower than 240 pixels is enlarged by a whole number.

        Raises:
            BadInputError: an image does not fit its camera, or that of the camera to look through is missing.
        """
        # Stage 1: each eye's pixels, with the values of the other spectrum.
        beyond = None
        if self._snapshot is not None:
            beyond = mirror_pixels(scan, self._rig, self._snapshot, renderer=self._renderer)
        fused = [fuse(scan, self._rig, camera, beyond) for camera in self._eyes]
        if self._options.mode is ViewMode.COLOUR_ON_THERMAL:
            return self._colour_on_thermal(scan, fused[0])
        # Stage 2: paint, on one scale for all pictures of the view.
        pictures, places = [], self._hottest(fused)
        for each, place in zip(fused, places, strict=True):
            base, kelvin = scan.colour[each.camera], each.values[..., 0]
            # Every fourth pixel each way: a scale is two percentiles, which need no more.
            scale = self._locked(np.where(each.ok, kelvin, np.float32(np.nan))[::4, ::4])
            if self._options.mode is ViewMode.SIDE_BY_SIDE:
                pictures += [enlarge(base), self._finished(paint_alone(kelvin, each.labels, scale), place)]
            else:
                picture = paint_over(base, kelvin, each.labels, scale, self._options.emphasis)
                pictures.append(self._finished(picture, place))
            # Without this line a picture in colour alone would look as if all were cold.
            if not each.sources:
                write_into(pictures[-1], "no thermal image", (12, len(pictures[-1]) - 12))
        return pictures[0] if len(pictures) == 1 else np.hstack(pictures)

    def _hottest(self, fused: Sequence[CrossView]) -> list[Hottest | None]:
        """Place to mark for each eye: the same for both, or the eyes could not merge the pictures."""
        first = hottest(fused[0].values[..., 0], fused[0].labels)
        return [first, *(first and find_in(first, fused[0], each, self._rig) for each in fused[1:])]

    def _colour_on_thermal(self, scan: Scan, fused: CrossView) -> Rgb:
        kelvin = scan.thermal[fused.camera]
        scale, known = self._locked(kelvin[::4, ::4]), np.where(np.isfinite(kelvin), Label.OK, Label.NO_READING)
        labels, alone = known.astype(np.uint8), Emphasis(alpha=1.0)
        warm = paint_over(np.full((*kelvin.shape, 3), 40, np.uint8), kelvin, labels, scale, alone)
        # Where no colour is known the palette stands alone, for the temperature is known.
        base = np.where(fused.ok[..., None], np.nan_to_num(fused.values).clip(0, 255).astype(np.uint8), warm)
        picture = paint_over(base, kelvin, labels, scale, self._options.emphasis)
        return self._finished(picture, hottest(kelvin, labels))

    def _locked(self, kelvin: npt.NDArray[np.float32]) -> TemperatureScale:
        # The first picture with a temperature decides: colours that change their meaning would mislead.
        if self._scale is None and np.isfinite(kelvin).any():
            self._scale = locked_scale(kelvin)
        return self._scale or TemperatureScale(273.15, 323.15, "no temperature yet")

    def _finished(self, picture: Rgb, place: Hottest | None) -> Rgb:
        """The picture with legend and marker; enlarged if it is small."""
        # Enlarged before the legend is drawn, whose letters would become coarse; the marker goes to the block's middle.
        times, larger = enlargement(picture), enlarge(picture)
        end = draw_legend_into(larger, self._scale or self._locked(np.empty(0, np.float32)))
        if place is not None and self._options.marks_hottest:
            middle = (times - 1) // 2
            there = replace(place, x=place.x * times + middle, y=place.y * times + middle)
            mark_hottest_into(larger, there, legend_end=end)
        return larger


def fuse(scan: Scan, rig: Rig, camera: str, beyond: npt.NDArray[np.bool_] | None = None) -> CrossView:
    """Values of the other spectrum's cameras at each pixel of a colour or thermal camera, through its depth.

    Of several cameras of that spectrum the nearest has priority.

    Args:
        scan: with the camera's image, and any images of the other spectrum.
        rig: of the scan.
        camera: camera with the pixels.
        beyond: (H, W) true for range pixels that show a reflection (`mirror_pixels`): nothing is painted there.

    Raises:
        BadInputError: an image does not fit its camera, the camera's own is missing, or it has none.
    """
    check_scan(scan, rig)
    images = source_order(scan, rig, camera)
    # Range image to surface, surface to each camera, and dense depth for the one camera.
    surface = surface_of(scan, rig, beyond)
    drawn = {name: drawn_surface(surface, rig, name) for name in (camera, *images)}
    depth = view_depth(scan, rig, camera, drawn[camera])
    fused = cross_view(depth, rig, images, drawn=drawn, range_camera=scan.range_camera)
    return fused if beyond is None else mask_mirrors(fused)


def mask_mirrors(fused: CrossView) -> CrossView:
    """The same, without values where depth was filled in over a reflection."""
    step, (height, width) = fused.depth.drawn.step_px, fused.labels.shape
    marked = (fused.depth.drawn.marks == Label.BEYOND).repeat(step, axis=0).repeat(step, axis=1)[:height, :width]
    # A measured range lies in front of the mirror, and stays; only filled-in depth may be the reflection's.
    marked &= fused.depth.origins != Origin.MEASURED
    labels = np.where(marked, np.uint8(Label.BEYOND), fused.labels)
    return replace(fused, labels=labels, values=np.where(marked[..., None], np.float32(np.nan), fused.values))


def source_order(scan: Scan, rig: Rig, camera: str) -> dict[str, Image]:
    """Images of the other spectrum than a camera's, that of the camera nearest to it first."""
    images: dict[str, Image] = dict(scan.thermal if camera in scan.colour else scan.colour)
    # The nearest camera sees almost what this one sees: the fewest places are hidden from it.
    place_m = rig[camera].transform[:3, 3]
    order = sorted(images, key=lambda name: float(np.linalg.norm(rig[name].transform[:3, 3] - place_m)))
    return {name: images[name] for name in order}


def find_in(place: Hottest, one: CrossView, other: CrossView, rig: Rig) -> Hottest | None:
    """Place of one camera's picture in another's, at the same temperature; None if that camera does not see it."""
    src, dst, range_m = rig[one.camera], rig[other.camera], one.depth.shown_m[place.y, place.x]
    # Eq. 1-6; the other camera sees the place if its own depth there agrees.
    point = src.camera.rays()[place.y, place.x] * float(range_m)
    there = transform_points(inverse(dst.transform) @ src.transform, point[None])
    pixel = dst.camera.project(there)
    if not dst.camera.contains(pixel)[0]:
        return None
    x, y = np.rint(pixel[0]).astype(int).tolist()
    away_m = float(np.linalg.norm(there))
    is_seen = abs(float(other.depth.shown_m[y, x]) - away_m) < SAME_SHARE * away_m
    return replace(place, x=x, y=y) if is_seen else None


def view_depth(scan: Scan, rig: Rig, camera: str, drawn: Drawn) -> DenseDepth:
    """Dense depth of a colour or thermal camera's pixels, with its own image as guide.

    Raises:
        BadInputError: the scan has no image of it.
    """
    own: Mapping[str, Image] = {**scan.colour, **scan.thermal}
    if camera not in own:
        there = ", ".join(own) or "none"
        raise BadInputError("missing_image", f"the scan has no image of {camera!r}; it has {there}")
    return dense_depth(drawn, rig, camera, own[camera], range_camera=scan.range_camera)


def _eyes(rig: Rig, options: ViewOptions) -> list[str]:
    """The cameras to look through."""
    wanted = Spectrum.THERMAL if options.mode is ViewMode.COLOUR_ON_THERMAL else Spectrum.COLOUR
    names, count = rig.of_spectrum(wanted), 2 if options.mode is ViewMode.STEREO else 1
    if len(names) < count:
        raise BadInputError(
            "missing_camera", f"{options.mode} needs {count} {wanted} camera(s), {rig.name} has {len(names)}"
        )
    if count == 2:
        # The left eye is the one farther left in the first one's own view.
        x = [float(rig[names[0]].transform[:3, 0] @ rig[name].transform[:3, 3]) for name in names[:2]]
        return names[:2] if x[0] < x[1] else names[1::-1]
    if options.camera is None:
        return names[:1]
    if rig[options.camera].spectrum is not wanted:
        raise BadInputError(
            "missing_camera", f"{options.mode} looks through one of {', '.join(names)}, got {options.camera}"
        )
    return [options.camera]
