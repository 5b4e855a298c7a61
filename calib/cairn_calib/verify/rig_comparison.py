"""Two calibrations of the same cameras, compared by the pixels that they give the same points, with the uncertainty of
both.

Numbers of two calibrations cannot be compared one by one: a shifted principal point and a turned camera make nearly the
same images. So pixels are compared, over the whole image and at a distance:

    a lens       pixel of A -> point -> [R | t] -> pixel of B        [R | t] is fitted: what "ahead" means is each
                                                                     calibration's own (at infinity R alone)
    a pair       pixel of one camera -> point -> pixel of another, by A and by B; nothing is fitted

The expected difference comes from both covariances, taken as independent, carried through the fit. After the projection
difference of mrcal (Kogan, "mrcal-show-projection-diff"); the score and its limit are ours.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cairn_calib.diagnosis.probe_points import image_grid
from cairn_calib.rig.lens import Lens
from cairn_calib.rig.pose_vectors import cross_matrix, transform_from_vector
from cairn_calib.rig.poses import Transform
from cairn_calib.rig.projection_uncertainty import Moves, mounted_lens, transfer_moves
from cairn_calib.rig.rig import Rig
from cairn_map.arrays import Floats
from cairn_map.errors import BadInputError

COLUMNS = 24
"""Columns of a map over an image."""
INFINITE_M = 1e6
"""Distance that stands for infinity where a pixel is carried to another camera."""
FLOOR_PX = 1e-3
"""Standard deviation, pixels, below which no difference counts: files round their numbers."""
LIMIT_SHARE = 0.01
"""Share of calibrations that agree and are called different all the same, over all comparisons of two rigs."""
DRAWS = 20_000
"""Draws of the score by chance: its limit, of one in some hundreds, comes out to some per cent."""
MIDDLE_SHARE = 1 / 3
"""Radius, as a share of the image's shorter side, within which a lens is fitted where no uncertainty is stated."""
ROUNDS, STEP_MIN = 20, 1e-10


@dataclass(frozen=True, slots=True)
class PixelComparison:
    """Differences over one camera's image at one distance."""

    camera: str
    source: str | None
    """Camera whose pixels are carried to this one; None: the lens alone is compared."""
    range_m: float
    """Distance of the points, along the beam; may be infinite."""
    difference_px: Floats
    """(rows, columns, 2) pixels of B less those of A; NaN where one of them sees nothing."""
    sigma_px: Floats | None
    """(rows, columns) standard deviation that both covariances predict, one axis; None where one states none."""
    at_px: Floats
    """(rows, columns, 2) pixels of the map's places, of this camera, by A."""
    T_b_a: Transform
    """Frame of the camera by A, as seen from that by B: fitted; the identity for a pair."""
    score: float | None
    """Mean over the image of the squared difference in its own standard deviations, of one axis: 1 is expected."""
    limit: float | None
    """Score that calibrations that agree exceed once in a hundred."""

    @property
    def lengths_px(self) -> Floats:
        """(rows, columns) lengths of the differences, as those of one axis: over sqrt(2)."""
        lengths: Floats = np.sqrt(np.sum(self.difference_px**2, axis=-1) / 2)
        return lengths

    @property
    def rms_px(self) -> float:
        """Root mean square difference, one axis."""
        return float(np.sqrt(np.nanmean(self.lengths_px**2)))

    @property
    def expected_px(self) -> float | None:
        """Root mean square of what is expected, one axis."""
        return None if self.sigma_px is None else float(np.sqrt(np.nanmean(self.sigma_px**2)))

    @property
    def agrees(self) -> bool | None:
        """True if the difference is within the stated uncertainty; None where that is not stated."""
        return None if self.score is None or self.limit is None else self.score <= self.limit


