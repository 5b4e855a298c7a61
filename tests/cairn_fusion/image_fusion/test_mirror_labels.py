"""A mirror on a wall that others mapped from behind: what it shows is labelled, and never painted."""

from dataclasses import replace

import numpy as np
import pytest
from tests.fixtures.map.worlds import map_of

from cairn_calib.rig.poses import look_at
from cairn_fusion.image_fusion import mirror_labels
from cairn_fusion.image_fusion.mirror_labels import mirror_pixels
from cairn_fusion.image_fusion.surface import live_range, surface_of
from cairn_fusion.recording.scan import Scan
from cairn_fusion.transfer.transfer import Label
from cairn_fusion.view.telepresence import Telepresence, ViewOptions, fuse
from cairn_map.evidence.channels import TEMPERATURE
from cairn_map.evidence.grid import Geometry
from cairn_map.queries.map_snapshot import MapSnapshot, snapshot_of
from cairn_sim.evaluation.fusion_truth import fusion_truth
from cairn_sim.render.render import render_scan, view_of
from cairn_sim.render.sensors import Noise
from cairn_sim.robots.heads import RANGE_CAMERA, full_head
from cairn_sim.scene.scene import Scene, scene_of
from cairn_sim.scene.solids import Box, Solid, placed
from cairn_sim.scene.surfaces import Material, Optics, Surface

HEAD = full_head(scale=0.25)
GRID = Geometry(voxel_edge_um=50_000, depth=5, channels=(TEMPERATURE,))
T_MAP_RIG = look_at((0.0, 0.2, 0.1), (2.0, 0.0, 0.0))


def room() -> Scene:
    """A wall 2 m ahead with a mirror of 1.2 x 0.9 m, which shows the wall 2 m behind the head, warm, and a thing."""
    mirror, warm = Material(optics=Optics.MIRROR, reflectivity_nir=0.1), Material(temperature_k=305.0)
    parts = [
        ("wall", (0.2, 6, 5), (2.1, 0, 0), Material()),
        ("back", (0.2, 6, 5), (-2.1, 0, 0), warm),
        ("thing", (0.4, 0.4, 2), (-1.2, 0.8, 0), warm),
        ("floor", (4, 6, 0.2), (0, 0, -1.2), Material()),
        ("mirror", (0.02, 1.2, 0.9), (1.99, 0, 0), mirror),
    ]
    return scene_of([Solid(name, Box(size), Surface(material), placed(at)) for name, size, at, material in parts])


def scanned(noise: Noise | None) -> tuple[Scan, np.ndarray[tuple[int, ...], np.dtype[np.bool_]]]:
    """A scan, and which of its range pixels the mirror is in."""
    scene = room()
    scan = render_scan(scene, HEAD, T_map_rig=T_MAP_RIG, range_camera=RANGE_CAMERA, time_s=0.0, noise=noise)
    hits = view_of(scene, HEAD, RANGE_CAMERA, T_map_rig=T_MAP_RIG).hits
    return scan, (hits.way != 0).reshape(scan.range_m.shape)


@pytest.fixture(scope="module")
def wall() -> MapSnapshot:
    """The wall's other side, as robots in the next room have it."""
    span = range(-50, 50)
    return snapshot_of(map_of(GRID, {(x, y, z): (3, 0) for x in (42, 43) for y in span for z in range(-24, 40)}))


@pytest.mark.parametrize("noise", [None, Noise(3)])
def test_what_a_mirror_shows_is_labelled_and_nothing_else(noise: Noise | None, wall: MapSnapshot) -> None:
    scan, mirrored = scanned(noise)
    known = np.isfinite(scan.range_m)
    found = mirror_pixels(scan, HEAD, wall)
    assert (found & mirrored).sum() > 0.75 * (mirrored & known).sum() > 1000
    assert (found & ~mirrored).sum() <= 0.002 * (known & ~mirrored).sum()
    labels = surface_of(scan, HEAD, found).labels
    assert (labels[found] != Label.OK).all() and (labels[found] == Label.BEYOND).mean() > 0.95  # or flying
    empty = snapshot_of(map_of(GRID, {(0, 0, 40): (3, 0)}))
    assert not mirror_pixels(scan, HEAD, empty).any()
    assert not mirror_pixels(replace(scan, range_m=np.full_like(scan.range_m, np.nan)), HEAD, wall).any()


def test_of_a_fine_image_every_second_pixel_is_enough(wall: MapSnapshot, monkeypatch: pytest.MonkeyPatch) -> None:
    scan, mirrored = scanned(None)
    whole, known = mirror_pixels(scan, HEAD, wall), np.isfinite(scan.range_m)
    monkeypatch.setattr(mirror_labels, "ROWS_MAX", scan.range_m.shape[0] // 2)
    found = mirror_pixels(scan, HEAD, wall)
    assert found.shape == whole.shape and (found != whole).any()
    assert (found & mirrored).sum() > 0.75 * (mirrored & known).sum() > 1000
    assert (found & ~mirrored).sum() <= 0.005 * (known & ~mirrored).sum() and not (found & ~known).any()


def test_what_a_mirror_shows_is_never_painted(wall: MapSnapshot) -> None:
    scan, _ = scanned(None)
    found = mirror_pixels(scan, HEAD, wall)
    truth = fusion_truth(room(), HEAD, "colour_left", ["thermal_left"], T_map_rig=T_MAP_RIG, range_camera=RANGE_CAMERA)
    plain, kept = fuse(scan, HEAD, "colour_left"), fuse(scan, HEAD, "colour_left", found)
    assert (plain.ok & truth.beyond).sum() > 5000
    # What is left lies at the mirror's border, where the window has the wall in it as well.
    assert (kept.ok & truth.beyond).sum() < 0.15 * (plain.ok & truth.beyond).sum()
    assert (kept.labels[truth.beyond] == Label.BEYOND).mean() > 0.75
    assert (kept.ok & ~truth.beyond).sum() > 0.98 * (plain.ok & ~truth.beyond).sum()
    assert np.isnan(kept.values[~kept.ok]).all()
    assert np.isnan(live_range(scan, HEAD, camera="colour_left", beyond=found)[truth.beyond]).mean() > 0.7
    pictures = [Telepresence(HEAD, ViewOptions(), each).view(scan) for each in (None, wall)]
    assert (pictures[0] != pictures[1])[truth.beyond].any(axis=1).mean() > 0.5


def test_a_new_thing_before_a_wall_and_one_that_the_map_has_are_not_labelled(wall: MapSnapshot) -> None:
    scan, mirrored = scanned(None)
    near = replace(scan, range_m=np.where(mirrored, np.float32(1.2), scan.range_m))
    assert not mirror_pixels(near, HEAD, wall).any()
