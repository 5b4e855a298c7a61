"""The study of image configurations: places, centroids as uncertain as is said, a rig that verifies as it should."""

import json
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from cairn_calib.rig.poses import inverse, transform_points
from cairn_calib.rig.rig import Rig, Spectrum, load_rig
from cairn_calib.verify.disc_images import Method
from cairn_calib.verify.verification import CENTROID_SIGMA_PX
from cairn_calib.verify.verification_table import CameraRow
from cairn_map.errors import BadInputError
from cairn_sim.robots.heads import RANGE_CAMERA, full_head, tof_head
from cairn_sim.robots.targets import SimulatedBoard
from cairn_sim.study.command import main
from cairn_sim.study.configurations import CONFIGURATIONS, pose_of
from cairn_sim.study.report import BARS, CAMERAS, PAPER, judged
from cairn_sim.study.run import METHODS, RANGES_M, T_MAP_HEAD, Target, driven, places_of, targets_in_view

Floats = npt.NDArray[np.float64]
HEAD = full_head(scale=0.5)
SEED = 5


def seen(points: Floats, head: Rig, camera: str) -> Floats:
    """(N, 2) pixels of points in the map's frame."""
    return head[camera].camera.project(transform_points(inverse(T_MAP_HEAD @ head[camera].transform), points))


def test_ten_configurations_have_two_to_nine_images_and_the_range_camera_sees_every_corner() -> None:
    board = SimulatedBoard()
    assert list(CONFIGURATIONS) == [f"c{n}" for n in range(1, 11)]
    counts = [len(each.places) for each in CONFIGURATIONS.values()]
    assert min(counts) == 2 and max(counts) == 9 and sorted(counts) == counts
    for name, configuration in CONFIGURATIONS.items():
        assert configuration.about.startswith(str(len(configuration.places)))
        for place in configuration.places:
            at = transform_points(T_MAP_HEAD, board.corners_at(pose_of(place, board, HEAD)))
            pixels = seen(at, HEAD, RANGE_CAMERA)
            assert (pixels > 2).all() and (pixels < [173, 141]).all(), (name, place)
    with pytest.raises(BadInputError, match="no 'c11'"):
        places_of(["c1", "c11"])


def test_targets_stand_apart_within_the_papers_ranges_and_in_the_room() -> None:
    rng = np.random.default_rng(SEED)
    for _ in range(8):
        targets = targets_in_view(HEAD, rng)
        assert [each.diameter_m for each in targets] == [0.20, 0.30, 0.30]
        for one in targets:
            centre = one.T_map_target[:3, 3]
            assert RANGES_M[0] <= np.linalg.norm(centre - T_MAP_HEAD[:3, 3]) <= RANGES_M[1]
            assert (rim(one)[:, 2] > 0).all() and (rim(one)[:, 2] < 2.8).all()
            pixels = seen(rim(one), HEAD, RANGE_CAMERA)
            assert (pixels > 0).all() and (pixels < [175, 143]).all()
            for other in targets:
                if other is not one:
                    apart = seen(rim(other), HEAD, RANGE_CAMERA)[:, None] - pixels
                    assert np.linalg.norm(apart, axis=2).min() > 2


def rim(target: Target) -> Floats:
    """(N, 3) outer edge of the tape, map frame."""
    angle = np.linspace(0, 2 * np.pi, 180, endpoint=False)
    circle = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1) * target.diameter_m / 2
    return transform_points(target.T_map_target, circle + np.array([0, 0, 1e-3]))


def area_centroid(polygon: Floats) -> Floats:
    """(2,) of a closed polygon's area."""
    (x, y), (u, v) = polygon.T, np.roll(polygon, -1, axis=0).T
    cross = x * v - u * y
    return np.asarray(np.array([((x + u) * cross).sum(), ((y + v) * cross).sum()]) / (3 * cross.sum()))


def test_centroids_are_as_uncertain_as_is_said_and_grey_ones_half_as_much() -> None:
    head, images = tof_head(), 40
    rng = np.random.default_rng(SEED + 1)
    views = [targets_in_view(head, rng) for _ in range(images)]
    errors: dict[tuple[Method, str], list[Floats]] = {(m, c): [] for m in METHODS for c in head.cameras}
    for found, targets in zip(driven(head, images, seed=SEED), views, strict=True):
        for method in METHODS:
            for camera, discs in found[method].discs.items():
                for target in targets:
                    true = area_centroid(seen(rim(target), head, camera))
                    near = min(discs, key=lambda disc, at=true: float(np.linalg.norm(disc.centroid - at)))  # type: ignore[misc]
                    errors[method, camera].append(near.centroid - true)
    for (method, camera), found_errors in errors.items():
        stated = CENTROID_SIGMA_PX[method][head[camera].spectrum]
        assert np.sqrt(np.mean(np.square(found_errors))) == pytest.approx(stated, rel=0.2), (method, camera)
        assert np.abs(found_errors).max() < 8 * stated
    paper, grey = (CENTROID_SIGMA_PX[method][Spectrum.RANGE] for method in METHODS)
    assert grey < 0.55 * paper


def row(camera: str, sigma_px: float, rms_px: float, total_px: float) -> CameraRow:
    return CameraRow(
        camera=camera,
        count=100,
        sigma_x_px=sigma_px,
        sigma_y_px=sigma_px,
        sigma_px=sigma_px,
        sigma_low_px=sigma_px,
        sigma_high_px=sigma_px,
        bias_x_px=0.0,
        bias_y_px=0.0,
        rms_px=rms_px,
        expected_px={},
        total_px=total_px,
        source_pixel_px=10.0,
    )


def test_the_best_is_judged_by_the_bars_and_by_what_was_expected() -> None:
    assert BARS == {"paper": (2.8, 1.1), "grey": (1.5, 0.6)}
    good, wide, off = judged(
        [row("colour_left", 1.49, 1.09, 1.0), row("thermal_left", 0.61, 1.0, 1.0), row("colour_right", 1.0, 1.2, 1.0)],
        "grey",
    )
    assert good.count("met") == 2 and "MISSED" not in good
    assert "at most 0.6: MISSED" in wide and wide.endswith("(+0%): met")
    assert "at most 1.5: met" in off and off.endswith("(+20%): MISSED")
    assert PAPER["c10"] == (2.8, 3.2, 1.1, 1.2) and len(CAMERAS) == 4


@pytest.mark.slow
def test_the_command_solves_verifies_and_writes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--only", "c1,c5", "--images", "4", "--scale", "0.5", "--output", str(tmp_path)]) == 0
    out = capsys.readouterr().out
    assert "c1   refused: all boards that" in out and "best: c5 (4 tilted" in out
    document = json.loads((tmp_path / "study.json").read_text())
    assert document["best"] == "c5"
    refused, solved = document["configurations"]
    assert refused["refusal"] and refused["tables"] == {}
    assert {each["camera"] for each in solved["tables"]["grey"]} == set(CAMERAS)
    assert all(each["total_px"] for each in solved["tables"]["paper"])
    rig = load_rig(tmp_path / "rig-c5.json")
    # 4 images tell the focal length to a few pixels of 671 and 466.
    for camera, mounted in HEAD.cameras.items():
        focal = rig[camera].camera.model_dump()["focal_px"]
        assert focal == pytest.approx(mounted.camera.model_dump()["focal_px"], rel=0.02)
    html = (tmp_path / "study.html").read_text()
    assert "Table 2, centroids by method paper" in html and 'class="best"' in html and "Fig. 16" in html
    with pytest.raises(BadInputError, match="--seed"):
        main(["--seed", "-1", "--output", str(tmp_path)])
