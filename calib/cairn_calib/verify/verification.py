"""Verification of a rig by targets carried from its range camera to the others: chapter V of Kocmanova et al.

    targets in the range camera's amplitude --range of the matt middle--> Eq. 1-6 --> predicted pixel in each camera
    targets in that camera's own image ---------------------------------------------> found pixel, if near enough
    difference = predicted - found

Each difference comes with its expected standard deviations, by source: the calibration (the rig's own covariance), the
two centroids, the range. The perspective of a tilted disc moves its centroid off its centre's image, in both images
alike.

A target's range is that of a robust plane over all pixels of its middle that have a range (`disc_range`): the tape on
its rim returns too much light and has none, the matt black middle has.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from cairn_calib.rig.lens import Lens
from cairn_calib.rig.poses import inverse, transform_points
from cairn_calib.rig.projection_uncertainty import transfer_certain
from cairn_calib.rig.raster import Raster
from cairn_calib.rig.rig import MountedCamera, Rig, Spectrum
from cairn_calib.verify.disc_images import Disc, Method, brightness_of, find_discs
from cairn_map.arrays import Floats
from cairn_map.errors import BadInputError

RANGE_PIXELS_MIN = 3
"""Pixels of a target's middle with a range, at least: a plane has three numbers."""
SLANT_SIGMA = 0.6
"""Prior standard deviation of the tangent of the target's tilt: 31 degrees."""
RELIEF_SIGMA_M = 0.0012
"""Standard deviation of the target's relief: paper, aluminium and tape lie on one another, and light mixes at their
edges. On simulated targets, half a millimetre apart, ranges come out 1.2 mm too long for any number of pixels."""
PLANE_ROUNDS = 10
"""Rounds of reweighting."""
TUKEY_SIGMAS = 4.685
"""Robust standard deviations beyond which a pixel has no weight (Tukey's biweight)."""

Image = npt.NDArray[np.generic]

GATE_SIGMAS = 3.0
"""Standard deviations beyond the target's own outline within which it must be found."""
SIZE_FACTOR = 1.7
"""Largest ratio between the radius that is found and the one predicted by the range camera's."""
STEP_PX, STEP_M = 0.5, 1e-3
"""Steps of the differences that approximate derivatives of a predicted pixel, good to 1e-4 of them."""
CENTROID_SIGMA_PX: Mapping[Method, Mapping[Spectrum, float]] = {
    "paper": {Spectrum.RANGE: 0.19, Spectrum.COLOUR: 0.14, Spectrum.THERMAL: 0.085},
    "grey": {Spectrum.RANGE: 0.088, Spectrum.COLOUR: 0.15, Spectrum.THERMAL: 0.085},
}
"""Standard deviation of a centroid, one axis, own pixels; by simulated targets (tests/cairn_sim/study/test_study.py)"""


@dataclass(frozen=True, slots=True, kw_only=True)
class TargetSighting:
    """One target: seen by the range camera, carried to another, and found there."""

    image: str
    camera: str
    source_px: Floats
    """(2,) centroid in the range camera."""
    radius_px: float
    """Distance of `source_px` from the range camera's principal point: the paper's "ToF image radius"."""
    range_m: float
    predicted_px: Floats
    """(2,) predicted centroid in the other camera."""
    found_px: Floats
    """(2,) centroid found in the other camera."""
    disc_px: float
    """Radius of the target in the other camera."""
    shares_px: Mapping[str, Floats]
    """(2,) expected standard deviations of x and y by source: `calibration` (absent without a covariance in the rig),
    `centroid`, `range`."""

    @property
    def difference_px(self) -> Floats:
        """(2,) predicted minus found."""
        return self.predicted_px - self.found_px


@dataclass(slots=True)
class Sightings:
    """Sightings in a set of images, and the number of targets left out, by reason."""

    rig: Rig
    source: str
    """The range camera."""
    method: Method
    sights: list[TargetSighting] = field(default_factory=list)
    left_out: dict[str, int] = field(default_factory=dict)
    images: int = 0
    targets: int = 0
    """Number of targets that the range camera saw, with a range."""

    def of_camera(self, name: str) -> list[TargetSighting]:
        """Sightings of one camera."""
        return [sight for sight in self.sights if sight.camera == name]

    @property
    def cameras(self) -> list[str]:
        """Cameras with a lens, except the range camera, in the rig's order."""
        return [
            name for name, each in self.rig.cameras.items() if name != self.source and isinstance(each.camera, Lens)
        ]

    def note(self, reason: str) -> None:
        """Count one more target that is left out."""
        self.left_out[reason] = self.left_out.get(reason, 0) + 1


@dataclass(frozen=True, slots=True)
class PoseTargets:
    """Targets in the images of one head pose, which depend on no calibration."""

    image: str
    range_m: Image
    """(H, W) of the range camera, metres along the beam."""
    discs: Mapping[str, Sequence[Disc]]
    """By camera."""
    amplitude: Image | None = None
    """(H, W) of the range camera, counts; None where unknown."""


