"""Images of one camera on another's pixels: slow twins, OpenCV as a second opinion, and hidden places never painted."""

import os
from dataclasses import replace

import cv2
import numpy as np
import numpy.typing as npt
import pytest
from tests.naive import views as naive_views

from cairn_calib.rig.camera import Camera
from cairn_calib.rig.fisheye import FisheyeCamera
from cairn_calib.rig.poses import inverse, look_at, transform_points
from cairn_calib.rig.rig import Rig, Spectrum, mount_camera
from cairn_fusion.image_fusion.cross_view import cross_view, fused_covariance
from cairn_fusion.image_fusion.cross_view_kernels import label_into, sample_into
from cairn_fusion.image_fusion.surface import beams, drawn_surface, places, surface_of
from cairn_fusion.recording.scan import Scan
from cairn_fusion.transfer.pixel_covariance import pixel_covariance
from cairn_fusion.transfer.transfer import Label
from cairn_fusion.view.telepresence import fuse, view_depth
from cairn_sim.evaluation.fusion_scores import fusion_scores
from cairn_sim.evaluation.fusion_truth import fusion_truth
from cairn_sim.render.render import render_scan
from cairn_sim.robots.heads import RANGE_CAMERA, full_head
from cairn_sim.scene.scene import Scene, scene_of
from cairn_sim.scene.solids import Box, Shape, Solid, Sphere, placed
from cairn_sim.scene.surfaces import Material, Surface

Floats = npt.NDArray[np.float64]
HEAD = full_head(scale=0.25)
POSES = int(os.environ.get("CAIRN_FUSION_POSES", "30"))
"""Random rooms and heads; 1000 in `make soak`."""


def room(rng: np.random.Generator) -> Scene:
    """4 x 4 x 3 m, cold, with warm things of many sizes before the camera, which is at the origin and looks along x."""

    def solid(shape: Shape, at: tuple[float, float, float], kelvin: float, grey: int) -> Solid:
        material = Material(colour_srgb=(grey, grey, 255 - grey), temperature_k=kelvin)
        return Solid("thing", shape, Surface(material), placed(at, (0.0, 0.0, float(rng.uniform(-0.5, 0.5)))))

    wall = Surface(Material(temperature_k=290.0))
    solids = [Solid("room", Box((0.2, 6, 6)), wall, placed((3.5, 0, 0)))]
    solids += [Solid("room", Box((6, 6, 0.2)), wall, placed((1.5, 0, z))) for z in (-1.2, 1.6)]
    for n in range(6):
        x, y, z = rng.uniform((1.0, -0.9, -0.7), (2.8, 0.9, 0.8))
        size = rng.uniform(0.15, 0.5)
        shape: Shape = Sphere(size / 2) if n % 3 == 0 else Box((size, size, float(rng.uniform(0.2, 0.8))))
        solids.append(solid(shape, (x, y, z), float(rng.uniform(300, 330)), int(rng.integers(40, 220))))
    return scene_of(solids)


def perfect_scan(scene: Scene, rig: Rig, T_map_rig: Floats) -> Scan:
    return render_scan(scene, rig, T_map_rig=T_map_rig, range_camera=RANGE_CAMERA, time_s=0.0, threads=1)


def poses(count: int, seed: int) -> list[tuple[Scene, Floats]]:
    """Rooms, and heads in them that look about along x."""
    rng = np.random.default_rng(seed)
    found = []
    for _ in range(count):
        eye = rng.uniform((-0.4, -0.4, -0.3), (0.2, 0.4, 0.5))
        target = rng.uniform((2.5, -0.5, -0.4), (3.0, 0.5, 0.5))
        found.append((room(rng), look_at(eye, target)))
    return found


@pytest.mark.parametrize("name", ["colour_left", "thermal_right"])
def test_places_are_those_of_the_camera_model(name: str) -> None:
    rng = np.random.default_rng(0)
    tof, dst = HEAD[RANGE_CAMERA], HEAD[name]
    range_m = rng.uniform(0.3, 8, (144, 176)).astype(np.float32)
    range_m[rng.random(range_m.shape) < 0.1] = np.nan
    T = inverse(dst.transform) @ tof.transform
    u, v, q = places(range_m, beams(tof.camera), dst.camera, T)
    points = transform_points(T, tof.camera.rays() * range_m[..., None].astype(np.float64))
    exact = dst.camera.project(points)
    seen = dst.camera.contains(exact)
    assert seen.mean() > 0.3
    np.testing.assert_allclose(np.stack([u, v], axis=-1)[seen], exact[seen], atol=2e-3)
    np.testing.assert_allclose(q[seen], 1 / np.linalg.norm(points[seen], axis=-1), rtol=1e-5)
    assert np.isnan(u[np.isnan(range_m)]).all()