def compare_rigs(
    a: Rig, b: Rig, cameras: Sequence[tuple[str, str]], ranges_m: Sequence[float]
) -> tuple[PixelComparison, ...]:
    """Comparisons of pairs of cameras of the same name or, of single cameras, of any: their lenses, then their places.

    Args:
        a: one calibration.
        b: the other.
        cameras: name in `a`, name in `b`; results have that of `a`.
        ranges_m: distances of the points; infinite, too.

    Raises:
        BadInputError: a camera's images have two sizes, or a camera is a lidar.
    """
    source = _source(a, [name for name, _ in cameras])
    other = dict(cameras)
    pairs = [name for name, _ in cameras if name != source and len(cameras) > 1]
    # Each comparison may fail by chance; all together, once in a hundred pairs of calibrations.
    share = LIMIT_SHARE / (len(ranges_m) * (len(cameras) + len(pairs)))
    found = [_compare_lens(a, b, each, range_m, share) for each in cameras for range_m in ranges_m]
    for name in pairs:
        names = {"a": (source, name), "b": (other[source], other[name])}
        found += [_compare_pair(a, b, names, range_m, share) for range_m in ranges_m]
    return tuple(found)


def _source(rig: Rig, names: Sequence[str]) -> str:
    """The camera that others are compared from: the gauge, else the first."""
    if rig.calibration is not None and rig.calibration.gauge in names:
        return rig.calibration.gauge
    return names[0]


def _compare_lens(a: Rig, b: Rig, names: tuple[str, str], range_m: float, share: float) -> PixelComparison:
    lens_a, lens_b = mounted_lens(a, names[0]), mounted_lens(b, names[1])
    _check_sizes(names[0], lens_a, lens_b)
    grid, shape = _grid(lens_a)
    # 1. Points that A sees at the grid's pixels; at infinity their length is nothing.
    seen = lens_a.unprojection(grid)
    is_near = np.isfinite(range_m)
    points = (range_m if is_near else 1.0) * seen.rays
    roots = _own_roots(a, b, names)
    # 2. Fit of [R | t], weighted by what is expected; twice, for weights depend on it a little.
    T = np.eye(4)
    for _ in range(2):
        weights = (
            _middle(lens_a, grid)
            if roots is None
            else _inverses(_lens_root(lens_b, seen.by_intrinsics, points, T, roots))
        )
        T = _fit(lens_b, points, grid, T, weights, is_near=is_near)
    # 3. What is left, and what is expected of it: the fit takes its part of the error, too.
    there = lens_b.projection(points @ T[:3, :3].T + T[:3, 3])
    left = there.pixels - grid
    if roots is None:
        return PixelComparison(names[0], None, range_m, *_maps(left, None, grid, shape), T, None, None)
    root = _lens_root(lens_b, seen.by_intrinsics, points, T, roots)
    root = _left_after_fit(root, _by_pose(there.by_point, points, T, is_near=is_near), _inverses(root))
    score, limit = _score(left, root, share)
    return PixelComparison(names[0], None, range_m, *_maps(left, root, grid, shape), T, score, limit)


def _compare_pair(
    a: Rig, b: Rig, names: Mapping[str, tuple[str, str]], range_m: float, share: float
) -> PixelComparison:
    far_m = range_m if np.isfinite(range_m) else INFINITE_M
    grid, shape = _grid(mounted_lens(a, names["a"][0]))
    far = np.full(len(grid), far_m)
    (pixels_a, moves_a), (pixels_b, moves_b) = (
        transfer_moves(rig, *names[which], grid, far) for which, rig in (("a", a), ("b", b))
    )
    pixels_a = np.where(mounted_lens(a, names["a"][1]).contains(pixels_a)[:, None], pixels_a, np.nan)
    left = pixels_b - pixels_a
    roots = _moved_root(a, moves_a), _moved_root(b, moves_b)
    head = (names["a"][1], names["a"][0], range_m)
    if roots[0] is None or roots[1] is None:
        return PixelComparison(*head, *_maps(left, None, pixels_a, shape), np.eye(4), None, None)
    root = np.concatenate([roots[0], roots[1]], axis=-1)
    score, limit = _score(left, root, share)
    return PixelComparison(*head, *_maps(left, root, pixels_a, shape), np.eye(4), score, limit)


