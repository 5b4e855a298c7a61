"""Covariance of pixels: its gradients agree with differences, and what is the same camera cancels."""

import numpy as np
import numpy.typing as npt
import pytest

from cairn_calib.rig.calibration import POSE_UNITS, Calibration, covariance_from_matrix
from cairn_calib.rig.camera import Camera
from cairn_calib.rig.fisheye import FisheyeCamera
from cairn_calib.rig.lens import Lens
from cairn_calib.rig.pose_vectors import rotation_from_vector, transform_from_vector
from cairn_calib.rig.projection_uncertainty import project_certain, projection_moves, transfer_certain, transfer_moves
from cairn_calib.rig.rig import Rig, Spectrum, mount_camera
from cairn_map.errors import BadInputError

Floats = npt.NDArray[np.float64]
LENSES: dict[str, Lens] = {
    "tof": Camera(
        width=176, height=144, focal_px=(130.0, 131.0), centre_px=(88.3, 70.6), distortion=(-0.2, 0.06, 1e-3, 0.0, 0.0)
    ),
    "left": FisheyeCamera(
        width=640, height=480, focal_px=(200.0, 201.0), centre_px=(320.0, 240.0), distortion=(0.1, 0.0, 1e-3, -1e-4)
    ),
}
PLACES = {"tof": (0.3, -0.1, 0.2, 0.05, 0.0, 0.1), "left": (0.25, -0.15, 0.3, 0.2, 0.1, 0.05)}
PARAMETERS = [(name, each) for name, lens in LENSES.items() for each in (*lens.intrinsic_names, *POSE_UNITS)]
SIGMAS = {
    "rx": 2e-3,
    "ry": 1e-3,
    "rz": 3e-3,
    "tx": 2e-3,
    "ty": 1e-3,
    "tz": 4e-3,
    "fx": 0.3,
    "fy": 0.2,
    "cx": 0.4,
    "cy": 0.1,
}
PIXELS, RANGE_M = np.array([[20.0, 20.0], [88.0, 71.0], [150.0, 130.0]]), np.array([1.0, 2.0, 5.0])


def covariance(seed: int = 3) -> Floats:
    """Covariance of all parameters, every two of them correlated."""
    rng = np.random.default_rng(seed)
    sigmas = np.array([SIGMAS.get(name, 1e-3) for _, name in PARAMETERS])
    factor = rng.normal(size=(len(sigmas), len(sigmas) + 3)) / np.sqrt(len(sigmas) + 3)
    return np.asarray(sigmas[:, None] * (factor @ factor.T) * sigmas)


def rig(
    step: dict[tuple[str, str], float] | None = None, *, order: list[int] | None = None, C: Floats | None = None
) -> Rig:
    """The two cameras, with some parameters changed as `rig.json` means its covariance; with one, perhaps reordered."""
    step = step or {}
    # The gauge is a camera of its own: its pose has no uncertainty, and the others' all have one.
    cameras = {"base": mount_camera(Spectrum.COLOUR, LENSES["left"], np.eye(4))}
    for name, lens in LENSES.items():
        intrinsics = lens.intrinsics + [step.get((name, each), 0.0) for each in lens.intrinsic_names]
        moved = np.array([step.get((name, each), 0.0) for each in POSE_UNITS])
        T = transform_from_vector(PLACES[name])
        T[:3, :3] = rotation_from_vector(moved[:3]) @ T[:3, :3]
        T[:3, 3] += moved[3:]
        spectrum = Spectrum.RANGE if name == "tof" else Spectrum.COLOUR
        cameras[name] = mount_camera(spectrum, lens.with_intrinsics(intrinsics), T)
    order = list(range(len(PARAMETERS))) if order is None else order
    matrix = (covariance() if C is None else C)[np.ix_(order, order)]
    calibration = Calibration(
        software="cairn 0",
        made_s=0.0,
        gauge="base",
        covariance=covariance_from_matrix([PARAMETERS[n] for n in order], matrix),
    )
    return Rig(name="head", cameras=cameras, calibration=calibration)


def points_rig() -> Floats:
    """Points of the range camera's pixels, rig frame, metres."""
    T = transform_from_vector(PLACES["tof"])
    rays = LENSES["tof"].unproject(PIXELS) * RANGE_M[:, None]
    return np.asarray(rays @ T[:3, :3].T + T[:3, 3])


