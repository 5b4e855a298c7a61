"""Images of a scene: every camera's rays cast exactly, then each sensor's own imperfections.

    colour      texture x even light and one from afar, no shadows: a place has one colour from wherever it is seen
    thermal     apparent temperature: what a surface emits and what it mirrors of the surroundings
    range       metres along the beam; through glass and round mirrors, where the light goes
    amplitude   the camera's own light: falls with range squared, reflectivity and slant

Without noise the sensor is perfect: each pixel holds what the ray through its centre shows, to the last bit of the
image's type. With noise it is the camera of `sensors`, and the seed fixes every bit of it.
"""

import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from cairn_calib.rig.lidar import AnyCamera
from cairn_calib.rig.poses import Transform
from cairn_calib.rig.rig import Rig, Spectrum
from cairn_fusion.recording.scan import Scan
from cairn_map.arrays import Counts, Singles
from cairn_map.errors import BadInputError
from cairn_sim.render.image_kernels import (
    bloomed,
    colours,
    edge_pixels,
    finer_rays,
    mixed_waves,
    returns,
    surface_values,
)
from cairn_sim.render.raycast_kernels import Hits
from cairn_sim.render.rays import cast, cast_directions, tiles
from cairn_sim.render.sensors import COUNT_MAX, ColourSensor, Noise, RangeSensor, Sensor, ThermalSensor
from cairn_sim.scene.scene import Scene

Shade = Callable[[Hits], Singles]
"""Light that N hits send: (N,) or (N, 3)."""