def _grid(lens: Lens) -> tuple[Floats, tuple[int, int]]:
    rows = max(1, round(COLUMNS * lens.height / lens.width))
    return image_grid(lens.width, lens.height, COLUMNS, rows), (rows, COLUMNS)


def _check_sizes(name: str, one: Lens, other: Lens) -> None:
    if (one.width, one.height) != (other.width, other.height):
        raise BadInputError(
            "other_images",
            f"{name} has images of {one.width} x {one.height} pixels in one calibration and of {other.width} x "
            f"{other.height} in the other: calibrations compare for images of one size",
        )


def _maps(
    left: Floats, root: Floats | None, at: Floats, shape: tuple[int, int]
) -> tuple[Floats, Floats | None, Floats]:
    """Differences, standard deviations and places as maps."""
    sigma = None if root is None else np.sqrt(np.sum(root**2, axis=(1, 2)) / 2)
    if sigma is not None:
        sigma = np.where(np.isfinite(left[:, 0]), sigma, np.nan).reshape(shape)
    return left.reshape(*shape, 2), sigma, at.reshape(*shape, 2)


def _own_roots(a: Rig, b: Rig, names: tuple[str, str]) -> tuple[Floats, Floats] | None:
    """Roots of both lenses' covariances; None where one rig states none."""
    one, other = _own_root(a, names[0]), _own_root(b, names[1])
    return None if one is None or other is None else (one, other)


def _own_root(rig: Rig, camera: str) -> Floats | None:
    """(P, K) a root L of the covariance L L^T of a lens's intrinsics; None where the rig states none."""
    if rig.calibration is None or rig.calibration.covariance is None:
        return None
    intrinsics = mounted_lens(rig, camera).intrinsic_names
    named = [(each.camera, each.name) for each in rig.calibration.covariance.parameters]
    held = [n for n, (owner, name) in enumerate(named) if owner == camera and name in intrinsics]
    root = np.zeros((len(intrinsics), len(held)))
    at = [intrinsics.index(named[n][1]) for n in held]
    root[at] = _root(rig.calibration.covariance.matrix[np.ix_(held, held)])
    return root


def _moved_root(rig: Rig, moves: Moves) -> Floats | None:
    """(N, 2, K) a root of the covariance of carried pixels; None where the rig states none."""
    if rig.calibration is None or rig.calibration.covariance is None:
        return None
    named = [(each.camera, each.name) for each in rig.calibration.covariance.parameters]
    used = [n for n, parameter in enumerate(named) if parameter in moves]
    J = np.stack([moves[named[n]] for n in used], axis=-1)
    return np.asarray(J @ _root(rig.calibration.covariance.matrix[np.ix_(used, used)]))


def _root(covariance: Floats) -> Floats:
    """L with L L^T = C, for a C that may have no inverse."""
    scale = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    root: Floats = scale[:, None] * vectors * np.sqrt(np.maximum(values, 0))
    return root


def _lens_root(
    lens_b: Lens, by_intrinsics_a: Floats, points: Floats, T: Transform, roots: tuple[Floats, Floats]
) -> Floats:
    """(N, 2, K) a root of the covariance of B's pixels of A's points, by both lenses."""
    there = lens_b.projection(points @ T[:3, :3].T + T[:3, 3])
    length = np.linalg.norm(points, axis=-1)[:, None, None]
    by_a = there.by_point @ T[:3, :3] @ (length * by_intrinsics_a)
    return np.concatenate([by_a @ roots[0], there.by_intrinsics @ roots[1]], axis=-1)


def _inverses(root: Floats) -> Floats:
    """(N, 2, 2) inverses of the pointwise covariances; 0 where they are not known."""
    covariance = root @ np.swapaxes(root, 1, 2) + FLOOR_PX**2 * np.eye(2)
    known = np.isfinite(covariance).all(axis=(1, 2))
    inverses = np.zeros_like(covariance)
    inverses[known] = np.linalg.inv(covariance[known])
    return inverses