def test_a_fisheye_is_reached_by_its_own_model() -> None:
    lens = FisheyeCamera(
        width=200, height=200, focal_px=(90.0, 90.0), centre_px=(99.5, 99.5), distortion=(0.1, 0, 0, 0)
    )
    src = Camera(width=20, height=16, focal_px=(20.0, 20.0), centre_px=(9.5, 7.5))
    T = inverse(look_at((0.1, 0, 0), (0.1, 0, 1), up=(0, -1, 0)))
    u, v, _ = places(np.full((16, 20), 2, np.float32), beams(src), lens, T)
    exact = lens.project(transform_points(T, 2 * src.rays()))
    np.testing.assert_allclose(np.stack([u, v], axis=-1), exact, atol=1e-3)


@pytest.mark.parametrize("seed", range(3))
def test_labels_and_samples_agree_with_their_slow_twins(seed: int) -> None:
    rng = np.random.default_rng(seed)
    shape, image = (9, 14), rng.random((12, 16, 2)).astype(np.float32)
    image[3, 4, 1] = np.nan
    u, v = rng.uniform(-3, 18, shape).astype(np.float32), rng.uniform(-3, 14, shape).astype(np.float32)
    u[0, 0], u[0, 1], v[0, 1] = np.nan, -0.5, -0.5
    q = rng.uniform(0.2, 1.0, shape).astype(np.float32)
    least = rng.uniform(0.0, 0.9, (4, 6)).astype(np.float32)
    given = rng.choice([0, 0, 0, 3, 5], size=shape).astype(np.uint8)
    labels, values = given.copy(), np.zeros((*shape, 2), np.float32)
    label_into(labels, u, v, q, least, 3, 16, 12)
    sample_into(values, labels, u, v, image)
    for at in np.ndindex(shape):
        expected, value = int(given[at]), np.zeros(2)
        if expected == Label.OK:
            inside = -0.5 <= u[at] < 15.5 and -0.5 <= v[at] < 11.5
            cell = (int((v[at] + 0.5) / 3), int((u[at] + 0.5) / 3)) if inside else (0, 0)
            hidden = q[at] < least[cell]
            expected = (Label.OCCLUDED if hidden else Label.OK) if inside else Label.OUT_OF_VIEW
        if expected == Label.OK:
            value = naive_views.bilinear(image, u[at], v[at])
            expected = Label.NO_READING if np.isnan(value).any() else Label.OK
        assert labels[at] == expected
        if expected == Label.OK:
            np.testing.assert_allclose(values[at], value, rtol=1e-5)
    assert {0, 1, 2, 3, 5} <= set(labels.ravel().tolist())


def test_registered_depth_is_that_of_opencv() -> None:
    """OpenCV's registerDepth knows no lens distortion in its source: an independent reference for ideal lenses."""
    rig, (scene, T_map_rig) = full_head(scale=0.25, ideal=True), poses(1, 3)[0]
    # Pixels as large as the range camera's, so that neither leaves holes; so many that no point is outside, where
    # OpenCV 5.0 writes beyond its image.
    colour = rig["colour_left"].camera.model_copy(
        update={"width": 480, "height": 400, "focal_px": (120.0, 120.0), "centre_px": (239.5, 199.5)}
    )
    assert isinstance(colour, Camera)
    rig = rig.model_copy(
        update={"cameras": {**rig.cameras, "colour_left": rig["colour_left"].model_copy(update={"camera": colour})}}
    )
    scan, tof = perfect_scan(scene, rig, T_map_rig), rig[RANGE_CAMERA]
    assert isinstance(tof.camera, Camera)
    drawn = drawn_surface(surface_of(scan, rig), rig, "colour_left")
    assert drawn.step_px == 1

    def matrix(camera: Camera) -> Floats:
        (fx, fy), (cx, cy) = camera.focal_px, camera.centre_px
        return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])

    z_m = (scan.range_m * tof.camera.rays()[..., 2]).astype(np.float32)
    T = inverse(rig["colour_left"].transform) @ tof.transform
    single = (each.astype(np.float32) for each in (matrix(tof.camera), matrix(colour)))
    theirs = np.asarray(cv2.registerDepth(*single, None, T.astype(np.float32), z_m, (480, 400)))
    with np.errstate(divide="ignore"):
        ours = np.where(drawn.nearness > 0, colour.rays()[..., 2] / drawn.nearness, np.nan)
    both = np.isfinite(ours) & np.isfinite(theirs) & (theirs > 0)
    assert both.sum() > 12_000
    difference = np.abs(ours[both] - theirs[both]) / theirs[both]
    # It rounds to the nearest pixel, and puts points side by side instead of surfaces: edges and slants differ.
    assert np.median(difference) < 0.002 and np.mean(difference < 0.02) > 0.95


