"""`cairn sim evaluate-fusion`: what its scores count, on a truth made by hand; its pictures; real hot cups."""

import os
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cairn_calib.rig.poses import look_at
from cairn_calib.rig.rig import Spectrum
from cairn_fusion.image_fusion.cross_view import CrossView
from cairn_fusion.image_fusion.dense_depth import DenseDepth
from cairn_fusion.image_fusion.surface import Drawn
from cairn_fusion.recording.images import read_colour
from cairn_fusion.transfer.transfer import Label
from cairn_fusion.view.temperature_scale import TemperatureScale
from cairn_map.errors import BadInputError
from cairn_sim.evaluation.fusion_evaluation import WAYS, labelled_frames, mapped_scores, scored_view
from cairn_sim.evaluation.fusion_pictures import error_picture, figure_24
from cairn_sim.evaluation.fusion_scores import COLUMNS, fusion_scores
from cairn_sim.evaluation.fusion_truth import FusionTruth
from cairn_sim.evaluation.temperature_scores import OTHERS
from cairn_sim.render.render import render_scan
from cairn_sim.robots.heads import RANGE_CAMERA, full_head
from cairn_sim.robots.record import Plan, scans_of, shots_of
from cairn_sim.robots.robots import ROBOTS
from cairn_sim.robots.trajectories import EXPERIMENT
from cairn_sim.scene.scene_file import load_scene
from cairn_sim.sim_command import main


def test_scores_count_what_their_names_say() -> None:
    none = np.zeros((1, 1), np.float32)
    origins = np.array([[1, 1, 2, 1, 0, 1]], np.uint8)
    drawn = Drawn(step_px=1, per_pixel=1.0, nearness=none, marks=none.astype(np.uint8), hiding=none, slack=none)
    depth = DenseDepth("colour", np.ones((1, 6), np.float32), origins, drawn)
    labels = np.array([[Label.OK, Label.OK, Label.OK, Label.OCCLUDED, Label.NO_RANGE, Label.OK]], np.uint8)
    values = np.array([[300, 303, 300.5, np.nan, np.nan, 290]], np.float32)[..., None]
    fused = CrossView("colour", ("warm",), values, labels, np.zeros((1, 6), np.uint8), depth)
    sees = np.array([[True, False, True, False, True, True]])
    truth = FusionTruth(
        values=np.full((1, 6, 1), 300, np.float32),
        sees={"warm": sees},
        in_view={"warm": np.ones((1, 6), bool)},
        near_edge=np.array([[False, False, True, True, False, False]]),
        beyond=np.array([[False, False, False, False, False, True]]),
    )
    scores = fusion_scores(fused, truth, unit="K")
    assert (scores.pixels, scores.painted, scores.hidden_painted, scores.hidden_painted_away) == (5, 3, 1, 1)
    assert (scores.called, scores.called_hidden, scores.hidden) == (1, 1, 2)
    assert scores.precision == 1.0 and scores.recall == 0.5
    assert scores.precision_near == 1.0 and scores.recall_near == 0.5
    # The first hidden pixel is two pixels from the one that was called so: near enough, were they so much finer.
    finer = fusion_scores(fused, replace(truth, pixel_px=2.0), unit="K")
    assert finer.precision_near == 1.0 and finer.recall_near == 1.0 and finer.recall == 0.5
    np.testing.assert_allclose(scores.errors, [0, 3, 0.5])
    np.testing.assert_allclose(scores.errors_away, [0, 3])
    np.testing.assert_allclose(scores.errors_filled, [0.5])
    np.testing.assert_allclose(scores.errors_beyond, [10])
    twice = scores + scores
    assert twice.painted == 6 and len(twice.errors) == 6
    assert len(twice.row()) == len(COLUMNS) and twice.row()[0] == "60.0"


def test_each_step_of_fusion_is_worth_something() -> None:
    rig, scene = full_head(scale=0.25), load_scene("building")
    torso = scene.solids[scene.number_of("technician/torso")].T_map_solid[:3, 3]
    T_map_rig = look_at(torso + np.array([-1.4, 0.5, 0.2]), torso)
    scan = render_scan(scene, rig, T_map_rig=T_map_rig, range_camera=RANGE_CAMERA, time_s=0.0)
    view = scored_view(scene, rig, scan, "colour_left")
    both, one, nothing, nominal = (view.scores[way] for way in WAYS)
    assert both.painted > one.painted
    assert one.hidden_painted < 0.5 * nothing.hidden_painted
    assert (both.errors > 2).mean() < 0.5 * (nominal.errors > 2).mean()
    assert np.median(both.errors) < 0.1
    scale = TemperatureScale(288.0, 308.0)
    assert figure_24(scan, rig, "colour_left", scale).shape == (488, 648, 3)
    assert error_picture(scan, view.fused, view.truth, scale).shape == (240, 960, 3)