LIGHT = np.array([0.45, 0.30, 0.84]) / np.linalg.norm([0.45, 0.30, 0.84])
"""Towards the light: above, and off both axes, so that no two walls look alike."""
AMBIENT = 0.7
SRGB_GAMMA = 2.2
"""Vignetting dims light, the image holds its root."""
EDGES_OF_BUNDLE = 8
SENSORS: Mapping[Spectrum, Sensor] = {
    Spectrum.COLOUR: ColourSensor(),
    Spectrum.THERMAL: ThermalSensor(),
    Spectrum.RANGE: RangeSensor(),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraView:
    """One camera in a scene: what is needed to render an image of it."""

    scene: Scene
    camera: AnyCamera
    T_map_camera: Transform
    hits: Hits
    """Through the centres of its pixels."""

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.camera.height, self.camera.width


@dataclass(frozen=True, slots=True, kw_only=True)
class ImageNoise:
    """The noise of one image: a generator, and the camera's fixed pattern, (H, W) standard normal."""

    rng: np.random.Generator
    pattern: Singles


def view_of(scene: Scene, rig: Rig, name: str, *, T_map_rig: Transform) -> CameraView:
    """A camera of a rig in a scene.

    Raises:
        BadInputError: no such camera, or it stands inside a solid.
    """
    mounted = rig[name]
    T_map_camera = T_map_rig @ mounted.transform
    hits = cast(scene, mounted.camera, T_map_camera, opaque=mounted.spectrum is Spectrum.THERMAL)
    return CameraView(scene=scene, camera=mounted.camera, T_map_camera=T_map_camera, hits=hits)


def render_scan(
    scene: Scene,
    rig: Rig,
    *,
    T_map_rig: Transform,
    range_camera: str,
    time_s: float,
    noise: Noise | None = None,
    number: int = 0,
    sensors: Mapping[str, Sensor] | None = None,
    threads: int | None = None,
) -> Scan:
    """All images of one head pose, at one time. Range cameras other than `range_camera` stay dark.

    Args:
        scene: what is there; what moves is where it is at `time_s` in every image.
        rig: the head.
        T_map_rig: where it truly is; the scan carries it as its pose.
        range_camera: the one that measures.
        time_s: UTC, seconds since 1970.
        noise: None for perfect sensors.
        number: of the scan in its recording; another number has other noise.
        sensors: by camera name, where it is not the spectrum's usual one.
        threads: at most so many images at once; None for one a core. The images do not depend on it.

    Raises:
        BadInputError: no such camera, not a range camera, or one of them stands inside a solid.
    """
    if rig[range_camera].spectrum is not Spectrum.RANGE:
        raise BadInputError("bad_scan", f"{range_camera} must be a range camera, it is {rig[range_camera].spectrum}")
    # Other range cameras would disturb the one that measures: they stay dark.
    names = [name for name, m in rig.cameras.items() if m.spectrum is not Spectrum.RANGE or name == range_camera]
    now = scene.at(time_s)

    def render(name: str) -> tuple[npt.NDArray[np.generic], ...]:
        view = view_of(now, rig, name, T_map_rig=T_map_rig)
        sensor = (sensors or {}).get(name, SENSORS[rig[name].spectrum])
        own = None
        if noise is not None:
            own = ImageNoise(rng=noise.of_image(name, number), pattern=noise.fixed_pattern(name, view.shape))
        return _images_of(view, sensor, own)

    images = dict(zip(names, _map_threads(render, names, threads), strict=True))
    range_m, amplitude = images[range_camera]
    return Scan(
        time_s=time_s,
        T_map_rig=T_map_rig,
        range_camera=range_camera,
        range_m=range_m.astype(np.float32, copy=False),
        amplitude=amplitude.astype(np.uint16, copy=False),
        colour={name: images[name][0].astype(np.uint8, copy=False) for name in rig.of_spectrum(Spectrum.COLOUR)},
        thermal={name: images[name][0].astype(np.float32, copy=False) for name in rig.of_spectrum(Spectrum.THERMAL)},
    )


def _images_of(view: CameraView, sensor: Sensor, noise: ImageNoise | None) -> tuple[npt.NDArray[np.generic], ...]:
    """The image of one camera, or range and amplitude of a range camera."""
    match sensor:
        case ColourSensor():
            return (colour_image(view, sensor, noise),)
        case ThermalSensor():
            return (thermal_image(view, sensor, noise),)
        case RangeSensor():
            return range_images(view, sensor, noise)


def _map_threads(
    render: Callable[[str], tuple[npt.NDArray[np.generic], ...]], names: Sequence[str], threads: int | None
) -> list[tuple[npt.NDArray[np.generic], ...]]:
    """Render by name, several cameras at once: kernels let go of the interpreter's lock."""
    workers = min(threads or os.cpu_count() or 1, len(names))
    if workers == 1:
        return [render(name) for name in names]
    with ThreadPoolExecutor(workers) as pool:
        return list(pool.map(render, names))


def colour_image(view: CameraView, sensor: ColourSensor, noise: ImageNoise | None) -> npt.NDArray[np.uint8]:
    """(H, W, 3) sRGB. The light multiplies sRGB values: radiance is not measured in the visible."""
    srgb, grains = view.scene.surfaces.colours_srgb, view.scene.shapes.texture[:, 4].copy()
    sky = np.array(view.scene.sky_srgb, dtype=np.float32)

    def shade(hits: Hits) -> Singles:
        return colours(hits, srgb, grains, sky, LIGHT, AMBIENT)

    values = _shaded(view, shade, 1 if noise is None else sensor.fineness, opaque=False).reshape(*view.shape, 3)
    if noise is not None:
        if sensor.vignetting:
            # cos^4 falls on light; sRGB is light to the power of 1 / gamma.
            cosine = np.nan_to_num(view.camera.rays()[..., 2:], nan=1.0).clip(0)
            values *= (cosine ** (4 * sensor.vignetting / SRGB_GAMMA)).astype(np.float32)
        # Blur of the lens first, then the sensor's noise, which it does not blur.
        values = _blurred(values, sensor.blur_px)
        values += sensor.sigma(values) * noise.rng.standard_normal(values.shape, dtype=np.float32)
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def thermal_image(view: CameraView, sensor: ThermalSensor, noise: ImageNoise | None) -> Singles:
    """(H, W) float32 kelvin, apparent: what the counts of `thermal_counts` mean."""
    if noise is not None:
        return sensor.kelvin_of(thermal_counts(view, sensor, noise).astype(np.float64)).astype(np.float32)
    radiance = _shaded(view, _radiance(view.scene, sensor), 1, opaque=True)
    return sensor.kelvin_of(radiance.astype(np.float64)).astype(np.float32).reshape(view.shape)


def thermal_counts(view: CameraView, sensor: ThermalSensor, noise: ImageNoise) -> Counts:
    """(H, W) uint16 raw counts; 1 to 65535."""
    shade = _radiance(view.scene, sensor)
    counts = _blurred(_shaded(view, shade, sensor.fineness, opaque=True).reshape(view.shape), sensor.blur_px)
    # Fixed pattern (the same in all images), then temporal noise (NETD).
    per_kelvin = np.float32(sensor.counts_per_kelvin)
    counts += np.float32(sensor.fixed_pattern_k) * per_kelvin * noise.pattern
    counts += np.float32(sensor.netd_k) * per_kelvin * noise.rng.standard_normal(view.shape, dtype=np.float32)
    return np.clip(np.rint(counts), 1, COUNT_MAX).astype(np.uint16)


def range_images(view: CameraView, sensor: RangeSensor, noise: ImageNoise | None) -> tuple[Singles, Counts]:
    """Range, (H, W) float32 metres along the beam, NaN where there is none; amplitude, (H, W) uint16 counts."""
    received = _returned(view, sensor, view.hits)
    range_m = view.hits.path_m.copy()
    if noise is None:
        # A perfect camera: farther than one wrap nothing is said.
        range_m[range_m > sensor.wrap_m] = np.nan
        received[np.isnan(range_m)] = 0
    else:
        # Stage 1: at edges the waves of all surfaces in a pixel add up.
        _mix_into(range_m, received, view, sensor)
        # Stage 2: full pixels spill into their neighbours.
        spill = sensor.spill(received, noise.rng)
        range_m, clean = bloomed(range_m, received, spill, view.camera.width, sensor.wrap_m)
        # Stage 3: noise of the amplitude, and pixels that are lost to too little or too much light.
        received = clean + np.float32(sensor.amplitude_sigma) * noise.rng.standard_normal(
            len(received), dtype=np.float32
        )
        lost = np.isinf(range_m) | (received < sensor.amplitude_min) | (received >= sensor.amplitude_max)
        # Stage 4: noise of the range, by the amplitude without noise; then the phase wraps.
        range_m += sensor.range_sigma_m(clean) * noise.rng.standard_normal(len(range_m))
        range_m[lost] = np.nan
        range_m %= sensor.wrap_m
    range_m[range_m <= 0] = np.nan
    amplitude = np.clip(np.rint(received), 0, COUNT_MAX).astype(np.uint16)
    return range_m.astype(np.float32).reshape(view.shape), amplitude.reshape(view.shape)


def _mix_into(range_m: npt.NDArray[np.float64], received: Singles, view: CameraView, sensor: RangeSensor) -> None:
    """Replace the pixels at edges by what the waves from all of their area add up to."""
    n = sensor.fineness
    edges, fine = _fine_hits(view, n, opaque=False)
    if len(edges):
        range_m[edges], received[edges] = mixed_waves(fine.path_m, _returned(view, sensor, fine), n * n, sensor.wrap_m)


def _returned(view: CameraView, sensor: RangeSensor, hits: Hits) -> Singles:
    """(N,) amplitude before noise and saturation."""
    s = view.scene.surfaces
    light = returns(hits, s.reflectivity_nir, s.gloss_nir, s.retroreflection)
    light *= np.float32(sensor.amplitude_at_1m)
    return light


def _radiance(scene: Scene, sensor: ThermalSensor) -> Shade:
    """Far infrared light of surfaces, in counts: their own, and the surroundings' share that they mirror."""
    s = scene.surfaces
    own = sensor.counts_of(s.temperature_k.astype(np.float64))
    mirrored = sensor.counts_of(np.array(scene.ambient_k))
    # Kirchhoff: a surface that emits the share e mirrors the share 1 - e.
    sent = (s.emissivity * own + (1 - s.emissivity.astype(np.float64)) * mirrored).astype(np.float32)
    sky = float(sensor.counts_of(np.array(scene.sky_k)))
    return lambda hits: surface_values(hits, sent, sky)


def _shaded(view: CameraView, shade: Shade, fineness: int, *, opaque: bool) -> Singles:
    """(N, ...) values of all pixels: of the ray through the centre, or the area's mean where it shows an edge."""
    values = shade(view.hits)
    edges, hits = _fine_hits(view, fineness, opaque=opaque)
    if len(edges):
        # Only pixels at edges are cast on finer rays; all others show one surface.
        fine = shade(hits)
        values[edges] = fine.reshape(len(edges), fineness * fineness, *fine.shape[1:]).mean(axis=1)
    return values


def _fine_hits(view: CameraView, fineness: int, *, opaque: bool) -> tuple[npt.NDArray[np.int64], Hits]:
    """(E,) pixels that show an edge, none for a fineness of 1; and what finer rays through their area meet."""
    order, _ = tiles(view.camera.width, view.camera.height)
    edges = edge_pixels(view.hits, view.camera.width, view.camera.height, order if fineness > 1 else order[:0])
    directions = finer_rays(view.camera.rays(), edges, fineness)
    bundle = EDGES_OF_BUNDLE * fineness**2
    return edges, cast_directions(view.scene, directions, view.T_map_camera, bundle=bundle, opaque=opaque)


def _blurred(values: Singles, sigma_px: float) -> Singles:
    return np.asarray(cv2.GaussianBlur(values, (0, 0), sigma_px), dtype=np.float32) if sigma_px else values