def range_camera_of(rig: Rig) -> str:
    """The one camera that measures range and has a lens.

    Raises:
        BadInputError: there is none.
    """
    for name in rig.of_spectrum(Spectrum.RANGE):
        if isinstance(rig[name].camera, Lens):
            return name
    raise BadInputError("no_range_camera", f"rig {rig.name} has no range camera with a lens, so nothing to verify")


def find_targets(rig: Rig, images: Mapping[str, Image], range_m: Image, *, name: str, method: Method) -> PoseTargets:
    """Find the targets in the images of one head pose.

    Args:
        rig: names and spectra of the cameras; its calibration is not used.
        images: by camera: amplitude, (H, W, 3) colour R, G, B, or temperature.
        range_m: (H, W) ranges of the range camera, metres.
        name: name of the pose, for people.
        method: kind of centroid.
    """
    # The same detector for every spectrum, on an image in which targets are bright.
    discs = {
        camera: find_discs(brightness_of(image, rig[camera].spectrum), rig[camera].spectrum, method=method)
        for camera, image in images.items()
    }
    amplitude = next((each for camera, each in images.items() if rig[camera].spectrum is Spectrum.RANGE), None)
    return PoseTargets(name, range_m, discs, amplitude)


def add_sights(
    into: Sightings, found: PoseTargets, *, centroid_sigma_px: Mapping[Spectrum, float] | None = None
) -> None:
    """Carry the range camera's targets of one pose to the other cameras, and keep those that were found there.

    Args:
        into: the sightings, which grow.
        found: the targets of the pose.
        centroid_sigma_px: standard deviation of a centroid, one axis, by spectrum; None for those of the method.
    """
    rig, source = into.rig, into.source
    sigmas = centroid_sigma_px or CENTROID_SIGMA_PX[into.method]
    into.images += 1
    # Targets of the range camera with their range, without the camera's bias.
    range_m = rig[source].true_ranges(np.asarray(found.range_m, np.float64), found.amplitude)
    carried = []
    for disc in found.discs.get(source, ()):
        measured = disc_range(disc, range_m, rig[source])
        # A disc without range cannot be carried.
        if measured is None:
            into.note(f"{source}: no range on its middle")
            continue
        into.targets += 1
        carried.append((disc, *measured))
    # In each other camera: predict, and take the nearest disc of about the right size, each only once.
    for camera in into.cameras:
        if camera not in found.discs:
            continue
        free = list(found.discs[camera])
        for disc, distance_m, range_sigma_m in carried:
            # Eq. 1 to 6, with the standard deviation by each source.
            predicted, shares = _predict(rig, source, camera, disc.centroid, distance_m, range_sigma_m, sigmas)
            lens = rig[camera].camera
            radius_px = disc.radius_px * _focal(rig, camera) / _focal(rig, source)
            if not _is_within(lens, predicted, radius_px):
                into.note(f"{camera}: not wholly in its view")
                continue
            near = _nearest(free, predicted, shares, radius_px)
            if near is None:
                into.note(f"{camera}: not found where predicted")
                continue
            # A disc that is taken serves no second target.
            free.remove(near)
            into.sights.append(
                TargetSighting(
                    image=found.image,
                    camera=camera,
                    source_px=disc.centroid,
                    radius_px=float(np.linalg.norm(disc.centroid - np.array(_lens(rig, source).centre_px))),
                    range_m=distance_m,
                    predicted_px=predicted,
                    found_px=near.centroid,
                    disc_px=near.radius_px,
                    shares_px=shares,
                )
            )


def transfer_pixels(rig: Rig, source: str, target: str, pixels: Floats, range_m: Floats) -> Floats:
    """(..., 2) where pixels with ranges of one camera appear in another: Eq. 1 to 6, with the lenses of both."""
    # Source pixel -> ray times range -> target's frame -> target pixel.
    T_target_source = inverse(rig[target].transform) @ rig[source].transform
    points = rig[source].camera.unproject(pixels) * np.asarray(range_m, np.float64)[..., None]
    return rig[target].camera.project(transform_points(T_target_source, points))


def source_pixel_in(rig: Rig, source: str, target: str) -> float:
    """Width of a range camera's pixel in pixels of another camera: the ratio of their focal lengths."""
    return _focal(rig, target) / _focal(rig, source)


def _predict(
    rig: Rig,
    source: str,
    target: str,
    pixel: Floats,
    range_m: float,
    range_sigma_m: float,
    sigmas: Mapping[Spectrum, float],
) -> tuple[Floats, dict[str, Floats]]:
    """(2,) predicted pixel, and (2,) standard deviation of the difference by each source."""
    # Central differences by x, y and range.
    steps = np.array([[0, 0, 0], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], np.float64)
    at = transfer_pixels(rig, source, target, pixel + STEP_PX * steps[:, :2], range_m + STEP_M * steps[:, 2])
    by_x, by_y = (at[1] - at[2]) / (2 * STEP_PX), (at[3] - at[4]) / (2 * STEP_PX)
    by_range = (at[5] - at[6]) / (2 * STEP_M)
    # Both centroids are noisy: the source's is carried along, the target's is its own.
    source_px, own_px = sigmas[rig[source].spectrum], sigmas[rig[target].spectrum]
    shares = {
        "centroid": np.sqrt(source_px**2 * (by_x**2 + by_y**2) + own_px**2),
        "range": np.abs(by_range) * range_sigma_m,
    }
    if rig.calibration is not None and rig.calibration.covariance is not None:
        known = transfer_certain(rig, source, target, pixel, np.array(range_m)).calibration_px2
        shares["calibration"] = np.sqrt(np.maximum(np.diagonal(known), 0))
    return at[0], shares