@pytest.mark.slow
def test_mapped_temperatures_of_the_building_are_true_edges_included() -> None:
    """Laboratories with people, hot and cold pipes, glass and a mirror, from every sixth image of two stops."""
    robot, scene = ROBOTS["orpheus"], load_scene("building")
    rig = robot.rig_of(1.0)
    cameras = {name: each for name, each in rig.cameras.items() if each.spectrum is not Spectrum.COLOUR}
    rig = rig.model_copy(update={"cameras": cameras})
    stops = []
    for stop in (3, 20):
        plan = Plan(scene=scene, robot=robot, path=EXPERIMENT, truth="none", first_stop=stop, last_stop=stop + 1)
        stops.append([scan for _, scan, _ in scans_of(plan, shots_of(plan)[1::6], rig)])
    found = mapped_scores(scene, rig, stops, voxel_edge_m=0.04)
    kept, painted = found["as cairn maps"], found["edges painted"]
    for group in ("bodies", OTHERS):
        assert len(kept[group].errors_k) > 30
        assert kept[group].median_k <= 0.5 and kept[group].p95_k <= 2.0
    assert painted[OTHERS].p95_k > 2.0


@pytest.mark.recording
@pytest.mark.skipif("CAIRN_TEST_DATA" not in os.environ, reason="CAIRN_TEST_DATA names no folder of recordings")
def test_real_hot_cups_are_where_the_sets_own_registration_has_them() -> None:
    frames = list(labelled_frames(Path(os.environ["CAIRN_TEST_DATA"]) / "mm5_rgbdt"))
    assert len(frames) == 3
    for frame in frames:
        assert frame.fused_iou > frame.given_iou - 0.02 and frame.fused_iou > 0.7


@pytest.mark.slow
def test_the_command_prints_its_tables_and_writes_pictures_that_show_something(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    small = ["--scans", "1", "--poses", "2", "--scale", "0.25", "--map", "1", "--voxel", "0.08"]
    assert main(["evaluate-fusion", str(tmp_path), *small]) == 0
    tables = tables_of(capsys.readouterr().out)
    warm, colour, over, mapped = (
        tables[head] for head in ("temperature, K, on colour_left", "colour, of 255, on thermal_left", OVER, MAPPED)
    )
    assert set(warm) == set(colour) == set(WAYS)
    assert warm["both cameras"]["median"] < 0.1 and colour["both cameras"]["median"] < 2
    for table in (warm, colour):
        assert table["both cameras"]["95 % away"] < table["not calibrated"]["95 % away"]
        assert table["both cameras"]["painted %"] >= table["one camera"]["painted %"] > 20
        assert table["one camera"]["hidden %"] < table["nothing hides"]["hidden %"]
        assert table["one camera"]["recall +-1"] > 70
    visible, alone = over["live depth agrees"], over["no live depth"]
    assert visible["poses"] == alone["poses"] == 2
    for way in (visible, alone):
        assert 0.98 <= way["least"] <= way["mean"] <= 1
    kept, edges = mapped["as cairn maps, pipes"], mapped["edges painted, pipes"]
    assert kept["voxels"] == edges["voxels"] > 100
    assert kept["median K"] < 0.5 and kept["95 % K"] < 2 < edges["95 % K"]
    assert 20 < kept["known %"] < edges["known %"] <= 100
    figure, errors = (read_colour(tmp_path / name) for name in ("fig24.png", "errors.png"))
    assert figure.shape == (488, 648, 3) and errors.shape == (240, 960, 3)
    panels = [figure[top : top + 240, left : left + 320].astype(int) for top in (0, 248) for left in (0, 328)]
    assert all(panel.std() > 10 for panel in [*panels, *np.hsplit(errors, 3)])
    # Of the three that are made: calibration moves what is fused, and neither is the colour image alone.
    assert all(np.abs(one - panels[3]).mean() > 2 for one in panels[:3])


OVER = "map over colour_left, IoU"
MAPPED = "map of 1 stops, 8 cm"


def tables_of(printed: str) -> dict[str, dict[str, dict[str, float]]]:
    """By head of the table, name of the row, and column; columns are two blanks apart."""
    tables: dict[str, dict[str, dict[str, float]]] = {}
    columns, rows = list[str](), dict[str, dict[str, float]]()
    for line in printed.splitlines():
        name, *cells = re.split(r"\s{2,}", line.strip())
        if not cells:
            continue
        if line.startswith("  "):
            values = [float("nan" if cell == "-" else cell) for cell in cells]
            rows[name] = dict(zip(columns, values, strict=True))
        else:
            columns, rows = cells, {}
            tables[name] = rows
    return tables


@pytest.mark.parametrize("option", [("--scans", "0"), ("--poses", "0"), ("--map", "-1"), ("--scale", "2")])
def test_the_command_refuses_numbers_that_mean_nothing(tmp_path: Path, option: tuple[str, str]) -> None:
    with pytest.raises(BadInputError, match=option[0]):
        main(["evaluate-fusion", str(tmp_path), *option])