@pytest.mark.slow
def test_without_noise_what_is_hidden_is_never_painted_away_from_edges() -> None:
    painted = hidden = called = missed = wrong = away = 0
    rig = HEAD.model_copy(update={"cameras": {n: m for n, m in HEAD.cameras.items() if n != "colour_right"}})
    for scene, T_map_rig in poses(POSES, 1):
        scan = perfect_scan(scene, rig, T_map_rig)
        sources = ["thermal_left", "thermal_right"]
        truth = fusion_truth(scene, rig, "colour_left", sources, T_map_rig=T_map_rig, range_camera=RANGE_CAMERA)
        scores = fusion_scores(fuse(scan, rig, "colour_left"), truth, unit="K")
        painted, missed = painted + scores.painted, missed + scores.hidden_painted_away
        one = fuse(replace(scan, thermal={"thermal_left": scan.thermal["thermal_left"]}), rig, "colour_left")
        alone = fusion_scores(one, truth, unit="K")
        hidden, called, missed = hidden + alone.hidden, called + alone.called_hidden, missed + alone.hidden_painted_away
        # Where two warm things meet without a step in depth, temperatures change within a thermal pixel of it.
        assert np.mean(scores.errors_away > 1.0) < 0.02
        wrong, away = wrong + int((scores.errors_away > 1.0).sum()), away + len(scores.errors_away)
    assert missed == 0
    assert wrong < 1e-3 * away
    assert painted > 30_000 * POSES and hidden > 300 * POSES and called > 0.5 * hidden


def test_a_second_camera_fills_what_the_first_does_not_see() -> None:
    scene, T_map_rig = poses(1, 5)[0]
    scan = perfect_scan(scene, HEAD, T_map_rig)
    both = fuse(scan, HEAD, "colour_left")
    one = fuse(replace(scan, thermal={"thermal_left": scan.thermal["thermal_left"]}), HEAD, "colour_left")
    assert both.sources == ("thermal_left", "thermal_right")
    assert (both.ok >= one.ok).all()
    gained = both.ok & ~one.ok
    assert gained.sum() > 100
    np.testing.assert_array_equal(both.source == 1, gained)
    np.testing.assert_array_equal(both.values[one.ok], one.values[one.ok])
    assert np.isnan(both.values[~both.ok]).all()


def test_colour_is_carried_to_the_thermal_image_too() -> None:
    scene, T_map_rig = poses(1, 6)[0]
    fused = fuse(perfect_scan(scene, HEAD, T_map_rig), HEAD, "thermal_left")
    sources = list(fused.sources)
    truth = fusion_truth(scene, HEAD, "thermal_left", sources, T_map_rig=T_map_rig, range_camera=RANGE_CAMERA)
    scores = fusion_scores(fused, truth, unit="of 255")
    assert fused.values.shape[2] == 3 and scores.painted > 0.3 * scores.pixels
    assert np.median(scores.errors) < 1 and np.quantile(scores.errors_away, 0.95) < 3


def test_cameras_with_one_centre_hide_nothing_from_each_other() -> None:
    lens = Camera(width=44, height=36, focal_px=(40.0, 40.0), centre_px=(21.5, 17.5))
    spectra = {"tof": Spectrum.RANGE, "colour": Spectrum.COLOUR, "thermal": Spectrum.THERMAL}
    rig = Rig(name="one", cameras={name: mount_camera(each, lens, np.eye(4)) for name, each in spectra.items()})
    range_m = np.full((36, 44), 3.0, np.float32)
    range_m[10:20, 10:20] = 1.0
    kelvin = np.random.default_rng(0).uniform(280, 300, (36, 44)).astype(np.float32)
    colour = np.zeros((36, 44, 3), np.uint8)
    scan = Scan(
        time_s=0.0,
        T_map_rig=np.eye(4),
        range_camera="tof",
        range_m=range_m,
        colour={"colour": colour},
        thermal={"thermal": kelvin},
    )
    fused = fuse(scan, rig, "colour")
    assert fused.ok.mean() > 0.95
    np.testing.assert_allclose(fused.values[..., 0][fused.ok], kelvin[fused.ok], rtol=1e-4)
    drawn = drawn_surface(surface_of(scan, rig), rig, "colour")
    none = cross_view(view_depth(scan, rig, "colour", drawn), rig, {}, drawn={}, range_camera="tof")
    assert not none.ok.any() and none.sources == ()


def test_every_fused_pixel_has_the_covariance_of_its_source() -> None:
    scene, T_map_rig = poses(1, 7)[0]
    fused = fuse(perfect_scan(scene, HEAD, T_map_rig), HEAD, "colour_left")
    found = fused_covariance(fused, HEAD, range_camera=RANGE_CAMERA)
    np.testing.assert_array_equal(np.isfinite(found).all(axis=2), fused.ok)
    for number, name in enumerate(fused.sources):
        y, x = (at[::97] for at in np.nonzero(fused.ok & (fused.source == number) & (fused.depth.origins == 1)))
        range_m = fused.depth.shown_m[y, x].astype(np.float64)
        points = HEAD["colour_left"].camera.rays()[y, x] * range_m[:, None]
        sigma_m = HEAD[RANGE_CAMERA].range_sigma_m(range_m)
        exact = pixel_covariance(points, sigma_m, HEAD, src="colour_left", dst=name)
        trace = exact[:, 0, 0] + exact[:, 1, 1]
        np.testing.assert_allclose(found[y, x, 0] + found[y, x, 2], trace, rtol=0.1)
    filled = found[fused.ok & (fused.depth.origins == 2)].sum(axis=1).mean()
    assert filled > 3 * found[fused.ok & (fused.depth.origins == 1)].sum(axis=1).mean()