@pytest.mark.parametrize("parameter", PARAMETERS, ids=" ".join)
def test_every_gradient_agrees_with_differences(parameter: tuple[str, str]) -> None:
    h = 1e-6
    ahead, behind = rig({parameter: h}), rig({parameter: -h})
    for camera in LENSES:
        _, _, moves = projection_moves(rig(), camera, points_rig())
        numeric = (
            projection_moves(ahead, camera, points_rig())[0] - projection_moves(behind, camera, points_rig())[0]
        ) / (2 * h)
        np.testing.assert_allclose(moves.get(parameter, np.zeros((3, 2))), numeric, rtol=1e-5, atol=1e-5)
    _, moves = transfer_moves(rig(), "tof", "left", PIXELS, RANGE_M)
    there = [transfer_moves(each, "tof", "left", PIXELS, RANGE_M)[0] for each in (ahead, behind)]
    np.testing.assert_allclose(moves[parameter], (there[0] - there[1]) / (2 * h), rtol=1e-5, atol=1e-5)


def test_a_camera_s_pixels_carried_to_itself_are_certain_whatever_its_calibration() -> None:
    for name in LENSES:
        found = transfer_certain(rig(), name, name, PIXELS, RANGE_M, pixel_sigma_px=0.25, range_sigma_m=0.05)
        np.testing.assert_allclose(found.pixels, PIXELS, atol=1e-9)
        np.testing.assert_allclose(found.calibration_px2, 0, atol=1e-12)
        np.testing.assert_allclose(found.range_px2, 0, atol=1e-12)
        np.testing.assert_allclose(found.centroid_px2, np.broadcast_to(0.25**2 * np.eye(2), (3, 2, 2)), atol=1e-9)


def test_the_order_of_parameters_changes_nothing() -> None:
    shuffled = np.random.default_rng(1).permutation(len(PARAMETERS)).tolist()
    for each in (rig(), rig(order=shuffled)):
        np.testing.assert_allclose(
            transfer_certain(each, "tof", "left", PIXELS, RANGE_M).covariance_px2,
            transfer_certain(rig(), "tof", "left", PIXELS, RANGE_M).covariance_px2,
            rtol=1e-9,
        )


def test_covariance_is_linear_in_the_calibration_s_and_unlisted_parameters_are_certain() -> None:
    points, C = points_rig(), covariance()
    once, twice = (project_certain(rig(C=factor * C), "left", points).covariance_px2 for factor in (1, 2))
    np.testing.assert_allclose(twice, 2 * once, rtol=1e-9)
    own = [n for n, (camera, _) in enumerate(PARAMETERS) if camera == "left"]
    np.testing.assert_allclose(project_certain(rig(order=own), "left", points).covariance_px2, once, rtol=1e-9)
    others = [n for n in range(len(PARAMETERS)) if n not in own]
    np.testing.assert_array_equal(project_certain(rig(order=others), "left", points).covariance_px2, 0.0)


@pytest.mark.slow
def test_covariance_is_the_spread_of_pixels_over_calibrations_drawn_from_it() -> None:
    C = 0.01 * covariance()  # small, so that lenses are straight over it
    root = np.linalg.cholesky(C)
    rng = np.random.default_rng(2)
    drawn = [rig(dict(zip(PARAMETERS, root @ rng.normal(size=len(C)), strict=True))) for _ in range(600)]
    pixels = np.array([transfer_moves(each, "tof", "left", PIXELS, RANGE_M)[0] for each in drawn])
    stated = transfer_certain(rig(C=C), "tof", "left", PIXELS, RANGE_M).calibration_px2
    for n in range(3):
        found = np.cov(pixels[:, n].T)
        scale = np.sqrt(np.outer(np.diag(stated[n]), np.diag(stated[n])))
        np.testing.assert_allclose(found / scale, stated[n] / scale, atol=0.18)  # 3 sigma of 600 draws


def test_a_point_that_is_not_seen_has_no_certainty() -> None:
    T = transform_from_vector(PLACES["tof"])
    behind = T[:3, 3] - T[:3, 2]
    found = project_certain(rig(), "tof", behind)
    assert np.isnan(found.pixels).all() and np.isnan(found.covariance_px2).all()


def test_an_unknown_camera_is_refused_by_name() -> None:
    with pytest.raises(BadInputError, match="nose"):
        project_certain(rig(), "nose", points_rig())