def _middle(lens: Lens, grid: Floats) -> Floats:
    """(N, 2, 2) weights: 1 in the middle of the image, 0 elsewhere."""
    middle = np.array([lens.width - 1, lens.height - 1]) / 2
    near = np.linalg.norm(grid - middle, axis=1) < MIDDLE_SHARE * min(lens.width, lens.height)
    return np.where(near[:, None, None], np.eye(2), 0.0)


def _by_pose(by_point: Floats, points: Floats, T: Transform, *, is_near: bool) -> Floats:
    """(N, 2, 6 or 3) pixels by a small turn about B's axes and, of near points, a small shift."""
    turned = by_point @ -cross_matrix(points @ T[:3, :3].T)
    return np.concatenate([turned, by_point], axis=-1) if is_near else turned


def _fit(lens: Lens, points: Floats, pixels: Floats, T: Transform, weights: Floats, *, is_near: bool) -> Transform:
    """The [R | t] by which `lens` sees the points at the pixels, by weighted least squares (Gauss-Newton)."""
    for _ in range(ROUNDS):
        there = lens.projection(points @ T[:3, :3].T + T[:3, 3])
        J = _by_pose(there.by_point, points, T, is_near=is_near)
        good = np.isfinite(there.pixels).all(axis=1) & np.isfinite(J).all(axis=(1, 2)) & (weights[:, 0, 0] > 0)
        JW = np.swapaxes(J[good], 1, 2) @ weights[good]
        misses = (there.pixels - pixels)[good]
        step = -np.linalg.lstsq((JW @ J[good]).sum(axis=0), (JW @ misses[..., None]).sum(axis=0)[:, 0], rcond=None)[0]
        moved = transform_from_vector([*step, 0.0, 0.0, 0.0] if not is_near else step)
        # The turn is about B's origin after the shift so far: only R turns, t gets the step's own.
        T = T.copy()
        shift = T[:3, 3] + moved[:3, 3]
        T[:3, :3] = moved[:3, :3] @ T[:3, :3]
        T[:3, 3] = shift
        if np.abs(step).max(initial=0.0) < STEP_MIN:
            break
    return T


def _left_after_fit(root: Floats, by_pose: Floats, weights: Floats) -> Floats:
    """(N, 2, K) a root of the covariance after the fit: (I - J (J^T W J)^-1 J^T W) L."""
    known = (weights[:, 0, 0] > 0) & np.isfinite(by_pose).all(axis=(1, 2))
    J, L, W = by_pose[known], root[known], weights[known]
    JW = np.swapaxes(J, 1, 2) @ W
    taken = np.linalg.lstsq((JW @ J).sum(axis=0), (JW @ L).sum(axis=0), rcond=None)[0]
    left = np.full_like(root, np.nan)
    left[known] = L - J @ taken
    return left


def _score(left: Floats, root: Floats, share: float) -> tuple[float | None, float | None]:
    """The score of the differences, and the one that calibrations that agree exceed with probability `share`.

    The score is a sum of weighted squares of the K standard normal errors; its distribution is drawn, from one seed.
    """
    known = np.isfinite(left).all(axis=1) & np.isfinite(root).all(axis=(1, 2))
    if not known.any():
        return None, None
    W, e, L = _inverses(root[known]), left[known], root[known]
    score = float(np.einsum("ni,nij,nj->", e, W, e) / (2 * len(e)))
    M = np.einsum("nik,nij,njl->kl", L, W, L, optimize=True) / (2 * len(e))
    values = np.maximum(np.linalg.eigvalsh(M), 0)
    draws: npt.NDArray[np.float64] = np.random.default_rng(0).chisquare(1, size=(DRAWS, len(values))) @ values
    return score, float(np.quantile(draws, 1 - share)) + 1.0 - float(values.sum())