def _is_within(lens: Raster, pixel: Floats, radius_px: float) -> bool:
    """True if a disc about a pixel lies in the image."""
    edge = np.array([lens.width - 1, lens.height - 1])
    return bool(np.isfinite(pixel).all() and (pixel >= radius_px).all() and (pixel <= edge - radius_px).all())


def _nearest(discs: Sequence[Disc], predicted: Floats, shares: Mapping[str, Floats], radius_px: float) -> Disc | None:
    """The disc of about the right size nearest to the prediction, within the target's own outline and 3 sigma."""
    # All sources together, both axes.
    sigma = float(np.sqrt(sum(float(share @ share) for share in shares.values())))
    # A disc of another size is another thing.
    sized = [disc for disc in discs if 1 / SIZE_FACTOR < disc.radius_px / radius_px < SIZE_FACTOR]
    if not sized:
        return None
    near = min(sized, key=lambda disc: float(np.linalg.norm(disc.centroid - predicted)))
    return near if np.linalg.norm(near.centroid - predicted) < radius_px + GATE_SIGMAS * sigma else None


def _lens(rig: Rig, camera: str) -> Lens:
    lens = rig[camera].camera
    if not isinstance(lens, Lens):
        raise BadInputError("no_lens", f"{camera} is a lidar: it has no image of targets")
    return lens


def _focal(rig: Rig, camera: str) -> float:
    return float(np.mean(_lens(rig, camera).focal_px))


def disc_range(disc: Disc, range_m: npt.NDArray[np.floating], mounted: MountedCamera) -> tuple[float, float] | None:
    """Range along the beam through a target's centroid, and its standard deviation, metres; None without a range.

    On a plane with the vector n, n . X = 1, a beam along the unit vector b ends at the range d with 1 / d = n . b. That
    is linear in n, for a lens that distorts, too. Where few pixels are left, a weak prior makes the target face the
    camera. Noise of the pixels falls with their number; the target's relief and the uncertainty of the camera's range
    bias, which all of them share, do not.

    Args:
        disc: a target found in the camera's amplitude.
        range_m: (H, W), metres along the beam; NaN where nothing came back.
        mounted: the range camera.
    """
    x, y = disc.pixels.T
    d = np.asarray(range_m, np.float64)[y, x]
    seen = np.isfinite(d)
    if seen.sum() < RANGE_PIXELS_MIN:
        return None
    d = d[seen]
    # n in a frame along the target's beam: its first number is 1 / range there, the other two the tilt.
    beams = mounted.camera.unproject(disc.pixels[seen].astype(np.float64))
    axis = mounted.camera.unproject(disc.centroid)
    sideways = np.linalg.svd(axis[None])[2][1:]
    terms = beams @ np.vstack([axis, sideways]).T
    # Noise of 1 / d, and the prior of the tilt.
    sigma = np.maximum(mounted.range_noise_m(d), 1e-6) / d**2
    middle = float(np.median(1 / d))
    prior = np.diag([0.0, 1.0, 1.0]) / (SLANT_SIGMA * middle) ** 2
    weight = np.ones(len(d))
    n, normal = np.array([middle, 0.0, 0.0]), prior
    # Iteratively reweighted least squares.
    for _ in range(PLANE_ROUNDS):
        left = (1 / d - terms @ n) / sigma
        # Robust scale by the median absolute deviation, at least the stated noise.
        spread = max(1.0, 1.4826 * float(np.median(np.abs(left - np.median(left)))))
        weight = np.maximum(0, 1 - (left / (TUKEY_SIGMAS * spread)) ** 2) ** 2 / (sigma * spread) ** 2
        if (weight > 0).sum() < RANGE_PIXELS_MIN:
            return None
        normal = (terms * weight[:, None]).T @ terms + prior
        n = np.linalg.solve(normal, (terms * weight[:, None]).T @ (1 / d))
    distance = float(1 / n[0])
    if not distance > 0:
        return None
    # d = 1 / n0, so sigma_d = d^2 sigma_n0. Noise, bias and relief are independent.
    noise = distance**2 * float(np.sqrt(np.linalg.inv(normal)[0, 0]))
    bias = 0.0 if mounted.range_bias is None else float(mounted.range_bias.sigma_at(np.array(distance)))
    return distance, float(np.linalg.norm([noise, bias, RELIEF_SIGMA_M]))
